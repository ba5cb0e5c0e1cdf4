"""Draw one picture of the film (film.py): the scene from the side, the gel, the camera's view, and charts.

The camera's view is turned by 90 degrees, so that down in the world is down in the picture. Next to it, at the same
height, is the gel from the side. Pictures are drawn at twice the size and averaged; only events keep their pixels.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from evetac_cli.events import Events
from evetac_cli.kernels.event_representation import event_image
from scripts.pictures.film_story import Act, Story

FINE = 2  # enlargement while drawing
ARROWS = 5.0  # times the true displacement
NEAR = 8  # levels between two colours of the palette
WIDE, TALL = 720, 616
PAPER, PANEL, SLOW, RULE, TEXT, QUIET = "#12171e", "#1b222c", "#27313f", "#39434f", "#e8edf3", "#98a3b0"
ON, OFF, GEL, HAIR, OBJECT, FINGER = "#f5d547", "#4ea3ff", "#2e6f6a", "#8fd3c8", "#77808c", "#566273"
FORCE, TICKS, HEIGHT, SLIP = "#ff9d45", "#7cc4ff", "#4fd1a1", "#ef8fc4"
CURVES = (QUIET, TICKS, HEIGHT, SLIP)
# Pairs of colours drawn over each other; their mixtures are in the film's palette too.
OVER = {
    PAPER: (PANEL, SLOW, TEXT, QUIET, ON, OFF, *CURVES),
    PANEL: (TEXT, QUIET, FORCE, OBJECT, FINGER, RULE, GEL, SLOW, *CURVES),
    SLOW: (TEXT, QUIET, *CURVES),
    GEL: (HAIR, TEXT, FINGER, OBJECT),
    OBJECT: (TEXT, RULE),
}
TOP = 70  # of the upper row
VIEW = 0.5  # from camera pixels to film pixels
SCENE = (14, 178)  # left and right of the three panels
LOUPE = (190, 452)
CAMERA_LEFT = 466
CHART_LEFT, CHART_RIGHT, CHART_TOP, CHART_TALL, CHART_STEP = 108, 640, 436, 48, 54
CAPTIONS = {
    "lift": "The hand lifts it.",
    "loosening": "The grip is loosened, to find out how little is enough.",
    "catch": "One picture a millisecond: it begins to slip.",
    "noticed": "The slip is noticed, the grip closes.",
    "caught": "Caught: it sticks, and the gel rings.",
}


class Pen:
    """Draws in picture px on a sheet that is FINE times as large."""

    def __init__(self, sheet: Image.Image) -> None:
        self.draw = ImageDraw.Draw(sheet)

    def line(self, points: list[tuple[float, float]], colour: str, width: float = 1) -> None:
        """Draw a line through points."""
        self.draw.line([(x * FINE, y * FINE) for x, y in points], colour, round(width * FINE), joint="curve")

    def box(self, corners: tuple[float, float, float, float], fill: str, radius: float = 0) -> None:
        """Draw a filled rectangle x0, y0, x1, y1, with optional rounded corners."""
        self.draw.rounded_rectangle([value * FINE for value in corners], radius * FINE, fill)

    def dot(self, x: float, y: float, radius: float, colour: str) -> None:
        """Draw a filled circle."""
        self.draw.ellipse([value * FINE for value in (x - radius, y - radius, x + radius, y + radius)], colour)

    def shape(self, points: list[tuple[float, float]], colour: str) -> None:
        """Draw a filled polygon."""
        self.draw.polygon([(x * FINE, y * FINE) for x, y in points], colour)

    def text(self, x: float, y: float, text: str, colour: str = TEXT, size: float = 12, anchor: str = "la") -> None:
        """Draw text at a point, with Pillow's anchors."""
        self.draw.text((x * FINE, y * FINE), text, colour, ImageFont.load_default(size * FINE), anchor=anchor)

    def arrow(self, tail: tuple[float, float], length: float, colour: str) -> None:
        """Draw a horizontal arrow, to the left if its length is negative."""
        x, y = tail
        tip = x + length
        head = float(np.sign(length)) * min(7.0, abs(length))
        self.line([(x, y), (tip - head, y)], colour, 3)
        self.shape([(tip, y), (tip - head, y - 5), (tip - head, y + 5)], colour)


