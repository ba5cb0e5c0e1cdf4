"""Series and intervals of slip in view, decimated so that an hour needs no more space than a second.

Series are divided into bins, about one per pixel column; only the smallest and the largest value of each are drawn.
Arrays are read block by block, because an hour of tracks takes gigabytes.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US, SLICES_PER_S
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.kernels.slip.alarms import alarming
from evetac_cli.kernels.slip.architectures import MemoryArchitecture
from evetac_cli.pages.shared import BLUE, GREEN, INK, ORANGE, PINK, UNKNOWN
from evetac_cli.pages.view.trial_files import OpenTrial
from evetac_cli.pages.view.view_data import Lane, Panel, Series
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.onset import abstains
from evetac_cli.store.recordings.read import Recording, true_onset

BINS = 3000
BLOCK_ROWS = 16384
LEAST_FLOW_PX = 0.01  # smallest drawn: a logarithmic axis has no 0, and less is noise
MOST_FLOW_PX = 10.0  # largest drawn, or three times the limit if larger: higher values decide nothing
BY_IMAGES = ("threshold", "threshold_px", "window relative to the gel over the look-ahead;")
# Method of labels -> name and parameter of its limit, and what moves: event-flow sums the slide since the last stick.
LIMITS = {
    "farneback": BY_IMAGES,
    "dis": BY_IMAGES,
    "event-flow": (
        "onset at a slide of",
        "slip_distance_px",
        "object relative to the gel in contact; a lasting slide of",
    ),
}

Read = Callable[[int, int], NDArray[Any]]


def extremes(length: int, read: Read) -> list[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Return the smallest and largest value of every bin, in order, for each column of read(start, stop).

    read returns (rows, columns). If there are at most two values per bin, all are returned. Values that are not finite
    are ignored; a bin without finite values becomes NaN. The result is (row, value) per column.
    """
    if length <= 2 * BINS:
        values = read(0, length).astype(np.float64)
        return [(np.arange(length), np.where(np.isfinite(column), column, np.nan)) for column in values.T]
    found_at, found = [], []
    for start, bins in _blocks(length, read):
        finite = np.isfinite(bins)
        lowest, highest = np.where(finite, bins, np.inf).argmin(axis=1), np.where(finite, bins, -np.inf).argmax(axis=1)
        at = np.sort(np.stack((lowest, highest), axis=1), axis=1)
        found.append(np.take_along_axis(np.where(finite, bins, np.nan), at, axis=1))
        found_at.append(at + start + bins.shape[1] * np.arange(len(bins))[:, None, None])
    rows, values = (np.concatenate(parts).reshape(-1, parts[0].shape[2]).T for parts in (found_at, found))
    once = [np.unique(column, return_index=True) for column in rows]  # one value may be a bin's smallest and largest
    return [(at, column[first]) for (at, first), column in zip(once, values, strict=True)]


