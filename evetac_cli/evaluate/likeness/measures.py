"""Measures of one recording for the public facts; measures that it cannot provide are missing from the row.

Any recording provides rest, dots and rates. The onset of slip needs truth, or labels next to the recording; the path of
the dots needs truth, or tracks next to it. Force, contact and the slipping share need the truth of a simulation.

So do the distances of three published trackers from the true dots, next to that of a tracker that never moves dots.
These are the authors' code of 2024 on slices of 1 ms, their code of 2026, and the paper's. The code of 2026 has the
same arithmetic on slices of 5 ms, and requires 11 events per slice where that of 2024 requires 5. The background filter
before the tracker in both codes is left out.
"""

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.evaluate.data_rate import COLUMNS
from evetac_cli.evaluate.data_rate.measure import dot_places, intervals, slip_onset
from evetac_cli.evaluate.realism.measure import ContactPhase, rest_and_motion, stroked
from evetac_cli.evaluate.slip.tables import TIMING_BINS
from evetac_cli.events import SLICE_US, SLICES_PER_S
from evetac_cli.jobs import Row
from evetac_cli.kernels import realism
from evetac_cli.kernels.slip.metrics import EARLIEST_MS, LATEST_MS
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.stages import row_blocks
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import Recording, first_slice, ramp_start

ABOUT_MS = 250  # before and after the onset: the paper's half second
QUIETEST_MS = 100  # their mean rate is the floor without motion
BUSY = 25  # events per slice; slices with more are active in the paper's training
HELD_UNTIL_MS = 500  # before the onset
BEFORE_MS, AFTER_MS = (-100, -30), (0, 30)
THRESHOLDS = (25, 35, 50, 75, 100, 150, 200, 300, 400, 600, 800, 1000, 1500)  # events per slice
NEVER_MS = 10**6  # after the onset: represents no detection


@dataclass(frozen=True)
class SliceCounts:
    """Events per slice in the columns that the paper counts, and in the window; the onset and the start of its ramp.

    onset: the first slice of gross slip in the truth, or without truth in the labels next to the recording; None if
    neither has one.
    """

    sensing: NDArray[np.int64]
    window: NDArray[np.int64]
    onset: int | None
    start: int

    @property
    def floor(self) -> float:
        """Events per slice in the quietest 100 ms before the onset, or of all; NaN for shorter recordings."""
        before = self.sensing if self.onset is None else self.sensing[: self.onset]
        if len(before) < QUIETEST_MS:
            return math.nan
        return float(np.convolve(before, np.ones(QUIETEST_MS), "valid").min()) / QUIETEST_MS


def count(recording: Recording) -> SliceCounts:
    """Count the events of a recording; raise InputError if labels next to it belong to another recording."""
    sensing = np.zeros(len(recording), np.int64)
    for block in recording.blocks():
        slices = np.repeat(np.arange(len(block.starts) - 1), np.diff(block.starts))
        own = slices[block.events.x < COLUMNS]
        sensing[block.first : block.stop] = np.bincount(own, minlength=len(block.starts) - 1)
    window = np.diff(recording.starts) - sensing
    return SliceCounts(sensing, window, slip_onset(recording)[0], ramp_start(recording))


def about_slip(counts: SliceCounts) -> Row:
    """Return event measures around the onset, {} without onset; rates are events per ms of the counted columns."""
    if counts.onset is None:
        return {}
    sensing, window = (events.astype(np.float64) for events in (counts.sensing, counts.window))
    onset, floor = counts.onset, counts.floor
    about = slice(max(onset - ABOUT_MS, 0), onset + ABOUT_MS)
    after = slice(onset, onset + ABOUT_MS)
    rate_before, rate_after = rate(counts, *BEFORE_MS), rate(counts, *AFTER_MS)
    held_counts = sensing[: max(onset - HELD_UNTIL_MS, 0)]
    all_after = float(sensing[after].sum() + window[after].sum())
    earlier = sensing[counts.start : max(onset - 50, counts.start)]
    return {
        "events_ms_about_slip": _mean(sensing[about]),
        "events_ms_100_to_30_before": rate_before,
        "events_ms_30_before": rate(counts, -30, 0),
        "events_ms_30_after": rate_after,
        "before_over_after": (rate_before - floor) / (rate_after - floor) if rate_after > floor else math.nan,
        "loudest_slice": float(sensing[about].max()) if len(sensing[about]) else math.nan,
        "loudest_slice_50_before": float(earlier.max()) if len(earlier) else math.nan,
        "held_above_25_share": _mean((held_counts > BUSY).astype(np.float64)),
        "window_share_after_slip": float(window[after].sum()) / all_after if all_after else math.nan,
    }