class Picture:
    """Draws the pictures of one story; the static parts are drawn once."""

    def __init__(self, story: Story) -> None:
        self.story = story
        shown = [(act.stop_ms - act.start_ms) / act.speed for act in story.acts]
        self._ms = [float(act.start_ms) for act in story.acts] + [float(story.acts[-1].stop_ms)]
        share = np.cumsum([0.0, *shown]) / sum(shown)
        self._x = (CHART_LEFT + share * (CHART_RIGHT - CHART_LEFT)).tolist()
        self._most_n = max(float(story.force_n[story.acts[0].start_ms : story.acts[-1].stop_ms].max()), 1e-9)
        self._before, self._after = (self._background(faint) for faint in (False, True))

    def draw(self, at_ms: int, shown_ms: int, events: Events, dot_xy_px: NDArray[np.floating]) -> Image.Image:
        """Return the picture at the end of a slice, with the events of the last shown_ms and the tracked dots."""
        story = self.story
        sheet = self._after.copy()
        cursor = round(self._across(at_ms) * FINE)
        past = (0, (CHART_TOP - 4) * FINE, cursor, TALL * FINE)
        sheet.paste(self._before.crop(past), past[:2])
        pen = Pen(sheet)
        pen.line([(cursor / FINE, CHART_TOP - 4), (cursor / FINE, CHART_TOP + 2 * CHART_STEP + CHART_TALL)], TEXT, 1.5)
        act = next(act for act in reversed(story.acts) if act.start_ms <= at_ms)
        pen.text(14, 33, self._caption(act, at_ms), TEXT, 13)
        pen.text(WIDE - 14, 8, _speed(act), ON if act.speed < 1 else TEXT, 17, "ra")
        pen.text(WIDE - 14, 33, f"{at_ms / 1000:.3f} s", TEXT, 13, "ra")
        self._scene(pen, at_ms)
        self._loupe(pen, at_ms, dot_xy_px)
        wide, tall = (round(side * VIEW) for side in reversed(story.frame_px))
        pen.text(CAMERA_LEFT + wide, TOP - 17, f"events of {shown_ms} ms", QUIET, 11, "ra")
        sheet.paste(self._events(events).resize((wide * FINE, tall * FINE), 0), (CAMERA_LEFT * FINE, TOP * FINE))
        self._dots(pen, dot_xy_px)
        self._readings(pen, at_ms)
        return sheet.resize((WIDE, TALL), Image.Resampling.BOX)

    def _caption(self, act: Act, at_ms: int) -> str:
        """Return a sentence that describes this moment."""
        story = self.story
        if act.name == "held":
            sunk_mm = self._sunk_px(at_ms, story.catch.onset_ms) * story.mm_per_px
            before = story.force_n[story.acts[1].start_ms]
            return f"Held, {sunk_mm:.1f} mm lower, with {story.force_n[at_ms]:.1f} N instead of {before:.1f} N."
        if act.name == "catch" and at_ms >= story.noticed_ms:
            return CAPTIONS["caught" if at_ms >= story.catch.stuck_ms else "noticed"]
        return CAPTIONS[act.name]

    # The upper row ----------------------------------------------------------------------------------------------------

    def _scene(self, pen: Pen, at_ms: int) -> None:
        """Draw hand, fingers and object over the table."""
        story = self.story
        wide_mm, tall_mm = story.object_mm
        left, right = SCENE
        bottom = TOP + round(story.frame_px[0] * VIEW)
        table = bottom - 14
        scale = (table - TOP - 8) / (tall_mm + 160)  # the hand's rise, and the hand itself
        middle = (left + right) / 2
        height = float(story.height_mm[at_ms])
        hand = height + self._sunk_px(at_ms, story.acts[0].start_ms) * story.mm_per_px
        half = wide_mm * scale / 2
        foot = table - height * scale
        pen.box((middle - half, foot - tall_mm * scale, middle + half, foot), OBJECT, 5)
        grip = table - (hand + 0.72 * tall_mm) * scale
        palm = table - (hand + tall_mm + 22) * scale
        for side in (-1, 1):
            inner = middle + side * half
            pen.box(_span(inner, inner + side * 5, grip - 11, grip + 11), GEL)
            pen.box(_span(inner + side * 5, inner + side * 14, palm, grip + 13), FINGER, 2)
            length = 36 * float(story.force_n[at_ms]) / self._most_n
            pen.arrow((inner + side * (16 + length), grip), -side * length, FORCE)
        pen.box((middle - half - 14, palm - 14, middle + half + 14, palm), FINGER, 3)
        pen.box((middle - 7, TOP + 1, middle + 7, palm - 8), FINGER)
        pen.box((left, table, right, bottom), RULE)
        if height > 12:
            pen.text(middle, table - 4, f"{height:.1f} mm", HEIGHT, 13, "md")

    def _loupe(self, pen: Pen, at_ms: int, dot_xy_px: NDArray[np.floating]) -> None:
        """Draw one finger's gel against the object, at the height of the camera's view, with enlarged motion."""
        story = self.story
        left, right = LOUPE
        face, back = left + 104, left + 172
        bottom = TOP + round(story.frame_px[0] * VIEW)
        pen.box((left, TOP, face, bottom), OBJECT)
        half_mm = 0.5 / story.mm_per_px * VIEW * ARROWS
        moved = self._sunk_px(at_ms, story.acts[0].start_ms) * VIEW * ARROWS
        for mark in range(-8, 12):
            y = TOP + 20 + mark * half_mm + moved
            if TOP + 2 < y < bottom - 2:
                pen.line([(face - 34, y), (face, y)], RULE, 2)
        end = TOP + (story.window_px[0] * VIEW if story.window_px else bottom - TOP)
        pen.box((face, TOP, back, end), GEL)
        # The gel's rows of dots are across the motion. Of each row, show the dot that moved most, where the object
        # touches.
        away = (dot_xy_px - story.rest_xy_px)[:, 0].reshape(-1, story.columns)
        most = np.take_along_axis(away, np.nanargmax(np.abs(away), axis=0)[None], axis=0)[0]
        for x_px, step in zip(np.nanmean(story.rest_xy_px[:, 0].reshape(away.shape), axis=0), most, strict=True):
            y = TOP + float(x_px) * VIEW
            bent = y + float(step) * VIEW * ARROWS
            pen.line([(back, y), ((face + back) / 2, y + 0.4 * (bent - y)), (face + 4, bent)], HAIR, 1.5)
            pen.dot(face + 4, bent, 3.5, TEXT)
        pen.box((back, TOP, back + 14, bottom), FINGER)
        force = float(story.force_n[at_ms])
        length = 60 * force / self._most_n
        pen.arrow((back + 4 + length, TOP + 112), -length, FORCE)
        pen.text(right - 6, TOP + 124, f"{force:.1f} N", FORCE, 14, "ra")
        if at_ms >= story.catch.onset_ms:
            sunk_mm = self._sunk_px(at_ms, story.catch.onset_ms) * story.mm_per_px
            pen.text(left + 8, bottom - 38, "sunk by", TEXT, 12)
            pen.text(left + 8, bottom - 23, f"{max(sunk_mm, 0.0):.1f} mm", TEXT, 15)

    def _sunk_px(self, at_ms: int, since_ms: int) -> float:
        """Return how far the object has moved down relative to the hand, in camera px."""
        return float(self.story.down_px[at_ms] - self.story.down_px[since_ms])

    def _events(self, events: Events) -> Image.Image:
        """Draw the camera's events, turned 90 degrees to the right."""
        wide, tall = self.story.frame_px
        coarse = round(1 / VIEW)
        drawn = event_image(
            events.x // np.uint16(coarse), events.y // np.uint16(coarse), events.p, (wide // coarse, tall // coarse)
        )
        image = Image.fromarray(np.ascontiguousarray(np.rot90(drawn, -1) + 1).astype(np.uint8))
        image.putpalette(bytes(value for colour in (OFF, PANEL, ON) for value in bytes.fromhex(colour[1:])))
        return image.convert("RGB")

    def _dots(self, pen: Pen, dot_xy_px: NDArray[np.floating]) -> None:
        """Draw lines from the dots at rest to the dots, enlarged, and the edge of the window."""
        story = self.story

        def turned(xy_px: NDArray[np.floating]) -> tuple[float, float]:
            return CAMERA_LEFT + (story.frame_px[1] - float(xy_px[1])) * VIEW, TOP + float(xy_px[0]) * VIEW

        for rest, dot in zip(story.rest_xy_px, dot_xy_px, strict=True):
            if np.isfinite(rest).all() and np.isfinite(dot).all():
                pen.line([turned(rest), turned(rest + ARROWS * (dot - rest))], TEXT, 2)
                pen.dot(*turned(rest), 2.2, TEXT)
        if story.window_px is not None:
            y = TOP + story.window_px[0] * VIEW
            right = CAMERA_LEFT + story.frame_px[1] * VIEW
            for x in np.arange(CAMERA_LEFT, right, 8.0).tolist():
                pen.line([(x, y), (x + 4, y)], TEXT, 1)

    # Charts -----------------------------------------------------------------------------------------------------------

    def _across(self, at_ms: float) -> float:
        return float(np.interp(at_ms, self._ms, self._x))

    def _background(self, faint: bool) -> Image.Image:
        """Draw the static parts: panels, names and charts; `faint` draws the curves pale, as still to come."""
        story = self.story
        sheet = Image.new("RGB", (WIDE * FINE, TALL * FINE), PAPER)
        pen = Pen(sheet)
        pen.text(14, 8, f"{story.title} (simulated)", TEXT, 17)
        bottom = TOP + round(story.frame_px[0] * VIEW)
        for (left, right), name in (
            (SCENE, "from the side"),
            (LOUPE, f"one finger's gel from the side, motion {ARROWS:g} x"),
            ((CAMERA_LEFT, CAMERA_LEFT + round(story.frame_px[1] * VIEW)), f"camera's view, dots {ARROWS:g} x"),
        ):
            pen.box((left, TOP, right, bottom), PANEL)
            pen.text(left, TOP - 17, name, QUIET, 11)
        x = LOUPE[1] - 6
        if story.window_px is not None:
            for line, text in enumerate(("the window", "shows the", "object")):
                pen.text(x, TOP + story.window_px[0] * VIEW + 4 + 13 * line, text, QUIET, 11, "ra")
        for x, text, colour in ((0, "brighter", ON), (54, "darker", OFF), (102, "dot, line from rest", TEXT)):
            pen.text(CAMERA_LEFT + x, bottom + 4, text, colour, 11)
        pen.text(LOUPE[0], bottom + 4, "marks on the object: 0.5 mm", QUIET, 11)
        self._charts(pen, faint)
        return sheet

    def _charts(self, pen: Pen, faint: bool) -> None:
        story = self.story
        last = CHART_TOP + 2 * CHART_STEP + CHART_TALL
        for act, left, right in zip(story.acts, self._x, self._x[1:], strict=False):
            slow = act.name == "catch"
            for row in range(3):
                top = CHART_TOP + row * CHART_STEP
                gap = 4 if row == 1 and act.name == "lift" else 1  # where the scale changes
                pen.box((left, top, right - gap, top + CHART_TALL), SLOW if slow else PANEL)
            pen.text((left + right) / 2, CHART_TOP - 17, _speed(act, short=not slow), QUIET, 11, "ma")
            pen.text(left, last + 4, f"{act.start_ms / 1000:.2f}", QUIET, 11, "ma")
        pen.text(self._x[-1], last + 4, f"{story.acts[-1].stop_ms / 1000:.2f} s", QUIET, 11, "ma")
        for row, (name, of) in enumerate((("gripper", ""), ("object", "height"), ("slip", "probability"))):
            pen.text(14, CHART_TOP + row * CHART_STEP + 9, name, TEXT, 12)
            pen.text(14, CHART_TOP + row * CHART_STEP + 24, of, QUIET, 12)
        pen.text(14, CHART_TOP + 24, "goal,", QUIET, 12)
        pen.text(44, CHART_TOP + 24, "position", TICKS, 12)
        pen.text(CHART_LEFT + 5, CHART_TOP + CHART_TALL - 3, "up: closes", QUIET, 10, "ld")
        start, near, stop = int(self._ms[0]), int(self._ms[1]), int(self._ms[-1])
        ticks = story.position_ticks[start:stop], story.goal_ticks[start:stop]
        ends = float(min(row.min() for row in ticks)), float(max(row.max() for row in ticks))
        self._curve(pen, 0, (start, stop), story.goal_ticks, ends, QUIET, faint)
        self._curve(pen, 0, (start, stop), story.position_ticks, ends, TICKS, faint)
        # The lift is drawn from the table upwards; everything after it on a scale of the few mm that it spans.
        close = story.height_mm[near:stop]
        ends = float(close.min()), float(close.max())
        self._curve(pen, 1, (start, near), story.height_mm, (0.0, ends[1]), HEIGHT, faint)
        self._curve(pen, 1, (near, stop), story.height_mm, ends, HEIGHT, faint)
        top = CHART_TOP + CHART_STEP
        pen.text(self._x[1] - 4, top + CHART_TALL - 3, f"0 to {ends[1]:.0f} mm", QUIET, 10, "rd")
        pen.text(self._x[1] + 4, top + CHART_TALL - 3, f"{ends[0]:.1f} to {ends[1]:.1f} mm", QUIET, 10, "ld")
        self._curve(pen, 2, (start, stop), story.probability, (0.0, 1.0), SLIP, faint)
        left, right = self._across(story.catch.onset_ms), self._across(story.catch.stuck_ms)
        top = CHART_TOP + 2 * CHART_STEP
        pen.box((left, top + CHART_TALL - 4, right, top + CHART_TALL - 1), SLIP)
        pen.text((left + right) / 2, top + CHART_TALL - 5, "truly slips", SLIP, 10, "md")

    def _readings(self, pen: Pen, at_ms: int) -> None:
        """Write the values of the charts at the cursor."""
        story = self.story
        probability = float(story.probability[at_ms])
        read = (
            (f"{story.position_ticks[at_ms]:.0f} ticks", TICKS),
            (f"{story.height_mm[at_ms]:.1f} mm", HEIGHT),
            (f"{probability:.2f}" if np.isfinite(probability) else "-", SLIP),
        )
        for row, (text, colour) in enumerate(read):
            pen.text(WIDE - 14, CHART_TOP + row * CHART_STEP + 16, text, colour, 13, "ra")

    def _curve(
        self,
        pen: Pen,
        row: int,
        span_ms: tuple[float, float],
        values: NDArray[Any],
        ends: tuple[float, float],
        colour: str,
        faint: bool,
    ) -> None:
        """Draw a series over part of the time axis; `ends` are the values at the bottom and the top of its chart."""
        foot = CHART_TOP + row * CHART_STEP + CHART_TALL - 4
        up = (CHART_TALL - 8) / max(ends[1] - ends[0], 1e-9)
        points = [
            (self._across(at), foot - (float(values[at]) - ends[0]) * up)
            for at in range(int(span_ms[0]), int(span_ms[1]))
            if np.isfinite(values[at])
        ]
        if len(points) > 1:
            pen.line(points, _mixed(colour, PANEL, 2 / 3) if faint else colour, 1.5)


