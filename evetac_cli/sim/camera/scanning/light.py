"""Light that flickers or steps: the brightness of all pixels of a scanning camera changes together.

In log brightness a change of the light adds the same number to every level. Instead, that number is subtracted from the
references, once per slice, at its last scan, and the pixels that cross their threshold fire there. So the camera sees
the light in steps of 1 ms (ten steps per period at 100 Hz). A step of light takes effect in the first slice whose last
scan is after it.

Each run of pixels has bounds: the highest and the lowest level of the light up to which none of its pixels fires. They
hold until a dot, a line or leak changes the levels of the run. A slice costs the shift of the references, and the
comparison of runs that are crossed or have changed. Candidate pixels of moving dots hold for the whole range of a
flicker (`candidate_light`).

Not simulated: light that does not pass the print, the bandwidth of the pixels (300 Hz would take 5 % off a flicker of
100 Hz), and noise that grows as the light fades. If a rim and the light both cross a threshold in a last scan, a pixel
has two events.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera import dot_rings, optics
from evetac_cli.sim.camera.contact_edges import LineMotion
from evetac_cli.sim.camera.leak import LEAK_SLICES
from evetac_cli.sim.camera.readout import event_key
from evetac_cli.sim.camera.scanning.pixel_culling import RESOLUTION_PX
from evetac_cli.sim.camera.scanning.pixels import (
    RUN_PX,
    CandidatePixels,
    gel_pixels,
    window_pixels,
)
from evetac_cli.sim.setup.scene import LightSettings

# Upper bound of single precision's error of the shifted references: runs with the light this near a bound are compared.
ROUNDING = 1e-5


class Light:
    """The light on one camera, and the camera's last view of it."""

    def __init__(self, change: LightSettings, frame_px: tuple[int, int], window_rows: int) -> None:
        """Start with the light at time 0, for a frame of (width, height) and a window of this many rows (0: none)."""
        width, height = frame_px
        self._change = change
        self._seen_flicker = change.flicker_level(0.0)
        self._seen_step = 0.0
        brightest, darkest = math.log1p(change.depth), math.log1p(-change.depth)
        self._middle = 0.5 * (brightest + darkest)
        self.candidate_light: NDArray[np.float32] = np.array(
            [self._seen_flicker - self._middle, 0.5 * (brightest - darkest)], np.float32
        )
        runs = -(-width // RUN_PX)
        self._bounds = (
            np.full((height, runs), np.inf),
            np.full((height, runs), -np.inf),
            np.full(height, np.inf),
            np.full(height, -np.inf),
            np.full(window_rows, np.inf),
            np.full(window_rows, -np.inf),
            np.full(3, np.nan),
        )

    def forget_changed(
        self,
        path: Floats,
        gel: tuple[Any, ...],
        window: tuple[Any, ...],
        lines: LineMotion | None,
        first_leaking_row: int | None,
    ) -> None:
        """Before a slice is scanned, discard the bounds of runs whose level or references it will change.

        `path` (dots, k + 1, 2) are the paths of the dots, `lines` the moving lines, `first_leaking_row` the first row
        that is due to leak. Bounds are kept only for a flicker.
        """
        if self._change.depth == 0.0:
            return
        _, high, _, row_high, _, window_high, _ = self._bounds
        _forget_rings(path, gel[0], float(gel[1][1]), gel[5][13], high, row_high)
        if lines is not None:
            first, end = 0, high.shape[1]
            if not lines.outline.picture.size:
                at_px = np.concatenate([lines.start.cut_x_px, lines.end.cut_x_px, lines.seen_cut_x])
                first = max(int(at_px.min() - lines.cut_half_px) // RUN_PX, 0)
                end = int(at_px.max() + lines.cut_half_px) // RUN_PX + 1
            high[:, first:end] = -np.inf
            row_high[:] = -np.inf
            window_high[:] = -np.inf
        if first_leaking_row is not None:
            high[first_leaking_row::LEAK_SLICES] = -np.inf
            row_high[first_leaking_row::LEAK_SLICES] = -np.inf
            in_window = (first_leaking_row - window[1]) % LEAK_SLICES
            window_high[in_window::LEAK_SLICES] = -np.inf

    def shine(
        self,
        gel: tuple[Any, ...],
        window: tuple[Any, ...],
        readout_us: NDArray[np.int64],
        t0_us: float,
        refractory_us: float,
        keys: NDArray[np.int64],
        event_count: int,
    ) -> int:
        """Compare the pixels that the light has changed by the last scan of a slice; return the number of events."""
        scans = len(readout_us)
        now_us = t0_us + (scans - 1) * SLICE_US / scans
        when = (readout_us[-1], now_us, float(refractory_us))
        flicker, step = self._change.flicker_level(now_us), self._change.step_level(now_us)
        if flicker == self._seen_flicker and step == self._seen_step:
            return event_count
        if step != self._seen_step or self._change.depth == 0.0:  # radii hold for a flicker, bounds only during one
            self._bounds[3][:] = -np.inf
            self._bounds[1][:] = -np.inf
            candidates = gel[5]
            candidates[1][:] = np.inf
            candidates[3][:] = np.nan
        change = np.float32(flicker - self._seen_flicker + step - self._seen_step)
        self._seen_flicker, self._seen_step = flicker, step
        self.candidate_light[0] = flicker - self._middle
        return int(_shine(change, flicker + step, gel, window, self._bounds, when, keys, event_count))


@njit(cache=True, _nrt=False)
def _forget_rings(path: Floats, seen_xy: Floats, outer: float, places: Floats, high: Floats, row_high: Floats) -> None:
    """Discard the bounds of the runs that the rings of moving dots touch; `places` is scratch."""
    height, runs = high.shape
    box = places[: 4 * len(path)].reshape(len(path), 4)
    dot_rings.boxes(path, seen_xy, box)
    for dot in range(len(path)):
        x, y, half_x, half_y = box[dot]
        if max(half_x, half_y) <= 0.5 * RESOLUTION_PX:
            continue
        first = min(max(int(math.floor((x - half_x - outer) / RUN_PX)), 0), runs)
        end = min(max(int(math.floor((x + half_x + outer) / RUN_PX)) + 1, first), runs)
        first_row, end_row = dot_rings.ring_rows(box[dot], outer, height)
        high[first_row:end_row, first:end] = -np.inf
        if first < end:
            row_high[first_row:end_row] = -np.inf


@njit(cache=True, _nrt=False)
def _shine(
    change: np.float32,
    light: float,
    gel_arrays: tuple[Any, ...],
    window_arrays: tuple[Any, ...],
    bounds: tuple[Any, ...],
    when: tuple[Any, ...],
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Subtract a change of the light from all references, and compare the runs whose bounds `light` has crossed."""
    gel, window = gel_pixels(gel_arrays), window_pixels(window_arrays)
    low, high, row_low, row_high, window_low, window_high, seen_object = bounds
    inner, outer, steps_per_px, profile = gel.profile
    ink = (inner, outer, steps_per_px, profile, gel.shapes.inner_px, gel.shapes.outer_px, gel.shapes.level)
    reference, threshold, release_us = gel.reference, gel.threshold, gel.release_us
    middle_shift = gel.middle_shift
    line = gel.candidates.line
    shifted, nothing = middle_shift.size > 0, line[:0]
    height, width = reference.shape
    for row in range(height):
        own = reference[row]
        for x in range(width):
            own[x] -= change
        if row_low[row] < light < row_high[row]:
            continue
        first_run, end_run = low.shape[1], 0
        for run in range(low.shape[1]):
            if not low[row, run] < light < high[row, run]:
                first_run, end_run = min(first_run, run), run + 1
        left, right = first_run * RUN_PX, min(end_run * RUN_PX, width)
        optics.dot_row(gel.seen_dot_xy_px, *ink, row, left, right, line)
        before = event_count
        row_low[row] = -np.inf
        row_high[row] = np.inf
        for run in range(low.shape[1]):
            if not low[row, run] < light < high[row, run]:
                first = run * RUN_PX
                end = min(first + RUN_PX, width)
                fired = event_count
                low[row, run], high[row, run], event_count = _compare_run(
                    line[first - left : end - left],
                    own[first:end],
                    threshold[row, first:end],
                    middle_shift[row, first:end] if shifted else nothing,
                    release_us[row, first:end],
                    first,
                    row,
                    light,
                    when,
                    keys,
                    event_count,
                )
                if event_count > fired:
                    gel.candidates.lower2_px2[row, first:end] = np.inf
            row_low[row] = max(row_low[row], low[row, run])
            row_high[row] = min(row_high[row], high[row, run])
        if event_count > before:
            _forget_lists(row, outer, gel.candidates)
    rows, columns = window.reference.shape
    if not rows:
        return event_count
    for axis in range(3):
        if seen_object[axis] != window.seen_object[axis]:
            seen_object[axis] = window.seen_object[axis]
            window_high[:] = -np.inf
    place = optics.texture_place(
        window.texture, window.first_x, window.first_y, seen_object[0], seen_object[1], seen_object[2]
    )
    window.candidate_runs.travelled[0] += abs(change)
    for row in range(rows):
        own = window.reference[row]
        for x in range(columns):
            own[x] -= change
        if window_low[row] < light < window_high[row]:
            continue
        optics.sample_texture_run(window.texture, place, row, 0, columns, line)
        window_low[row], window_high[row], event_count = _compare_run(
            line[:columns],
            own,
            window.threshold[row],
            window.middle_shift[row] if shifted else nothing,
            window.release_us[row],
            window.first_x,
            window.first_y + row,
            light,
            when,
            keys,
            event_count,
        )
    return event_count


@njit(cache=True, _nrt=False)
def _compare_run(
    level: NDArray[np.float32],
    reference: NDArray[np.float32],
    threshold: NDArray[np.float32],
    middle_shift: NDArray[np.float32],
    release_us: Floats,
    first_x: int,
    y: int,
    light: float,
    when: tuple[Any, ...],
    keys: NDArray[np.int64],
    event_count: int,
) -> tuple[float, float, int]:
    """Compare pixels side by side; return the levels of light between which none fires, and the number of events.

    If a pixel is blind there are no such levels.
    """
    readout_us, now_us, refractory_us = when
    low = -np.inf
    high = np.inf
    for k in range(len(reference)):
        if len(release_us) and release_us[k] > now_us:
            reference[k] = level[k] + middle_shift[k] if len(middle_shift) else level[k]
            high = -np.inf
            continue
        change = level[k] - reference[k]
        if abs(change) >= threshold[k]:
            reference[k] = level[k] + middle_shift[k] if len(middle_shift) else level[k]
            if event_count < len(keys):
                keys[event_count] = event_key(readout_us[first_x + k], first_x + k, y, change > 0)
            event_count += 1
            change = level[k] - reference[k]
            if len(release_us):
                release_us[k] = now_us + refractory_us
                high = -np.inf
        low = max(low, light - (threshold[k] + change) + ROUNDING)
        high = min(high, light + (threshold[k] - change) - ROUNDING)
    return low, high, event_count


@njit(cache=True, _nrt=False)
def _forget_lists(row: int, outer: float, candidates: CandidatePixels) -> None:
    """Discard the lists of dots that can come near a row in which a reference has changed."""
    list_box = candidates.list_box
    for dot in range(len(list_box)):
        if abs(list_box[dot, 1] - row) <= list_box[dot, 3] + outer:
            list_box[dot] = np.nan
