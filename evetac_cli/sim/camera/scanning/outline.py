"""Scans of an object's outline that moves over dots: which of its pixels may fire, and their events.

A rubbed object passes over some 20,000 pixels in a scan, and 300 of them fire. Under dots their level costs ten times
as much as the rest. So dots are drawn only when they have moved some way, and a pixel is left out if even a dot that
far off could not make it fire. Only the remaining pixels are compared with the exact image. Indices are unsigned: a
signed index may count from the end, which prevents vectorised loops.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.readout import event_key

# Largest distance of a dot from where it was drawn, on each axis. With more, more pixels are doubtful; with less, dots
# are drawn more often.
DRAWN_PX = 0.015
UNSURE = np.float32(-1e-6)  # level of a pixel at the rim of a drawn dot, where a slightly shifted dot would show

Pixels = NDArray[np.float32]


@njit(cache=True, _nrt=False)
def draw_dots(
    box: Floats,
    near: NDArray[np.uint8],
    inner: float,
    outer: float,
    steps_per_px: float,
    profile: Pixels,
    drawn_at: Floats,
    drawn_dots: Pixels,
) -> float:
    """Redraw the dots that have left the positions at which they were drawn; return the largest error of a drawn level.

    Dots stay within boxes (dots, 4) in this slice, apart from each other. `drawn_dots` (height, width) is 0 if no dot
    is near, and NaN where a dot moves too fast to be drawn. `drawn_at` (dots, 3) holds the position at which a dot was
    drawn and the reach of the drawing: negative for NaN, 0 if not drawn.
    """
    for dot in range(len(box)):
        far_x = abs(box[dot, 0] - drawn_at[dot, 0]) + box[dot, 2]
        far_y = abs(box[dot, 1] - drawn_at[dot, 1]) + box[dot, 3]
        if drawn_at[dot, 2] > 0.0 and max(far_x, far_y) <= DRAWN_PX:
            continue
        if drawn_at[dot, 2] != 0.0:
            first_x, end_x, first_y, end_y = _square(drawn_at[dot], drawn_dots.shape)
            drawn_dots[first_y:end_y, first_x:end_x] = 0.0
        drawn_at[dot, 2] = 0.0
        if not near[dot]:
            continue
        drawn_at[dot, 0] = box[dot, 0]
        drawn_at[dot, 1] = box[dot, 1]
        fast = max(box[dot, 2], box[dot, 3]) > DRAWN_PX
        drawn_at[dot, 2] = -(outer + max(box[dot, 2], box[dot, 3]) + 1.0) if fast else outer + 1.0
        first_x, end_x, first_y, end_y = _square(drawn_at[dot], drawn_dots.shape)
        for y in range(first_y, end_y):
            for x in range(first_x, end_x):
                if fast:
                    drawn_dots[y, x] = np.nan
                    continue
                across = x - box[dot, 0]
                down = y - box[dot, 1]
                distance2 = across * across + down * down
                if distance2 <= (outer + 2.0 * DRAWN_PX) ** 2:
                    position = optics.profile_position(
                        np.float32(distance2), np.float32(inner), np.float32(steps_per_px)
                    )
                    drawn_dots[y, x] = min(optics.profile_level(position, profile), UNSURE)
    steepest = 0.0
    for k in range(len(profile) - 1):
        steepest = max(steepest, abs(float(profile[k + 1]) - float(profile[k])))
    return 1.5 * DRAWN_PX * steepest * steps_per_px + 1e-4


@njit(cache=True, _nrt=False)
def _square(drawn_at: Floats, shape: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return the pixels of a frame that the drawing of a dot covers: columns from, up to, rows from, up to."""
    reach = abs(drawn_at[2])
    height, width = shape
    first_x = min(max(math.floor(drawn_at[0] - reach), 0), width)
    end_x = min(max(math.ceil(drawn_at[0] + reach) + 1, first_x), width)
    first_y = min(max(math.floor(drawn_at[1] - reach), 0), height)
    end_y = min(max(math.ceil(drawn_at[1] + reach) + 1, first_y), height)
    return first_x, end_x, first_y, end_y


