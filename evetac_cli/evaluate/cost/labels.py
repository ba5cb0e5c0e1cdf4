"""The part `label`: onset error of the labelling methods against their run time, on small seeded slip trials.

The reference is optical flow of both regions in every slice around the true onset. On whole recordings it would take a
minute per recorded second, and even ten trials with 200 ms on either side four minutes. So its onset is computed
without the gel flows that cannot change the result (a test checks this), and its run time is that of a few slices in
full. The second setting searches the same slices as the stage does; the other settings label whole recordings.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from evetac_cli.commands.evaluate import EvaluateCost
from evetac_cli.commands.label import Label
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.commands.record import Record
from evetac_cli.evaluate.cost.deciding import Effort
from evetac_cli.evaluate.paired import difference, finite_or_none
from evetac_cli.evaluate.rows import Extent, collect, run_times
from evetac_cli.jobs import Progress, Row, Rows
from evetac_cli.kernels.labelling import event_flow, flow
from evetac_cli.stages import label
from evetac_cli.store.recordings.read import Recording, open_recording, ramp_start, true_onset
from evetac_cli.trials import record
from evetac_cli.trials.trial import simulated_trials

US = 1e6
SLICE_MS = 1.0  # onsets are whole slices
OBJECTS = "1,3,4,6,8,10,12,14,16,17"  # these slip; one trial each
AROUND_MS = 200  # slices on either side of the onset that the reference labels
EVERY = Extent(quick=5, full=1)  # methods that label whole recordings run on every 5th or on every trial
ROUND_ONSET = 2  # the first two methods label only the slices around the onset
SAMPLE_MS = 8  # slices on either side of the onset computed in full for the reference's run time

# Recording -> onset in slices, and run time per recorded millisecond in us.
Method = Callable[[Recording], tuple[int, float]]


def measure(params: EvaluateCost, inputs: Sequence[Path], progress: Progress) -> Rows:
    """Return rows of every setting; run times are per recorded millisecond.

    `error_ms_onset` is the median of |t_c - t_s| over the trials with an onset, t_s being the onset of gross slip, and
    `onset_share` is the share of these trials. `error_ms_reference` is the largest distance from the reference's onset.
    `more_ms_onset` is the mean paired difference of the error from the reference's, with its interval (see paired) and,
    if undecided, the command that would decide it (see deciding). Run times are over the trials. `speedup` is the
    reference's run time over that of the setting.
    """
    requested = params.trials or OBJECTS.count(",") + 1
    with TemporaryDirectory() as folder:
        started = time.process_time()
        recordings = _record(Record(scene="slip", objects=OBJECTS, seed=params.seed), Path(folder), params.trials)
        minutes = [(time.process_time() - started) / 60.0 / requested]  # per trial: of recording, then of each setting
        every = EVERY.pick(params.full) if params.trials is None else 1
        rows = collect(_rows(recordings, every, minutes), len(methods()), progress)
    reference, compared = rows[0]["setting"], ("more_ms_onset", "interval_low_ms", "interval_high_ms", "trials")
    for row in rows:
        row["speedup"] = rows[0]["time_us_median"] / row["time_us_median"] if row["time_us_median"] else None
    tried = [requested if number < ROUND_ONSET else max(requested // every, 1) for number in range(len(rows))]
    efforts = (Effort(params, trials, sum(minutes)) for trials in tried)
    return [effort.beside(row, reference, *compared) for effort, row in zip(efforts, rows, strict=True)]


def summary(rows: Rows) -> dict[str, Any]:
    """Return the number of settings."""
    return {"rows": len(rows)}


def methods() -> list[tuple[str, Method]]:
    """Return the settings to compare; the first is the reference."""
    default = Label()
    variants = [
        *((f"farneback, steps of {step} ms", replace(default, method="farneback", coarse_ms=step)) for step in (5, 20)),
        *((f"dis, steps of {step} ms", replace(default, method="dis", coarse_ms=step)) for step in (5, 20)),
        ("event-count, steps of 5 ms", replace(default, method="event-count")),
    ]
    return [
        ("farneback of both regions, every slice", _every_slice),
        ("farneback in the same slices, searched", _searched),
        *((setting, _stage(params)) for setting, params in variants),
        *((f"farneback in steps of 5 ms, {times} x smaller", _smaller_frames(times)) for times in (2, 4)),
        *((f"event-flow, motion seen over {px:g} px", _seen_over(px)) for px in (0.3, 0.6, 1.2)),
    ]


def _rows(recordings: Sequence[Path], every: int, minutes: list[float]) -> Iterator[Row]:
    reference: list[int] = []
    for number, (setting, method) in enumerate(methods()):
        step = 1 if number < ROUND_ONSET else every
        onsets, true, took_us = [], [], []
        started = time.process_time()
        for path in recordings[::step]:
            with open_recording(path) as recording:
                true.append(_true_onset(recording))
                onset, us = method(recording)
            onsets.append(onset)
            took_us.append(us)
        minutes.append((time.process_time() - started) / 60.0 / max(len(onsets), 1))
        reference = reference or onsets
        yield _row(setting, np.array(onsets), np.array(true), np.array(reference[::step]), np.array(took_us))


def _record(params: Record, folder: Path, trials: int | None) -> list[Path]:
    """Record the trials and return those that slip; run the default method once on each, so that it is compiled.

    trials: their number, object after object, starting again after the last; None is one per object.
    """
    objects = params.objects.count(",") + 1
    rounds = replace(params, count=-(-(trials or objects) // objects))
    jobs = sorted(
        simulated_trials(("ramp",), rounds, folder), key=lambda trial: trial.number
    )  # objects keep their order
    slipped = []
    for job in jobs[:trials]:
        record.run(job, rounds)
        with open_recording(job.output) as recording:
            label.compute(recording, Label())
            if true_onset(recording) is not None:
                slipped.append(job.output)
    return slipped


def _row(setting: str, onset: Any, true: Any, reference: Any, took_us: Any) -> Row:
    """Return the row of a setting from arrays over trials; an onset of -1 means that the method found none."""
    has_onset = onset >= 0
    both = has_onset & (reference >= 0)
    apart = difference(
        np.where(both, np.abs(onset - true), np.nan), np.where(both, np.abs(reference - true), np.nan), SLICE_MS
    )
    return {
        "part": "label",
        "setting": setting,
        "trials": len(onset),
        "error_ms_onset": float(np.median(np.abs(onset - true)[has_onset])) if has_onset.any() else None,
        "error_ms_reference": float(np.abs(onset - reference)[both].max()) if both.any() else None,
        "more_ms_onset": finite_or_none(apart.mean),
        "interval_low_ms": finite_or_none(apart.low),
        "interval_high_ms": finite_or_none(apart.high),
        "onset_share": float(has_onset.mean()) if len(onset) else None,
        **run_times(took_us),
    }


def flow_constants(**changes: Any) -> flow.FlowConstants:
    """Return the constants of the stage's method `farneback` with some changes."""
    names = flow.FlowConstants.__dataclass_fields__
    default = {name: value for name, value in recipe_of(Label(method="farneback")).items() if name in names}
    return flow.FlowConstants(**{**default, **changes})