def rate(counts: SliceCounts, first_ms: int, stop_ms: int) -> float:
    """Return events per ms of the counted columns between two times after the onset, in ms; NaN without onset."""
    if counts.onset is None:
        return math.nan
    first, stop = (max(counts.onset + ms, 0) for ms in (first_ms, stop_ms))
    return _mean(counts.sensing[first:stop].astype(np.float64))


def _mean(values: Floats | NDArray[np.int64]) -> float:
    return float(values.mean()) if len(values) else math.nan


class Slip(NamedTuple):
    """A slip: its object, and its first detection for each threshold, in ms after the onset."""

    object: str
    after_ms: tuple[int, ...]


def slip(called: str, counts: SliceCounts) -> Slip:
    """Return a slip of an object; raise ValueError if the counts have no onset."""
    if counts.onset is None:
        raise ValueError("expected event counts with an onset of slip")
    since_start = counts.sensing[counts.start :]
    loud = (np.flatnonzero(since_start > k) for k in THRESHOLDS)
    first = (counts.start + int(slices[0]) - counts.onset if len(slices) else NEVER_MS for slices in loud)
    return Slip(called, tuple(first))


def judge(slips: Sequence[Slip]) -> Row:
    """Return shares of slips detected in time, and in each of the paper's intervals; {} with fewer than two objects.

    `one_threshold_low` and `_high`: the smallest and the largest k that was chosen.
    """
    if len({one.object for one in slips}) < 2:
        return {}
    threshold_index = {
        name: _best(one for one in slips if one.object != name) for name in {one.object for one in slips}
    }
    after_ms = np.array([one.after_ms[threshold_index[one.object]] for one in slips])
    intervals = {
        f"one_threshold_{name}": float(np.mean((after_ms >= low) & (after_ms <= high)))
        for name, low, high in TIMING_BINS
    }
    return {
        "one_threshold_correct": float(np.mean((after_ms >= EARLIEST_MS) & (after_ms <= LATEST_MS))),
        **intervals,
        "one_threshold_low": THRESHOLDS[min(threshold_index.values())],
        "one_threshold_high": THRESHOLDS[max(threshold_index.values())],
    }


def _best(slips: Iterable[Slip]) -> int:
    """Return the index of the threshold that is in time most often, the lowest if several are."""
    after_ms = np.array([one.after_ms for one in slips])
    in_time = ((after_ms >= EARLIEST_MS) & (after_ms <= LATEST_MS)).mean(axis=0)
    return int(np.argmax(in_time))


EVENT_BYTES, RGB_BYTES_S = 5, 540 * 480 * 3 * 25  # in the paper's comparison
HALF, MOST = 0.5, 0.8  # shares of the visible contact that slip
NEAR_DOT_PX = 20.0  # an event within this distance belongs to a dot, in the paper
LEAST_N = 1.0  # least shear force by which the dots' displacement is divided
STICKS_MS = 250  # after the onset
OFFICIAL, PAPER = presets.PRESETS["official"], presets.PRESETS["paper"]
# 10 + 3 (slice_ms - 1) entries of its table move a dot; an event makes two: 11 events in 5 ms (evetac_noros)
OFFICIAL_2026, SLICE_2026_MS = replace(OFFICIAL, min_events=10), 5
BLOCK_MS = 5000  # tracked in one piece; a multiple of both slice lengths


def measure(recording: Recording, counts: SliceCounts) -> Row:
    """Return all measures; lengths in px, times in ms, rates in events per ms of the counted columns."""
    rest, motion = rest_and_motion(recording)
    row = _at_rest(rest, recording.frame_px) if rest is not None else {}
    row |= _of_dots(recording, rest) if motion is not None else {}
    row |= _of_layout(recording) | shares(recording, counts) | about_slip(counts)
    if recording.has("gripper") and counts.onset is not None:
        row["ramp_ma_s"] = _ramp(recording, counts)
    if recording.has("truth/slip"):
        row |= _of_truth(recording, counts) | followed(recording)
    with dot_places(recording) as dots:
        if dots is not None and counts.onset is not None:
            row |= _of_path(recording, counts, dots)
    return {name: value for name, value in row.items() if value is not None and math.isfinite(value)}


