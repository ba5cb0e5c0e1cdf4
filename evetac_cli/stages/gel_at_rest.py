"""Images of the gel at rest from a press recording, one from each half of its strokes."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import SLICES_PER_S
from evetac_cli.jobs import Progress, silent
from evetac_cli.kernels.calibration import dot_search, rest_image
from evetac_cli.kernels.calibration.gel_layout import Grid
from evetac_cli.kernels.calibration.rest_image import RestImage
from evetac_cli.stages.calibrated_gel import PRESS
from evetac_cli.store.recordings.read import Recording

BLOCK_SLICES = 200
SETTLING_SLICES = 100  # after a stroke, while pixels at the rims of dots still fire
LEAST_REST_SLICES = 1000  # in total, to identify hot pixels
LONGEST_STROKE = 5000  # slices; a first run ends long before that


def rest_images(recording: Recording, progress: Progress = silent) -> tuple[RestImage, RestImage]:
    """Return images of the gel at rest from every other pair of strokes and from the other pairs.

    InputError if there is no stroke.
    """
    if not strokes(recording):
        moved = dot_search.contrast(seen(recording, 0, len(recording))) > 0
        message = "the gel is not at rest before and after a stroke" if moved else "no dot was seen to move"
        raise InputError(message, where=str(recording.path), hint=PRESS)
    nothing = np.zeros(recording.frame_px[::-1], np.uint8)
    halves = [RestImage(nothing, nothing), RestImage(nothing, nothing)]
    for half, (_, stop), (before, after) in stroke_images(recording):
        halves[half] = halves[half].joined(before).joined(after)
        progress(stop, len(recording))
    return halves[0], halves[1]


def stroke_images(recording: Recording) -> Iterator[tuple[int, tuple[int, int], tuple[RestImage, RestImage]]]:
    """Yield for each stroke its half of the strokes, 0 or 1, its slices, and the gel at rest before and after it."""
    for stroke, (start, stop) in enumerate(strokes(recording)):
        half = stroke // 2 % 2  # a pair of strokes: there and back
        yield half, (start, stop), (seen(recording, start, stop), seen(recording, start, stop, backwards=True))


def strokes(recording: Recording) -> list[tuple[int, int]]:
    """Return the slices [start, stop) of each stroke, from the middle of the rest before to that of the rest after."""
    rests = [(first + stop) // 2 for first, stop in rest_image.quiet_spells(np.diff(recording.starts))]
    return list(zip(rests, rests[1:], strict=False))


def seen(recording: Recording, start: int, stop: int, *, backwards: bool = False) -> RestImage:
    """Return the gel at rest before the slices [start, stop), from their events; backwards: at rest after them."""
    if backwards:
        edges = range(stop, max(start, stop - LONGEST_STROKE), -BLOCK_SLICES)
        blocks = [(max(start, edge - BLOCK_SLICES), edge) for edge in edges]
    else:
        edges = range(start, min(stop, start + LONGEST_STROKE), BLOCK_SLICES)
        blocks = [(edge, min(stop, edge + BLOCK_SLICES)) for edge in edges]
    state = rest_image.start(recording.frame_px)
    for first, last in blocks:
        events = recording.between(first, last)
        rest_image.step(state, events.x, events.y, events.p, backwards=backwards)
    return rest_image.image(state)


def hot_pixels(recording: Recording) -> NDArray[np.uint16] | None:
    """Return the pixels (n, 2) that fire while the gel is at rest between strokes, row by row; None if unknown."""
    from evetac_cli.kernels.identify.rest import check_still, find_hot

    width, height = recording.frame_px
    counts, slices = np.zeros(width * height, np.int64), 0
    for first, stop in rest_image.quiet_spells(np.diff(recording.starts)):
        settled = min(first + SETTLING_SLICES, stop)
        events = recording.between(settled, stop)
        counts += np.bincount(events.y.astype(np.int64) * width + events.x, minlength=len(counts))
        slices += stop - settled
    if slices < LEAST_REST_SLICES:
        return None
    hot = find_hot(counts, slices / SLICES_PER_S).reshape(height, width)
    try:
        check_still(hot)
    except ValueError:
        return None
    rows, columns = np.nonzero(hot)
    return np.column_stack([columns, rows]).astype(np.uint16)


def jitter_px(halves: tuple[RestImage, RestImage], dots: Grid, radius: float) -> float:
    """Return how far a dot is from its mean position in one half of the strokes, rms over dots, in px.

    NaN if the halves have no dot in common.
    """
    present = dots[np.isfinite(dots[..., 0])]
    if any(dot_search.contrast(half) == 0.0 for half in halves):
        return float("nan")
    first, second = (dot_search.fit(half, present, radius).centre_xy_px for half in halves)
    apart = np.sum((first - second) ** 2, axis=1)
    apart = apart[np.isfinite(apart)]
    return float(np.sqrt(apart.mean() / 2)) if len(apart) else float("nan")