@njit(cache=True, _nrt=False)
def shift_outline(
    picture: Pixels,
    place: tuple[float, float, float],
    rows: tuple[int, int],
    runs: NDArray[np.int64],
    seen_level: Pixels,
    pixels: tuple[Pixels, Pixels, Pixels, Pixels],
    dots_and_error: tuple[Pixels, float],
    line: Pixels,
    doubtful: NDArray[np.uint8],
) -> None:
    """Apply an outline at a position (corner x, y, strength): shift the references by its change, with opposite sign.

    `runs` (height, 4) are its pixels in these rows (first, end). `pixels` are their references, thresholds, squared
    quiet radii and shifts (see GelPixels). `dots_and_error` are the drawn dots and their largest error. Fills the runs
    in `doubtful` (height, a multiple of eight): 1 for pixels that may fire, else 0.
    """
    corner_x, corner_y, strength = place
    reference, threshold, lower2, _ = pixels
    dots, margin_level = dots_and_error
    margin = np.float32(margin_level)
    picture_rows, picture_columns = picture.shape
    one, zero = np.uint64(1), np.uint64(0)
    for row in range(rows[0], rows[1]):
        for side in range(2):
            first = runs[row, 2 * side]
            count = runs[row, 2 * side + 1] - first
            if count <= 0:
                continue
            # As in contact_edges.sample_row, to the bit.
            upper_row = math.floor(row - corner_y)
            column = math.floor(first - corner_x)
            begin = count
            stop = count
            if strength != 0.0 and 0 <= upper_row < picture_rows - 1:
                begin = min(max(-column, 0), count)
                stop = max(begin, min(picture_columns - 1 - column, count))
            for k in range(zero, np.uint64(begin)):
                line[k] = 0.0
            for k in range(np.uint64(stop), np.uint64(count)):
                line[k] = 0.0
            part_x = first - corner_x - column
            part_y = row - corner_y - upper_row
            upper_left = np.float32(strength * (1.0 - part_y) * (1.0 - part_x))
            upper_right = np.float32(strength * (1.0 - part_y) * part_x)
            lower_left = np.float32(strength * part_y * (1.0 - part_x))
            lower_right = np.float32(strength * part_y * part_x)
            above = np.uint64(upper_row)
            below = above + one
            shifted = np.uint64(column)
            for k in range(np.uint64(begin), np.uint64(stop)):
                column_at = k + shifted
                line[k] = (
                    upper_left * picture[above, column_at]
                    + upper_right * picture[above, column_at + one]
                    + lower_left * picture[below, column_at]
                    + lower_right * picture[below, column_at + one]
                )
            y = np.uint64(row)
            offset = np.uint64(first)
            for k in range(zero, np.uint64(count)):
                at = k + offset
                reference[y, at] -= line[k] - seen_level[y, at]
                seen_level[y, at] = line[k]
            for k in range(offset, np.uint64(first + count)):
                lower2[y, k] = np.inf
            for x in range(offset, np.uint64(first + count)):
                off = margin if dots[y, x] < np.float32(0.0) else np.float32(0.0)
                doubtful[y, x] = not (abs(dots[y, x] - reference[y, x]) + off < threshold[y, x])


@njit(cache=True, _nrt=False)
def compare_outline(
    dot_xy: Floats,
    ink: tuple[Any, ...],
    rows: tuple[int, int],
    runs: NDArray[np.int64],
    doubtful: NDArray[np.uint8],
    pixels: tuple[Pixels, Pixels, Pixels, Pixels],
    drawn_dots: Pixels,
    readout_us: NDArray[np.int64],
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Compare the doubtful pixels of `shift_outline` with the image of dots (dots, 2); return the number of events.

    Eight pixels are checked at a time. Scans of the dots since then may have made a doubtful pixel fire, after which it
    is quiet; they make no pixel fire that was not doubtful.
    """
    reference, threshold, _, middle_shift = pixels
    shifted = middle_shift.size > 0
    in_a_row = doubtful.shape[1] // 8
    nearest = 0
    eights = doubtful.reshape(-1).view(np.uint64)
    for row in range(rows[0], rows[1]):
        for side in range(2):
            first = runs[row, 2 * side]
            end = runs[row, 2 * side + 1]
            if first >= end:
                continue
            for word in range(first // 8, (end - 1) // 8 + 1):
                if eights[row * in_a_row + word] == 0:
                    continue
                for x in range(max(first, 8 * word), min(end, 8 * word + 8)):
                    if doubtful[row, x] == 0:
                        continue
                    level = np.float32(0.0)
                    if drawn_dots[row, x] != np.float32(0.0):
                        level, nearest = _dot_level(dot_xy, ink, x, row, nearest)
                    change = level - reference[row, x]
                    if abs(change) < threshold[row, x]:
                        continue
                    reference[row, x] = level + middle_shift[row, x] if shifted else level
                    if event_count < len(keys):
                        keys[event_count] = event_key(readout_us[x], x, row, change > 0)
                    event_count += 1
    return event_count


@njit(cache=True, _nrt=False)
def _dot_level(dot_xy: Floats, ink: tuple[Any, ...], x: int, y: int, guess: int) -> tuple[np.float32, int]:
    """Return the log brightness of one pixel, equal to `optics.dot_row` to the bit, and the dot there.

    The search for the dot starts at `guess`. The distance between dots is larger than their reach, so there is at most
    one.
    """
    inner, outer, steps_per_px, profile = ink
    dots = len(dot_xy)
    level = np.float32(0.0)
    for number in range(guess, guess + dots):
        dot = number if number < dots else number - dots
        down = y - dot_xy[dot, 1]
        if abs(down) > outer or abs(x - dot_xy[dot, 0]) > outer + 1.0:
            continue
        half = math.sqrt(outer * outer - down * down)
        if math.ceil(dot_xy[dot, 0] - half) <= x <= math.floor(dot_xy[dot, 0] + half):
            down2 = np.float32(down) * np.float32(down)
            across = np.float32(x - dot_xy[dot, 0])
            position = optics.profile_position(across * across + down2, np.float32(inner), np.float32(steps_per_px))
            level = min(level, optics.profile_level(position, profile))
        return level, dot
    return level, guess