def stretches(length: int, read: Read) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Return rows [first, last) that are 1, and those that are negative (not examined), to within a bin.

    A bin with any 1 counts as 1, so that no short slip is lost. read(start, stop) returns (rows, 1).
    """
    states = np.concatenate([np.empty(0), *(np.fmax.reduce(bins[..., 0], axis=1) for _, bins in _blocks(length, read))])
    borders = np.flatnonzero(np.diff(states, prepend=np.nan, append=np.nan))
    size = _bin_rows(length)
    parts = [(states[a], (a * size, min(b * size, length))) for a, b in pairwise(borders.tolist())]
    return [rows for state, rows in parts if state == 1], [rows for state, rows in parts if state < 0]


def _bin_rows(length: int) -> int:
    return max(1, -(-length // BINS))


def _blocks(length: int, read: Read) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Yield the rows in blocks of whole bins, filled with NaN at the end: first row, (bins, rows of a bin, columns)."""
    size = _bin_rows(length)
    at_once = size * max(1, BLOCK_ROWS // size)
    for first in range(0, length, at_once):
        rows = read(first, min(first + at_once, length)).astype(np.float64)
        whole = np.pad(rows, ((0, -len(rows) % size), (0, 0)), constant_values=np.nan)
        yield first, whole.reshape(-1, size, rows.shape[1])


def first_row(length: int, read: Read, wanted: Callable[[NDArray[Any]], NDArray[np.bool_]]) -> int | None:
    """Return the first wanted row of read(start, stop) -> (rows, 1), read block by block; None if there is none."""
    for first in range(0, length, BLOCK_ROWS):
        rows = np.flatnonzero(wanted(read(first, min(first + BLOCK_ROWS, length))[:, 0]))
        if len(rows):
            return first + int(rows[0])
    return None


def rows_of(file: StageFile, path: str, start: int) -> Read:
    """Return rows of a one-dimensional dataset, counted from `start`, as a column."""
    return lambda first, last: file.read(path, start + first, start + last)[:, None]


def slice_times_s(start: int, stop: int) -> NDArray[np.float64]:
    """Return the times of slices [start, stop)."""
    return np.arange(start, max(start, stop)) / SLICES_PER_S


def decimated(
    names: Mapping[str, str], t_s: NDArray[np.float64], read: Read, deviations: Mapping[str, Read] | None = None
) -> list[Series]:
    """Return a series for each column of read, whose rows are at t_s, without columns that are all NaN.

    names: name -> colour of each column. deviations: name -> (rows, 1), the standard deviation of each value.
    """
    lines = []
    for (name, colour), (at, value) in zip(names.items(), extremes(len(t_s), read), strict=True):
        if np.isfinite(value).any():
            sd = _rows_at(at, deviations[name]) if deviations and name in deviations else None
            lines.append(Series(name, colour, t_s[at], value, sd))
    return lines


def _rows_at(rows: NDArray[np.int64], read: Read) -> NDArray[np.float64]:
    """Return some rows, in order, of read(start, stop) -> (rows, 1), which is read block by block."""
    blocks = np.split(rows, np.searchsorted(rows, np.arange(BLOCK_ROWS, rows[-1] + 1, BLOCK_ROWS)))
    parts = [read(int(block[0]), int(block[-1]) + 1)[block - block[0], 0] for block in blocks if len(block)]
    return np.concatenate(parts).astype(np.float64)


def series_panels(
    trial: OpenTrial, span: tuple[int, int], probability: NDArray[np.float32] | None, of_touch: Sequence[Panel] = ()
) -> list[Panel]:
    """Return series of the slices of the span, from all files of the trial.

    probability: from model_output. of_touch: panels of a touch file, placed below the panels of the true values.
    """
    recording, tracks, labels = trial.recording, trial.tracks, trial.labels
    panels = [*(_truth(recording, span) if recording is not None else ()), *of_touch]
    if recording is not None:
        per_slice = np.diff(recording.starts[span[0] : span[1] + 1])
        counts = np.maximum(per_slice, 1)[:, None]  # a logarithmic axis has no 0
        lines = decimated({"events": BLUE}, slice_times_s(*span), lambda first, last: counts[first:last])
        panels.insert(0, Panel("Events per millisecond", "", lines, logarithmic=True))
    if tracks is not None:
        panels.append(_dots(tracks, span))
    if labels is not None:
        panels.append(_flow(labels, span))
    panels += _probability(trial, span, probability)
    return [panel for panel in panels if panel.lines]


def _truth(recording: Recording, span: tuple[int, int]) -> list[Panel]:
    """Return the true forces of a simulation, and its true tone or slip; nothing for a real recording."""
    if not recording.has("truth"):
        return []
    start, t_s = span[0], slice_times_s(*span)

    def forces(first: int, last: int) -> NDArray[Any]:
        normal = recording.read("truth/normal_force_n", start + first, start + last)
        shear = recording.read("truth/shear_force_n", start + first, start + last)
        return np.stack((normal, np.hypot(shear[:, 0], shear[:, 1])), axis=1)

    def shares(first: int, last: int) -> NDArray[Any]:
        paths = ("truth/visible_slip_share", "truth/slip_share")
        return np.stack([recording.read(path, start + first, start + last) for path in paths], axis=1)

    panels = []
    if recording.has("truth/normal_force_n") and recording.has("truth/shear_force_n"):
        lines = decimated({"normal": INK, "shear": ORANGE}, t_s, forces)
        panels = [Panel("Forces on one pad, truth", "N", lines, simulated=True)]
    if recording.has("truth/tone_hz"):
        lines = decimated({"tone": PINK}, t_s, rows_of(recording, "truth/tone_hz", start))
        return [*panels, Panel("Tone, truth", "Hz", lines, simulated=True)]
    if not recording.has("truth/slip_share"):
        return panels
    lines = decimated({"that the camera sees": ORANGE, "whole": INK}, t_s, shares)
    return [*panels, Panel("Share of the contact that slips, truth", "", lines, simulated=True)]


def _dots(tracks: StageFile, span: tuple[int, int]) -> Panel:
    """Return how far the tracked dots are from their places at rest."""
    start = span[0]
    rest = tracks.read("sensor/dot_xy_px").reshape(-1, 2)

    def moved(first: int, last: int) -> NDArray[Any]:
        away = np.linalg.norm(tracks.read("dot_xy_px", start + first, start + last) - rest, axis=2)
        # the position of a lost dot may be hundreds of px off: it is not a displacement of the gel
        away[~np.isfinite(away) | (tracks.read("lost", start + first, start + last) > 0)] = np.nan
        dot_count = np.maximum(np.isfinite(away).sum(axis=1), 1)
        mean = np.where(np.isfinite(away).any(axis=1), np.nansum(away, axis=1) / dot_count, np.nan)
        return np.stack((mean, np.fmax.reduce(away, axis=1, initial=np.nan)), axis=1)

    t_s = slice_times_s(*span)[: _length(tracks, "dot_xy_px", span)]
    return Panel("Dots, distance from rest", "px", decimated({"mean": BLUE, "farthest": PINK}, t_s, moved))


def _probability(trial: OpenTrial, span: tuple[int, int], probability: NDArray[np.float32] | None) -> list[Panel]:
    """Return the slip probability: of the given model, otherwise of the detector of a grasp, if any."""
    recording, t_s = trial.recording, slice_times_s(*span)
    if probability is not None:
        levels = {"threshold": float(trial.model.read("threshold"))} if trial.model is not None else {}
        column = probability[:, None]
        lines = decimated({"model": PINK}, t_s[: len(column)], lambda first, last: column[first:last])
        return [Panel("Slip probability, model", "", lines, levels)]
    if recording is None or not recording.has("control/probability"):
        return []
    lines = decimated({"detector": PINK}, t_s, rows_of(recording, "control/probability", span[0]))
    threshold = recording.header["parameters"].get("slip_threshold")
    levels = {"threshold": float(threshold)} if isinstance(threshold, (int, float)) else {}
    return [Panel("Slip probability, detector while grasping", "", lines, levels)]


def _flow(labels: StageFile, span: tuple[int, int]) -> Panel:
    """Return the flow by which labels decided, where they examined it and where not.

    The axis is logarithmic and cut, because larger values decide nothing.
    """
    start = span[0]

    def flow(first: int, last: int) -> NDArray[Any]:
        values = np.maximum(labels.read("relative_flow_px", start + first, start + last), LEAST_FLOW_PX)  # NaN stays
        examined = labels.read("label", start + first, start + last) >= 0
        return np.stack((np.where(examined, values, np.nan), np.where(examined, np.nan, values)), axis=1)

    names = {"window against gel": GREEN, "not examined": UNKNOWN}
    t_s = slice_times_s(start, start + _length(labels, "relative_flow_px", span))
    lines = decimated(names, t_s, flow)
    parameters = labels.header["parameters"]
    method = parameters.get("method")
    title = "Flow that labels slip" + (f", {method}" if isinstance(method, str) else "")
    name, limit, caption = LIMITS.get(method if isinstance(method, str) else "farneback", ("", "", ""))
    level = parameters.get(limit)
    if not isinstance(level, (int, float)):
        return Panel(title, "px", lines, logarithmic=True)
    ends = LEAST_FLOW_PX, max(MOST_FLOW_PX, 3 * level)
    caption = f"Motion of the {caption} more than {level:g} px is slip."
    if any(line.name == "not examined" for line in lines):
        caption += " Grey: not examined."
    if any(np.nanmax(line.value) > ends[1] for line in lines):
        caption += f" Not drawn beyond {ends[1]:g} px: once the object is lost, the flow soon has no meaning."
    return Panel(title, "px", lines, {name: level}, logarithmic=True, ends=ends, caption=caption)


def timed(recording: Recording, path: str, span: tuple[int, int]) -> tuple[NDArray[np.float64], int, int]:
    """Return times in s of rows with their own clock, and the range of rows in the span."""
    t_us = recording.read(path)
    first, last = np.searchsorted(t_us, np.array(span) * SLICE_US).tolist()
    return t_us[first:last] / 1e6, first, last


def _length(file: StageFile, path: str, span: tuple[int, int]) -> int:
    """Return the number of rows of the span in a file, which may be shorter than the recording."""
    return max(0, min(file.length(path), span[1]) - span[0])


# Slip: truth, labels, model -------------------------------------------------------------------------------------------


def model_output(trial: OpenTrial, span: tuple[int, int]) -> NDArray[np.float32] | None:
    """Return the slip probability of each slice of the span, NaN before the first; None without a model or features."""
    if trial.model is None or trial.model_input is None:
        return None
    from evetac_cli.stages.slip_detectors import first_needed, load_detector, probabilities, read_series

    detector = load_detector(trial.model)
    start = span[0]
    length = _length(trial.model_input, "displacement_px", span)
    probability = np.full(length, np.nan, np.float32)
    # A network with memory needs all slices before, which are therefore read only once.
    at_once = max(1, length) if isinstance(detector.architecture, MemoryArchitecture) else BLOCK_ROWS
    for first in range(0, length, at_once):
        last = min(first + at_once, length)
        begin = first_needed(detector.architecture, start + first)
        series = read_series(trial.model_input, detector.architecture, begin, start + last)
        (probability[first:last],) = probabilities([detector], series, start + first)
    return probability


def slip_onsets(
    trial: OpenTrial, span: tuple[int, int], probability: NDArray[np.float32] | None
) -> dict[str, int | None]:
    """Return the first slice of slip after the start of the span, by truth, label and model or detector, if known.

    For truth and labels, the trial begins when the gripper's current begins to fall. For a grasp's detector it begins
    after the light contact, because no trajectory in its training contains one.
    """
    start, stop = span
    onsets: dict[str, int | None] = {}
    if trial.recording is not None and trial.recording.has("truth/slip"):
        onsets["truth"] = true_onset(trial.recording, start, stop)
    examined = start
    if (source := _labelled(trial)) is not None:
        label = source.read("label", start, stop)
        onsets["label"] = _first(label == 1, start)
        if abstains(source):  # its guess is before the slices that certainly slip
            guess = int(source.read("onset_slice"))
            onsets["label"] = guess if start <= guess < stop else None
        examined = _first(label >= 0, start) or start
    if probability is not None and trial.model is not None:
        detected = alarming(probability, float(trial.model.read("threshold")))
        onsets["model"] = _first(detected[examined - start :], examined)
    elif trial.recording is not None and trial.recording.has("control"):
        t_s, first, last = timed(trial.recording, "control/t_us", span)
        gripped = trial.recording.read("control/phase", first, last) > GraspPhase.CONTACT
        slip = np.flatnonzero(gripped & (trial.recording.read("control/slip", first, last) > 0))
        onsets["detector"] = int(t_s[slip[0]] * SLICES_PER_S) if len(slip) else None
    return onsets


def _first(slip: NDArray[np.bool_], start: int) -> int | None:
    slices = np.flatnonzero(slip)
    return start + int(slices[0]) if len(slices) else None


def lane_of(name: str, colour: str, t_s: NDArray[np.float64], read: Read) -> Lane:
    """Return the intervals in which rows are 1, and in which they are negative; t_s: begin of each row, and the end."""
    slip, unknown = ([(float(t_s[a]), float(t_s[b])) for a, b in rows] for rows in stretches(len(t_s) - 1, read))
    return Lane(name, colour, slip, unknown)


def slip_lanes(trial: OpenTrial, span: tuple[int, int], probability: NDArray[np.float32] | None) -> list[Lane]:
    """Return intervals of slip in the span, by truth, label and model or detector, if known."""
    start, stop = span
    t_s = slice_times_s(start, stop + 1)
    lanes = []
    recording = trial.recording
    if recording is not None and recording.has("truth/slip"):
        lanes.append(lane_of("truth", INK, t_s, rows_of(recording, "truth/slip", start)))
    if (source := _labelled(trial)) is not None:
        rows = rows_of(source, "label", start)
        lanes.append(lane_of("label", GREEN, t_s[: _length(source, "label", span) + 1], rows))
    if probability is not None and trial.model is not None:
        slip = alarming(probability, float(trial.model.read("threshold"))).astype(np.int8)
        slip[np.isnan(probability)] = -1
        lanes.append(lane_of("model", PINK, t_s[: len(slip) + 1], lambda first, last: slip[first:last, None]))
    elif recording is not None and recording.has("control"):
        at_s, first, _ = timed(recording, "control/t_us", span)
        ends_s = np.append(at_s, stop / SLICES_PER_S)
        lanes.append(lane_of("detector", PINK, ends_s, rows_of(recording, "control/slip", first)))
    return lanes


def _labelled(trial: OpenTrial) -> StageFile | None:
    """Return the labels, else the features if they have labels."""
    return trial.labels or (trial.features if trial.features is not None and trial.features.has("label") else None)