def _at_rest(rest: ContactPhase, frame_px: tuple[int, int]) -> Row:
    """Return the noise: over the whole frame, and of ordinary and hot pixels in the counted columns."""
    whole = realism.at_rest(*rest.events, frame_px, rest.duration_us)
    own = rest.events.x < COLUMNS
    sensing = (rest.events.t[own], rest.events.x[own], rest.events.y[own], rest.events.p[own])
    hot, ordinary, _ = realism.split_hot(*sensing, frame_px, rest.duration_us * 1e-6)
    rest_ms = rest.duration_us / SLICE_US
    return {
        "events_ms": whole["events_a_slice"],
        "ordinary_hz": whole["ordinary_hz"],
        "hot_pixels": whole["hot_pixels"],
        "ordinary_events_ms": len(ordinary.t_us) / rest_ms,
        "hot_events_ms": len(hot.t_us) / rest_ms,
    }


def _of_dots(recording: Recording, rest: ContactPhase | None) -> Row:
    """Return radius, blur and contrast of dots that were stroked from rest."""
    press = stroked(recording, rest)
    names = ("dot_radius_px", "edge_sigma_px", "contrast_over_threshold")
    return {} if press is None else {name: float(getattr(press.optics, name).value) for name in names}


def _of_layout(recording: Recording) -> Row:
    """Return the spacing of neighbouring dots, and the window's share of the frame, of a calibrated sensor."""
    row: Row = {}
    dots, window = recording.dot_xy_px, recording.window_px
    if dots is not None and dots.ndim == 3:
        row["pitch_x_px"] = float(np.nanmean(np.diff(dots[..., 0], axis=1))) if dots.shape[1] > 1 else None
        row["pitch_y_px"] = float(np.nanmean(np.diff(dots[..., 1], axis=0))) if dots.shape[0] > 1 else None
    if window is not None:
        width, height = recording.frame_px
        row["window_share"] = (window[2] - window[0]) * (window[3] - window[1]) / (width * height)
    return row


def shares(recording: Recording, counts: SliceCounts) -> Row:
    """Return bytes per second as a share of the paper's RGB sensor: whole, in contact, around slip."""
    row: Row = {}
    for name, span in intervals(recording, 2e-3 * ABOUT_MS).items():
        if not span.missing_because:
            per_event = SLICES_PER_S * EVENT_BYTES / RGB_BYTES_S
            row[f"share_{name}"] = _mean(counts.sensing[span.start : span.stop]) * per_event
    return row


def _ramp(recording: Recording, counts: SliceCounts) -> float | None:
    """Return the rate, in mA/s, at which the target current falls until the onset."""
    at_ms = recording.read("gripper/t_us") / SLICE_US
    target_ma = recording.read("gripper/current_target_ma")
    falling = (at_ms >= counts.start) & (at_ms < (counts.onset or 0)) & np.isfinite(target_ma)
    if np.count_nonzero(falling) < 2:
        return None
    slope = np.polyfit(at_ms[falling], target_ma[falling], 1)[0]
    return -float(slope) * SLICES_PER_S


def _of_truth(recording: Recording, counts: SliceCounts) -> Row:
    """Return contact times, the slipping share, and the dots' displacement per newton."""
    row: Row = {}
    normal_n = recording.read("truth/normal_force_n")
    shear_n = np.linalg.norm(recording.read("truth/shear_force_n"), axis=1)
    if counts.onset is None:
        sheared = shear_n >= LEAST_N
        if sheared.any():
            dots = recording.read("truth/dot_xy_px")
            moved_px = np.linalg.norm(np.nanmean(dots - dots[0], axis=1), axis=1)
            row["px_per_n"] = float(np.median(moved_px[sheared] / shear_n[sheared]))
        return row
    onset = counts.onset
    visible = recording.read("truth/visible_slip_share")
    row |= slipping_ms(visible, onset)
    lost = first_slice(normal_n <= 0, onset)
    row["contact_after_slip_ms"] = None if lost is None else float(lost - onset)
    touching = normal_n[onset : onset + STICKS_MS] > 0
    if touching.any():
        row["sticks_again_share"] = float((visible[onset : onset + STICKS_MS][touching] < HALF).mean())
    return row


def slipping_ms(visible_slip_share: Floats, onset: int) -> Row:
    """Return for how many ms before the onset half, and 80 %, of the visible contact slip without interruption."""
    row: Row = {}
    for name, share in (("half_slips_ms", HALF), ("most_slips_ms", MOST)):
        below = np.flatnonzero(visible_slip_share[:onset] < share)
        row[name] = float(onset - 1 - (below[-1] if len(below) else 0))
    return row


