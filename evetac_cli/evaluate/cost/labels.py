"""The part `label`: onset error of the labelling methods against their run time, on small seeded slip trials.

The reference is optical flow of both regions in every slice around the true onset. On whole recordings it would take a
minute per recorded second, and even ten trials with 200 ms on either side four minutes. So its onset is computed
without the gel flows that cannot change the result (a test checks this), and its run time is that of a few slices in
full. The other settings label whole recordings.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from evetac_cli.commands.label import Label
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.commands.record import Record
from evetac_cli.evaluate.common.rows import Extent, collect, difference, run_times
from evetac_cli.evaluate.cost import EvaluateCost
from evetac_cli.jobs import Progress, Row, Rows
from evetac_cli.kernels.labelling import flow
from evetac_cli.stages import label_methods
from evetac_cli.store.recordings.read import Recording, open_recording, true_onset
from evetac_cli.trials import record
from evetac_cli.trials.trial import simulated_trials

US = 1e6
SLICE_MS = 1.0  # onsets are whole slices
OBJECTS = "1,3,4,6,8,10,12,14,16,17"  # these slip; one trial each
AROUND_MS = 200  # slices on either side of the onset that the reference labels
EVERY = Extent(quick=5, full=1)  # methods that label whole recordings run on every 5th or on every trial
SAMPLE_MS = 8  # slices on either side of the onset computed in full for the reference's run time

# Recording -> onset in slices, and run time per recorded millisecond in us.
Method = Callable[[Recording], tuple[int, float]]


def measure(params: EvaluateCost, inputs: Sequence[Path], progress: Progress) -> Rows:
    """Return rows of every setting; run times are per recorded millisecond.

    `error_ms_onset` is the median of |t_c - t_s| over the trials with an onset, t_s being the onset of gross slip, and
    `onset_share` is the share of these trials. `error_ms_reference` is the largest distance from the reference's onset.
    `more_ms_onset` is the mean paired difference of the error from the reference's, with its interval (see rows). Run
    times are over the trials. `speedup` is the reference's run time over that of the setting.
    """
    with TemporaryDirectory() as folder:
        recordings = _record(Record(scene="slip", objects=OBJECTS, seed=params.seed), Path(folder), params.trials)
        every = EVERY.pick(params.full) if params.trials is None else 1
        rows = collect(_rows(recordings, every), len(methods()), progress)
    for row in rows:
        row["speedup"] = rows[0]["time_us_median"] / row["time_us_median"] if row["time_us_median"] else None
    return rows


def methods() -> list[tuple[str, Method]]:
    """Return the settings to compare; the first is the reference."""
    default = Label()
    variants = [
        *((f"farneback, steps of {step} ms", replace(default, method="farneback", coarse_ms=step)) for step in (5, 20)),
        *((f"dis, steps of {step} ms", replace(default, method="dis", coarse_ms=step)) for step in (5, 20)),
        ("event-flow", replace(default, method="event-flow")),
        ("event-count, steps of 5 ms", replace(default, method="event-count")),
    ]
    return [
        ("farneback of both regions, every slice", _every_slice),
        *((setting, partial(_whole, params)) for setting, params in variants),
    ]


def _rows(recordings: Sequence[Path], every: int) -> Iterator[Row]:
    reference: list[int] = []
    for number, (setting, method) in enumerate(methods()):
        step = every if number else 1
        onsets, true, took_us = [], [], []
        for path in recordings[::step]:
            with open_recording(path) as recording:
                true.append(_true_onset(recording))
                onset, us = method(recording)
            onsets.append(onset)
            took_us.append(us)
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
            label_methods.compute(recording, Label())
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
        **apart.columns("more_ms_onset", "_ms"),
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
    onset = flow.label(recording.between, stop, *label_methods.regions(recording), constants, start).onset
    begin = time.perf_counter()
    in_full = flow_constants(plain=True, coarse_ms=1, after_ms=0)
    first, last = _round_onset(recording, SAMPLE_MS)
    labels = flow.label(recording.between, last, *label_methods.regions(recording), in_full, first)
    return onset, (time.perf_counter() - begin) * US / max(labels.flow_pairs, 1)


def _whole(params: Label, recording: Recording) -> tuple[int, float]:
    """Return the onset by the stage `label`, and its run time per recorded millisecond in us."""
    begin = time.perf_counter()
    onset = label_methods.compute(recording, params).onset
    return onset, (time.perf_counter() - begin) * US / len(recording)