def _true_onset(recording: Recording) -> int:
    onset = true_onset(recording)
    assert onset is not None  # only trials that slip are labelled
    return onset


def _round_onset(recording: Recording, around_ms: int) -> tuple[int, int]:
    """Return the first and last of the slices around the true onset."""
    true = _true_onset(recording)
    return max(true - around_ms, 0), min(true + around_ms, len(recording))


def _every_slice(recording: Recording) -> tuple[int, float]:
    """Compute optical flow of both regions in every slice around the true onset."""
    start, stop = _round_onset(recording, AROUND_MS)
    constants = flow_constants(coarse_ms=1, after_ms=0, clear_px=math.inf)
    onset = flow.label(recording.between, stop, *label.regions(recording), constants, start).onset
    begin = time.perf_counter()
    in_full = flow_constants(plain=True, coarse_ms=1, after_ms=0)
    first, last = _round_onset(recording, SAMPLE_MS)
    labels = flow.label(recording.between, last, *label.regions(recording), in_full, first)
    return onset, (time.perf_counter() - begin) * US / max(labels.flow_pairs, 1)


def _searched(recording: Recording) -> tuple[int, float]:
    """Run the stage's search for the onset in the same slices, and its labels after it."""
    start, stop = _round_onset(recording, AROUND_MS)
    begin = time.perf_counter()
    onset = flow.label(recording.between, stop, *label.regions(recording), flow_constants(), start).onset
    return onset, (time.perf_counter() - begin) * US / (stop - start)


def _stage(params: Label) -> Method:
    """Return the method of the stage `label` with these parameters."""
    return lambda recording: _time(recording, lambda: label.compute(recording, params))


def _smaller_frames(times: int) -> Method:
    """Return the stage's search for the onset, with frames smaller by a factor."""

    def method(recording: Recording) -> tuple[int, float]:
        arguments = (*label.regions(recording), flow_constants(shrink=times), ramp_start(recording))
        return _time(recording, lambda: flow.label(recording.between, len(recording), *arguments))

    return method


def _seen_over(seen_px: float) -> Method:
    """Return the method `event-flow` with this motion over which it decides whether a dot follows."""

    def method(recording: Recording) -> tuple[int, float]:
        dots, radius = recording.dot_xy_px, float(recording.read("sensor/dot_radius_px"))
        assert dots is not None  # a simulated recording
        constants = event_flow.EventFlowConstants(seen_px=seen_px)
        window, _ = label.regions(recording)
        arguments = window, recording.frame_px, dots.reshape(-1, 2), radius, constants, ramp_start(recording)
        return _time(recording, lambda: event_flow.label(recording.between, len(recording), *arguments))

    return method


def _time(recording: Recording, run: Callable[[], flow.Labels]) -> tuple[int, float]:
    """Return the onset of labels of a whole recording, and their run time per recorded millisecond in us."""
    begin = time.perf_counter()
    onset = run().onset
    return onset, (time.perf_counter() - begin) * US / len(recording)