def _of_path(recording: Recording, counts: SliceCounts, dots: tuple[StageFile, str]) -> Row:
    """Return the path of all dots around the onset, in px and px per gram of the object, with event measures.

    These are the events per px of path, and the share of events near dots.
    """
    file, name = dots
    first, stop = max((counts.onset or 0) - ABOUT_MS, 0), min((counts.onset or 0) + ABOUT_MS, len(recording))
    places = file.read(name, first, stop).astype(np.float64)
    path_px = float(np.nansum(np.linalg.norm(np.diff(places, axis=0), axis=2)))
    events = float(counts.sensing[first:stop].sum()) - counts.floor * (stop - first)
    row: Row = {"dot_event_share": _near_dots(recording, places, first)}
    if path_px > 0:
        row["events_per_px"] = events / path_px
    mass_kg = sampled(recording).get("mass_kg")
    if isinstance(mass_kg, (int, float)) and mass_kg > 0:
        row["path_px_per_g"] = path_px / (1e3 * mass_kg)
    return row


def _near_dots(recording: Recording, places: Floats, first: int) -> float | None:
    """Return the share of events in the counted columns near a dot.

    places: (slices, dots, 2) in px, starting at slice `first`.
    """
    near = total = 0
    (block,) = recording.blocks(len(places), first, first + len(places))
    for number, events in enumerate(block.slices()):
        own = events.x < COLUMNS
        at = np.stack([events.x[own], events.y[own]], axis=1).astype(np.float64)
        dots = places[number][np.isfinite(places[number][:, 0])]
        distance_px2 = ((at[:, None] - dots) ** 2).sum(axis=2).min(axis=1, initial=math.inf)
        near += int(np.count_nonzero(distance_px2 < NEAR_DOT_PX**2))
        total += len(at)
    return near / total if total else None


def sampled(recording: Recording) -> dict[str, Any]:
    """Return the sampled parameters of a simulated trial; empty if none are stored."""
    if not recording.has("truth/sampled_parameters"):
        return {}
    found = json.loads(str(recording.read("truth/sampled_parameters")))
    return found if isinstance(found, dict) else {}


def followed(recording: Recording) -> Row:
    """Return errors of the three trackers over a recording with known true dots and grid; {} for other recordings."""
    dots = recording.dot_xy_px
    if dots is None or not len(recording) or recording.read("truth/dot_xy_px", 0, 1).shape[1] != dots.size // 2:
        return {}
    rest = dots.reshape(-1, 2)
    true = recording.read("truth/dot_xy_px")
    still_px = _rms(_distances(np.broadcast_to(rest, true.shape), true))
    row: Row = {"still_px_rms": still_px}
    for name, constants, length_ms in (
        ("official_2024", OFFICIAL, 1),
        ("official_2026", OFFICIAL_2026, SLICE_2026_MS),
        ("paper", PAPER, 1),
    ):
        places = np.concatenate([*_follow(recording, rest, constants, length_ms)])
        off_px = _distances(places, true[length_ms - 1 :: length_ms][: len(places)])
        row[f"{name}_px_rms"] = _rms(off_px)
        row[f"{name}_over_still"] = row[f"{name}_px_rms"] / still_px if still_px else math.nan
        row[f"{name}_p99_px"] = float(np.percentile(off_px, 99)) if off_px.size else math.nan
    return row


def _follow(
    recording: Recording, rest: Floats, constants: presets.TrackerConstants, length_ms: int
) -> Iterator[NDArray[np.float32]]:
    """Yield the tracker's dot positions after every slice of `length_ms`, in blocks."""
    state = tracker.start(rest, constants, frame_px=recording.frame_px)
    whole = len(recording) // length_ms * length_ms
    yield np.empty((0, len(rest), 2), np.float32)
    for first, stop in row_blocks(whole, BLOCK_MS):
        edges = recording.starts[first : stop + 1 : length_ms]
        if len(edges) > 1:
            x, y = (recording.read(f"events/{name}", int(edges[0]), int(edges[-1])) for name in "xy")
            yield tracker.fold(state, x, y, None, edges - edges[0]).dot_xy_px


def _distances(places: NDArray[np.float32], true: NDArray[np.float32]) -> Floats:
    """Return the distances of existing dots from their true positions, in px."""
    off_px = np.linalg.norm(places.astype(np.float64) - true, axis=2)
    finite_px: Floats = off_px[np.isfinite(off_px)]
    return finite_px


def _rms(off_px: Floats) -> float:
    return float(np.sqrt(np.mean(off_px**2))) if off_px.size else math.nan