def palette() -> Image.Image:
    """Return all colours of the film and the mixtures of overlapping ones; the last of 128 is never used.

    No two colours are closer than NEAR, because Pillow searches for the nearest colour in cells of four levels.
    """
    wanted = [PAPER, PANEL, SLOW, RULE, TEXT, QUIET, ON, OFF, GEL, HAIR, OBJECT, FINGER, FORCE, *CURVES[1:]]
    wanted += [_mixed(over, under, share) for under in OVER for over in OVER[under] for share in (1 / 3, 2 / 3)]
    colours: list[bytes] = []
    for colour in (bytes.fromhex(one[1:]) for one in wanted):
        if all(max(abs(a - b) for a, b in zip(colour, other, strict=True)) >= NEAR for other in colours):
            colours.append(colour)
    image = Image.new("P", (1, 1))
    image.putpalette(b"".join((colours + [colours[0]] * 128)[:128]))
    return image


def _speed(act: Act, *, short: bool = False) -> str:
    """Return the playback speed of an act as text."""
    if act.speed < 1:
        return f"1/{round(1 / act.speed)}" + ("" if short else " of real speed")
    return f"{act.speed:g} x" if short else ("real speed" if act.speed == 1 else f"{act.speed:g} x real speed")


def _span(x0: float, x1: float, y0: float, y1: float) -> tuple[float, float, float, float]:
    return min(x0, x1), y0, max(x0, x1), y1


def _mixed(colour: str, other: str, share: float) -> str:
    """Return a mixture of two colours."""
    mixed = [
        round(a * (1 - share) + b * share)
        for a, b in zip(bytes.fromhex(colour[1:]), bytes.fromhex(other[1:]), strict=True)
    ]
    return "#" + bytes(mixed).hex()
