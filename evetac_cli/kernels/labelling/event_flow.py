"""When an object slips, from counted events: flow of dots and window to a fraction of a pixel, without images.

An event says that a pixel's log brightness moved by one threshold. So the events that an edge makes are a measure of
how far it moved: a dot's rim makes as many a pixel of motion as its contrast spans thresholds, and a texture in the
window makes a number that is measured in the recording itself, while the object still sticks to the gel. Both flows
follow by counting, at any speed; optical flow of images needs events enough to recognise a pattern, which slow motion
does not make.

The object slips when it has slid `slip_distance_px` since it last moved with any part of the gel.

Why so:
- The gel's flow is that of the dot which follows the object best. Dots away from the contact never move, and before
  gross slip ever more of the pad slips while the rest still holds: only when nothing follows any more is slip gross.
  What still holds may lie between the dots or beside the picture, where a dot sees a twentieth of it.
- A dot follows while it goes farther from its place at rest. That holds for every direction in which the object may
  drag the gel, also where the object turns and every dot moves in another direction.
- A rim whose motion turns back makes no events for some tenths of a pixel, until brightness has gone back by a
  threshold. A dot that snapped back may hold again unseen, and counts as holding while the object moves `hidden_px`.
- The window's events a pixel fall with the distance travelled: the pixels start anywhere between two thresholds, but
  later every turn of the texture's slope costs as much brightness as a threshold before events come again. After a
  distance s it makes fresh / (1 + s / fading_px) events a pixel, so N events are a distance of
  fading_px (exp(N / (fresh fading_px)) - 1).
- `fresh` is the median over steps of 50 ms in which the dots that move most took the object along. Steps after a slice
  are not used, as they may contain the slip.

The constants were fixed on 308 simulated recordings of all 20 objects, recorded with seeds 0, 20, 1000 and 1500.
`slip_distance_px` and `follow_share` are those with which most labels lie within -4 to +3 ms of gross slip, and few
before: 0.75 of 40 (seed 700) and 0.79 of 38 (seed 800). With 0.5 px and 0.95 they waited for the pad's last stuck node:
0.33 and 0.63. A share of 0.65 finds more, 0.78 and 0.82, and on a coarse gel one 24 ms early. Where the rule fails: an
object touched beside the picture, a flat one whose last holding corner lies there, and one that turns, of which every
part slips for short times only.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.checks import check_range
from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.labelling.flow import Between, Labels, Region

BLOCK_SLICES = 1000  # events are asked for in blocks of so many slices
STEP_MS = 50  # of the measurement of the window's events a pixel, and of its noise
LAG_MS = 30  # a slice uses only steps that ended so long before: later ones may hold the slip itself
LEAST_STEP_PX = 0.15  # the gel must have moved so far in a step for it to be used
LEAST_STEPS = 2
LEADING_DOTS = 3  # the dots that go farthest went with the object
HOT_BLOCK_US = 100_000
HOT_SHARE = 0.5  # a pixel with events in more of these blocks is hot; edges pass it only now and then
CELL_PX = 35.0  # events farther from every dot's place at rest belong to none
RING_PX = 8.0  # and so do those farther off its rim
MOST_FADED = 6.0  # exponent beyond which the window is no measure: four hundred times fading_px
TRAVEL_PX = 1.5  # when the gel was dragged so far, a texture would have been seen


@dataclass(frozen=True)
class EventFlowConstants:
    """Constants of slip labels by counting; ValueError unless all are finite and in range."""

    slip_distance_px: float = 0.3  # the object has slid so far: the onset
    look_ahead_ms: int = 4  # a slice's speeds are means over the next so many ms
    edge_events: float = 6.9  # thresholds that a dot's rim crosses: log contrast over threshold, less what scans miss
    follow_ms: int = 3  # whether a dot follows is seen over so many ms, the slice the last of them
    follow_share: float = 0.75  # a dot slower than the object by more than this share of its speed does not follow
    least_px_ms: float = 0.01  # and by more than this
    back_px_ms: float = 0.05  # a dot that goes back faster snaps back
    hidden_px: float = 0.2  # after that its motion forward is unseen for so long
    pause_ms: int = 2  # the count of the slide survives so many slices in which a dot follows
    events_per_px: float = 500.0  # of the window before it has moved, until the recording tells
    fading_px: float = 30.0  # after so much travel the window makes half the events a pixel
    least_events_per_px: float = 20.0  # of the window: less is no texture
    after_ms: int = 60  # slices labelled after the onset

    def __post_init__(self) -> None:
        may_be_zero = ("follow_share", "least_px_ms", "back_px_ms", "hidden_px", "pause_ms", "after_ms")
        for name, value in vars(self).items():
            check_range(name, value, above=name not in may_be_zero)
        check_range("follow_share", self.follow_share, 0.0, 1.0, below=True)


class ImageMotion(NamedTuple):
    """Motion up to the start of every slice of a block, and after its last, as measured by the events."""

    dot_px: Floats  # (slices + 1, dots, 2) displacement of every dot from its place at rest
    window_events: NDArray[np.int64]  # (slices + 1,) events of the window, counted from the start of the recording


def label(
    between: Between,
    slices: int,
    window: Region,
    gel: Region,
    dot_xy_px: Floats,
    dot_radius_px: float,
    constants: EventFlowConstants,
    start: int = 0,
) -> Labels:
    """Label every slice, the onset searched from slice `start` on; `dot_xy_px` (dots, 2) at rest, NaN where missing.

    Slices before `start`, and `after_ms` and more after the onset, are not examined. `relative_flow_px` is the flow of
    the window against the dot that follows it best over the look-ahead, `confidence` the share of the slices labelled
    from the onset on in which nothing follows. ValueError if the gel was dragged along and the window showed nothing.
    """
    dots = np.ascontiguousarray(dot_xy_px[np.isfinite(dot_xy_px).all(axis=1)], np.float64)
    if not len(dots) or not 0.0 < dot_radius_px < math.inf:
        raise ValueError(f"dots: expected some with a radius > 0, found {len(dots)} of radius {dot_radius_px}")
    part = pixel_parts(between, slices, window, gel, dots)
    given = between, slices, part, dots, dot_radius_px, constants.edge_events
    window_events = np.zeros(slices + 1, np.int64)
    leading = [0.0]
    dragged = 0.0
    for first, motion in follow(*given):
        window_events[first : first + len(motion.window_events)] = motion.window_events
        led = _leading(_away(motion))
        leading += led[1:][(first + 1 + np.arange(len(led) - 1)) % STEP_MS == 0].tolist()
        dragged = max(dragged, float(led.max()))
    moved = np.maximum.accumulate(window_events - noise_rate(window_events) * np.arange(slices + 1))
    fresh = events_per_px(moved, np.array(leading), constants.events_per_px, constants.fading_px)
    if dragged > TRAVEL_PX and fresh[-1] < constants.least_events_per_px:
        raise ValueError(
            f"texture: expected at least {constants.least_events_per_px:g} events a pixel of motion in the window, "
            f"found {fresh[-1]:.1f} while the gel was dragged by {dragged:.1f} px"
        )
    object_px = travel(moved, np.maximum(fresh, constants.least_events_per_px), constants.fading_px)
    onset, slips, relative_px = _find(object_px, follow(*given), len(dots), start, constants)
    labels = np.zeros(slices, np.int8)
    labels[:start] = -1
    confidence = float("nan")
    if onset >= 0:
        stop = min(onset + max(constants.after_ms, 1), slices)
        labels[onset:stop] = slips[onset:stop]
        labels[stop:] = -1
        confidence = float(slips[onset:stop].mean())
    return Labels(labels, relative_px, onset, confidence, 0)


def pixel_parts(between: Between, slices: int, window: Region, gel: Region, dots: Floats) -> NDArray[np.int16]:
    """For each pixel (height, width) the index of its dot, WINDOW or NOTHING; hot pixels, too, belong to nothing."""
    height, width = max(window[3], gel[3]), max(window[2], gel[2])
    last = np.full((height, width), -1, np.int64)
    busy = np.zeros((height, width), np.int64)
    for first in range(0, slices, BLOCK_SLICES):
        events = between(first, min(first + BLOCK_SLICES, slices))
        _count_blocks(events.t, events.x, events.y, last, busy)
    hot = busy > max(HOT_SHARE * slices * SLICE_US / HOT_BLOCK_US, 2.0)
    return _parts(hot, dots, window, gel)


def follow(
    between: Between, slices: int, part: NDArray[np.int16], dots: Floats, radius_px: float, edge_events: float
) -> Iterator[tuple[int, ImageMotion]]:
    """Follow every dot by the polarity of its rim's events, and count the window's: first slice and motion of blocks.

    A dark dot that moves along e gets brighter at its rear and darker in front, with `edge_events` events at every
    rim pixel: the sum of -polarity * normal over its events is pi * radius * edge_events a pixel of motion.
    """
    centre = dots.copy()
    step = 1.0 / (math.pi * radius_px * edge_events)
    counted = 0
    for first in range(0, slices, BLOCK_SLICES):
        stop = min(first + BLOCK_SLICES, slices)
        dot_px = np.empty((stop - first + 1, len(dots), 2))
        dot_px[0] = centre - dots
        window_events = np.zeros(stop - first + 1, np.int64)
        _follow(tuple(between(first, stop)), part, (dots, centre, radius_px, step), first, stop, dot_px, window_events)
        window_events = counted + np.cumsum(window_events)
        counted = int(window_events[-1])
        yield first, ImageMotion(dot_px, window_events)


def _away(motion: ImageMotion) -> Floats:
    """How far the dots are from rest, (slices + 1, dots)."""
    return np.hypot(motion.dot_px[..., 0], motion.dot_px[..., 1])


def _find(
    object_px: Floats,
    blocks: Iterator[tuple[int, ImageMotion]],
    dots: int,
    start: int,
    constants: EventFlowConstants,
) -> tuple[int, NDArray[np.bool_], NDArray[np.float32]]:
    """The onset, slice or -1, and what `_search` says of every slice; the motion of the dots comes in blocks."""
    slices = len(object_px) - 1
    slips = np.zeros(slices, np.bool_)
    relative_px = np.empty(slices, np.float32)
    since_back_px = np.full(dots, np.inf)
    counts = np.array([0.0, 0.0, -1.0])
    thresholds = (
        constants.slip_distance_px,
        constants.look_ahead_ms,
        constants.follow_ms,
        constants.follow_share,
        constants.least_px_ms,
        constants.back_px_ms,
        constants.hidden_px,
        constants.pause_ms,
    )
    away = np.zeros((1, dots))
    base = searched = 0  # away begins at row `base`; slices before `searched` are done
    for first, motion in blocks:
        away = np.concatenate([away, _away(motion)[1:]])
        known = first + len(motion.dot_px) - 1
        until = known if known == slices else max(known - constants.look_ahead_ms + 1, searched)
        _search(
            object_px,
            away,
            base,
            searched,
            until,
            start,
            thresholds,
            (since_back_px, counts, slips, relative_px),
        )
        searched = until
        keep = max(searched + 1 - constants.follow_ms, 0)
        away, base = away[max(keep - base, 0) :], max(keep, base)
    return int(counts[2]), slips, relative_px


def noise_rate(window_events: NDArray[np.int64]) -> float:
    """Events a slice that the window makes at rest: the least over steps of 50 ms, or of what there is."""
    steps = window_events[::STEP_MS]
    return float(np.diff(steps).min() / STEP_MS) if len(steps) > 1 else 0.0


def events_per_px(moved: Floats, leading: Floats, assumed: float, fading_px: float) -> Floats:
    """The events a pixel of motion that the window made before it moved, as known in every slice: (slices,).

    `moved` (slices + 1,) counts events without noise, `leading` is how far the leading dots are from rest, every
    STEP_MS slices. Of all earlier steps the median, weighted by how far these dots went; `assumed` before.
    """
    gone = np.diff(leading)
    seen = np.diff(moved[::STEP_MS]) * (1.0 + 0.5 * (leading[1:] + leading[:-1]) / fading_px)
    used = gone > LEAST_STEP_PX
    used[:1] = False  # in the first step the dots jump from rest to where they are
    steps = np.cumsum(used)  # of use up to each
    medians = _medians(seen[used] / gone[used], gone[used])
    known = np.full(len(moved) - 1, assumed)
    ended = (np.arange(len(known)) - LAG_MS) // STEP_MS - 1  # step that a slice may use, with all before it
    of_use = steps[np.clip(ended, 0, None)] if len(steps) else np.zeros(len(known), np.int64)
    tells = (ended >= 0) & (of_use >= LEAST_STEPS)
    known[tells] = medians[of_use[tells] - 1]
    return known


@njit(cache=True)
def _medians(rates: Floats, weights: Floats) -> Floats:
    """Weighted median of the first value, the first two, and so on; sorted by insertion, so that an hour is quick."""
    medians, reached = np.empty(len(rates)), np.empty(len(rates))
    ordered, ordered_weights = np.empty(len(rates)), np.empty(len(rates))
    for count in range(len(rates)):
        at = count
        while at > 0 and (
            ordered[at - 1] > rates[count]
            or (ordered[at - 1] == rates[count] and ordered_weights[at - 1] > weights[count])
        ):
            ordered[at] = ordered[at - 1]
            ordered_weights[at] = ordered_weights[at - 1]
            at -= 1
        ordered[at] = rates[count]
        ordered_weights[at] = weights[count]
        for place in range(at, count + 1):
            reached[place] = ordered_weights[place] + (reached[place - 1] if place else 0.0)
        half = 0
        while reached[half] < 0.5 * reached[count]:
            half += 1
        medians[count] = ordered[half]
    return medians


def travel(moved: Floats, fresh: Floats, fading_px: float) -> Floats:
    """How far the object has gone by the window's events `moved` (slices + 1,) without noise, in px: (slices + 1,).

    `fresh` (slices,) is what `events_per_px` knows.
    """
    faded = np.exp(np.minimum(moved[:-1] / (fresh * fading_px), MOST_FADED))
    steps_px = np.diff(moved) / fresh * faded
    return np.concatenate([[0.0], np.cumsum(steps_px)])


def _leading(away: Floats) -> Floats:
    """Mean distance from rest of the three dots that went farthest, in each row of (rows, dots)."""
    return np.asarray(np.sort(away, axis=1)[:, -LEADING_DOTS:].mean(axis=1), np.float64)


@njit(cache=True)
def _count_blocks(
    t: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    last: NDArray[np.int64],
    busy: NDArray[np.int64],
) -> None:
    """Count in `busy` (height, width) the blocks of time in which each pixel had events."""
    height, width = busy.shape
    for event in range(len(t)):
        if y[event] >= height or x[event] >= width:
            continue
        block = t[event] // HOT_BLOCK_US
        if last[y[event], x[event]] != block:
            last[y[event], x[event]] = block
            busy[y[event], x[event]] += 1


WINDOW = -2
NOTHING = -1


def _parts(hot: NDArray[np.bool_], dots: Floats, window: Region, gel: Region) -> NDArray[np.int16]:
    """For each pixel (height, width) the index of its dot, WINDOW or NOTHING."""
    part = np.full(hot.shape, NOTHING, np.int16)
    nearest = np.full(hot.shape, np.inf)
    for index, (dot_x, dot_y) in enumerate(dots):
        left, right = max(int(dot_x - CELL_PX), gel[0], 0), min(int(dot_x + CELL_PX) + 2, gel[2])
        top, bottom = max(int(dot_y - CELL_PX), gel[1], 0), min(int(dot_y + CELL_PX) + 2, gel[3])
        if left >= right or top >= bottom:
            continue
        rows, columns = np.mgrid[top:bottom, left:right]
        distance = np.hypot(columns - dot_x, rows - dot_y)
        closer = (distance < nearest[top:bottom, left:right]) & (distance <= CELL_PX)
        nearest[top:bottom, left:right][closer] = distance[closer]
        part[top:bottom, left:right][closer] = index
    x0, y0, x1, y1 = window
    part[y0:y1, x0:x1] = WINDOW
    part[hot] = NOTHING
    return part


@njit(cache=True)
def _follow(
    columns: tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]],
    part: NDArray[np.int16],
    dots: tuple[Floats, Floats, float, float],
    first: int,
    stop: int,
    dot_px: Floats,
    window_events: NDArray[np.int64],
) -> None:
    """Move the centres by the events of the slices [first, stop), and write them down at the end of every slice.

    dots: their places at rest and now, their radius, and how far an event moves one.
    """
    t, x, y, p = columns
    rest, centre, radius, step = dots
    height, width = part.shape
    event = 0
    for slice_ in range(first, stop):
        end_us = (slice_ + 1) * SLICE_US
        while event < len(t) and t[event] < end_us:
            column = x[event]
            row = y[event]
            brighter = p[event] > 0
            event += 1
            if row >= height or column >= width:
                continue
            dot = part[row, column]
            if dot == WINDOW:
                window_events[slice_ + 1 - first] += 1
            if dot < 0:
                continue
            right = column - centre[dot, 0]
            down = row - centre[dot, 1]
            distance = math.sqrt(right * right + down * down)
            if abs(distance - radius) > RING_PX or distance == 0.0:
                continue
            moved = -step if brighter else step
            centre[dot, 0] += moved * right / distance
            centre[dot, 1] += moved * down / distance
        for dot in range(len(rest)):  # a whole row at once would have numba compile words about shapes
            for axis in range(2):
                dot_px[slice_ + 1 - first, dot, axis] = centre[dot, axis] - rest[dot, axis]


@njit(cache=True)
def _search(
    object_px: Floats,
    away_px: Floats,
    base: int,
    first: int,
    stop: int,
    start: int,
    thresholds: tuple[float, int, int, float, float, float, float, int],
    result: tuple[Floats, Floats, NDArray[np.bool_], NDArray[np.float32]],
) -> None:
    """Go on with the search for the onset over the slices [first, stop), of which `away_px` holds the rows from `base`.

    Fills in, for each slice, in `slips` whether no dot follows the object, and in `relative_px` how far the object
    slips, over the look-ahead, past the dot that follows it best. From block to block go `since_back_px` (dots,) and
    `counts`: px slid, ms paused, and the slice of the onset or -1.

    thresholds: slip_distance_px, look_ahead_ms, follow_ms, follow_share, least_px_ms, back_px_ms, hidden_px, pause_ms.
    result: since_back_px, counts, slips, relative_px.
    """
    slip_distance_px, look_ahead_ms, follow_ms, follow_share, least_px_ms, back_px_ms, hidden_px, pause_ms = thresholds
    since_back_px, counts, slips, relative_px = result
    slices = len(object_px) - 1
    dots = away_px.shape[1]
    slid_px = counts[0]
    paused_ms = int(counts[1])
    onset = int(counts[2])
    for slice_ in range(first, stop):
        end_slice = min(slice_ + look_ahead_ms, slices)
        begin = max(slice_ + 1 - follow_ms, 0)
        span = end_slice - slice_
        follow_span = slice_ + 1 - begin
        object_px_ms = (object_px[end_slice] - object_px[slice_]) / span
        recent_px_ms = (object_px[slice_ + 1] - object_px[begin]) / follow_span
        closest = np.inf
        best_px = np.inf
        for dot in range(dots):
            dot_px_ms = (away_px[end_slice - base, dot] - away_px[slice_ - base, dot]) / span
            best_px = min(best_px, (object_px_ms - dot_px_ms) * span)
            behind = recent_px_ms - (away_px[slice_ + 1 - base, dot] - away_px[begin - base, dot]) / follow_span
            if dot_px_ms < -back_px_ms:
                since_back_px[dot] = 0.0
            else:
                since_back_px[dot] += object_px_ms
                if since_back_px[dot] < hidden_px:
                    behind = 0.0
            closest = min(closest, behind)
        relative_px[slice_] = best_px
        slips[slice_] = closest > max(least_px_ms, follow_share * recent_px_ms)
        if slice_ < start or onset >= 0:
            continue
        if slips[slice_]:
            slid_px += best_px / span
            paused_ms = 0
        else:
            paused_ms += 1
            if paused_ms > pause_ms:
                slid_px = 0.0
        if slid_px > slip_distance_px:
            onset = slice_
    counts[0] = slid_px
    counts[1] = paused_ms
    counts[2] = onset
