"""The GIF animation of view: event images, dots and displacement arrows, with slip and events below."""

import io

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from evetac_cli.events import SLICES_PER_S
from evetac_cli.pages.shared import INK
from evetac_cli.pages.view.view_data import ViewData

WIDTH_PX = 480
MOST_FRAMES = 300
FRAME_MS = 60
ARROWS = 5.0  # times true length
HEAD_PX, CHART_PX, LANE_PX, FOOT_PX = 26, 56, 14, 16
LEGEND = "white: brighter, black: darker"
GUTTER_PX = 62  # left of the series: their names
PAPER, TEXT, QUIET, DOT, LOST, CURSOR = "#f6f7f8", "#1f2730", "#7f8790", "#ffb52e", "#ff5fa8", "#c58a00"


def render_film(view: ViewData, title: str) -> bytes:
    """Return a GIF of a page's event images, evenly thinned to 300; raise ValueError if there are none."""
    if not view.pictures:
        raise ValueError("expected at least one event image, found none")
    frame_indices = np.unique(np.linspace(0, len(view.pictures) - 1, MOST_FRAMES).round().astype(np.int64)).tolist()
    below = _below(view)
    # One palette for all frames, from the middle frame; frames are generated one at a time while writing.
    palette = _frame(view, frame_indices[len(frame_indices) // 2], title, below).quantize(32, dither=Image.Dither.NONE)
    frames = (
        _frame(view, at, title, below).quantize(palette=palette, dither=Image.Dither.NONE) for at in frame_indices
    )
    written = io.BytesIO()
    next(frames).save(written, "GIF", save_all=True, append_images=frames, duration=FRAME_MS, loop=0, optimize=False)
    return written.getvalue()


def _frame(view: ViewData, at: int, title: str, below: Image.Image) -> Image.Image:
    scale = WIDTH_PX / max(view.frame_px)
    wide, tall = (max(1, round(side * scale)) for side in view.frame_px)
    left = (WIDTH_PX - wide) // 2
    frame = Image.new("RGB", (WIDTH_PX, HEAD_PX + tall + below.height), PAPER)
    with Image.open(io.BytesIO(view.pictures[at])) as picture:
        small = picture.convert("L").resize((wide, tall), Image.Resampling.BOX)
    frame.paste(small, (left, HEAD_PX))
    frame.paste(below, (0, HEAD_PX + tall))
    pen = ImageDraw.Draw(frame)
    font = ImageFont.load_default(13)
    start_s = view.frame_times[at] / SLICES_PER_S
    pen.text((8, 5), _fitting(title, WIDTH_PX - 220, font), TEXT, font)
    remarks = ["simulated"] if view.simulated else []
    remarks += [f"arrows {ARROWS:g} x"] if view.dot_xy_px is not None else []
    clock = "   ".join([", ".join(remarks), f"{start_s:.3f} s"])
    pen.text((WIDTH_PX - 8, 5), clock, TEXT, font, anchor="ra")
    _dots(pen, view, at, scale, left)
    x = round(_across(view, start_s))
    pen.line((x, HEAD_PX + tall, x, frame.height - FOOT_PX), CURSOR, 2)
    return frame


def _fitting(text: str, room: int, font: ImageFont.FreeTypeFont | ImageFont.ImageFont) -> str:
    """Return as much of a text as fits into a width in px."""
    plain = "".join(letter if letter.isprintable() else "?" for letter in text)
    if font.getlength(plain) <= room:
        return plain
    while plain and font.getlength(plain + "...") > room:
        plain = plain[:-1]
    return plain + "..."


def _dots(pen: ImageDraw.ImageDraw, view: ViewData, at: int, scale: float, left: int) -> None:
    if view.dot_xy_px is None or view.rest_xy_px is None or view.lost is None:
        return
    limit = 10 * WIDTH_PX  # marks farther away are invisible, and Pillow may reject them
    for dot, rest, lost in zip(view.dot_xy_px[at], view.rest_xy_px, view.lost[at], strict=True):
        x, y = (float(value) * scale for value in dot)
        dx, dy = (float(value) * scale * ARROWS for value in dot - rest)
        if not all(abs(value) < limit for value in (x, y, dx, dy)):  # false for NaN too
            continue
        x, y = x + left, y + HEAD_PX
        colour = LOST if lost else DOT
        pen.ellipse((x - 3, y - 3, x + 3, y + 3), fill=colour, outline="#303030")
        if not lost and dx * dx + dy * dy > 4:  # the displacement of a lost dot is unknown
            pen.line((x, y, x + dx, y + dy), colour, 2)


def _below(view: ViewData) -> Image.Image:
    """Draw the chart of events per millisecond and the bars of slip, with times: the same below every frame."""
    image = Image.new("RGB", (WIDTH_PX, CHART_PX + LANE_PX * len(view.lanes) + FOOT_PX), PAPER)
    pen = ImageDraw.Draw(image)
    font = ImageFont.load_default(10)
    if view.panels:
        _chart(pen, view)
    for number, lane in enumerate(view.lanes):
        top = CHART_PX + LANE_PX * number
        for start, stop in lane.slip:
            left, right = _across(view, start), _across(view, stop)
            colour = QUIET if lane.colour == INK else lane.colour
            pen.rectangle((left, top + 3, max(right, left + 1), top + 11), fill=colour)
        pen.text((8, top + 1), lane.name, TEXT, font)
    foot = image.height - FOOT_PX + 3
    for at, anchor in zip(view.span, ("la", "ra"), strict=True):
        pen.text((_across(view, at / SLICES_PER_S), foot), f"{at / SLICES_PER_S:g} s", QUIET, font, anchor=anchor)
    pen.text(((GUTTER_PX + WIDTH_PX) / 2, foot), LEGEND, QUIET, font, anchor="ma")
    return image


def _across(view: ViewData, t_s: float) -> float:
    """Return the x coordinate of a time, in px."""
    first, last = (at / SLICES_PER_S for at in view.span)
    return GUTTER_PX + (t_s - first) / max(last - first, 1e-3) * (WIDTH_PX - 9 - GUTTER_PX)


def _chart(pen: ImageDraw.ImageDraw, view: ViewData) -> None:
    """Draw the first series of the page, which is the events if there are images: logarithmic, as on the page."""
    line = view.panels[0].lines[0]
    value = np.log10(line.value)
    low, high = float(np.nanmin(value)), float(np.nanmax(value))
    up = (CHART_PX - 14) / max(high - low, 1e-9)
    finite = np.isfinite(value)
    points = [
        (_across(view, float(t_s)), CHART_PX - 4 - (float(height) - low) * up)
        for t_s, height in zip(line.t_s[finite], value[finite], strict=True)
    ]
    if len(points) > 1:
        pen.line(points, line.colour, 1)
    font = ImageFont.load_default(10)
    pen.text((8, 4), f"{10**high:,.0f}", TEXT, font)
    pen.text((8, CHART_PX // 2 - 6), "events/ms", QUIET, font)
    pen.text((8, CHART_PX - 15), f"{10**low:,.0f}", TEXT, font)
