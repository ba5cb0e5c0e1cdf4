"""What a method of labelling costs and how late it is: onset error against run time, on small seeded slip trials.

The reference is optical flow of both regions in every slice, round the true onset: elsewhere it would take a minute a
recorded second. Ten trials of it, 200 ms either way, would be four minutes, so its onset is found with those gel flows
left out that cannot change the answer (a test holds the two equal), and its run time is that of a few slices in full.
Right after it stands the same flow, searched in the same slices; the other methods look at whole recordings.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from evetac_cli.kernels.labelling import event_flow, flow
from evetac_cli.params import Label, Record, recipe_of
from evetac_cli.stages import label, record
from evetac_cli.store.read import Recording, open_recording

US = 1e6


@dataclass(frozen=True)
class Extent:
    """Objects that slip, one trial each, on either side of whose onset the reference looks at so many slices.

    The methods that look at whole recordings are tried on every so many-th trial.
    """

    objects: str
    around_ms: int
    every: int


OBJECTS = "1,3,4,6,8,10,12,14,16,17"
USUAL = Extent(OBJECTS, 200, 5)
FULL = Extent(OBJECTS, 200, 1)
NEAR = 2  # so many methods, the first, look at the slices round the onset only
SAMPLE_MS = 8  # slices on either side of the onset that are computed in full for the reference's run time

# What is asked for -> onset, and run time of a recorded millisecond in us.
Method = Callable[[Recording, int], tuple[int, float]]


def methods() -> list[tuple[str, Method]]:
    """The settings that are compared; the first is the reference."""
    default = Label()
    chosen = [
        *((f"farneback, steps of {step} ms", replace(default, method="farneback", coarse_ms=step)) for step in (5, 20)),
        *((f"dis, steps of {step} ms", replace(default, method="dis", coarse_ms=step)) for step in (5, 20)),
        ("event-count, steps of 5 ms", replace(default, method="event-count")),
    ]
    shrunk = [(f"farneback in steps of 5 ms, {times} x smaller", times) for times in (2, 4)]
    look_aheads = [(f"event-flow, look-ahead {ms} ms", ms) for ms in (1, 2, 4)]
    return [
        ("farneback of both regions, every slice", _plain),
        ("farneback in the same slices, searched", _searched),
        *((setting, _whole(params)) for setting, params in chosen),
        *((setting, _shrunk(times)) for setting, times in shrunk),
        *((setting, with_look_ahead(ms)) for setting, ms in look_aheads),
    ]


def label_cost(seed: int, extent: Extent) -> Iterator[dict[str, Any]]:
    """Rows of every setting; `error_ms_*` in ms, run times those of a recorded millisecond.

    `error_ms_onset` is the median of |t_c - t_s| over the trials with an onset, `onsets_found` their share,
    `error_ms_reference` the largest distance from the reference's onset; run times are over the trials.
    """
    with TemporaryDirectory() as folder:
        chosen = Record(scene="slip", objects=extent.objects, seed=seed)
        files = _recorded(chosen, Path(folder))
        reference: list[int] = []
        for number, (setting, method) in enumerate(methods()):
            step = 1 if number < NEAR else extent.every
            onsets, true, took_us = [], [], []
            for path in files[::step]:
                with open_recording(path) as recording:
                    true.append(int(np.flatnonzero(recording.read("truth/slip"))[0]))
                    onset, us = method(recording, extent.around_ms)
                onsets.append(onset)
                took_us.append(us)
            reference = reference or onsets
            yield _row(setting, np.array(onsets), np.array(true), np.array(reference[::step]), np.array(took_us))


def _recorded(chosen: Record, folder: Path) -> list[Path]:
    """Record the trials, and run the default on each: reading it first, and compiling, is nobody's cost."""
    slipped = []
    for job in record.jobs([], chosen, folder):
        record.run(job, chosen)
        with open_recording(job.output) as recording:
            label.compute(recording, Label())
            if recording.read("truth/slip").any():
                slipped.append(job.output)
    return slipped


def _row(setting: str, onset: Any, true: Any, reference: Any, took_us: Any) -> dict[str, Any]:
    found = onset >= 0
    both = found & (reference >= 0)
    return {
        "part": "label",
        "setting": setting,
        "trials": len(onset),
        "error_ms_onset": float(np.median(np.abs(onset - true)[found])) if found.any() else None,
        "error_ms_reference": float(np.abs(onset - reference)[both].max()) if both.any() else None,
        "onsets_found": float(found.mean()) if len(found) else None,
        "time_us_median": float(np.median(took_us)) if len(took_us) else None,
        "time_us_p99": float(np.percentile(took_us, 99)) if len(took_us) else None,
    }


def _constants(**other: Any) -> flow.FlowConstants:
    known = flow.FlowConstants.__dataclass_fields__
    usual = {name: value for name, value in recipe_of(Label(method="farneback")).items() if name in known}
    return flow.FlowConstants(**{**usual, **other})


def _plain(recording: Recording, around_ms: int) -> tuple[int, float]:
    """Optical flow of both regions of every slice round the true onset."""
    true = int(np.flatnonzero(recording.read("truth/slip"))[0])
    start, stop = _around(recording, around_ms)
    every = _constants(coarse_ms=1, after_ms=0, clear_px=math.inf)
    onset = flow.label(recording.between, stop, *label.regions(recording), every, start).onset
    begin = time.perf_counter()
    plain = _constants(plain=True, coarse_ms=1, after_ms=0)
    last = min(true + SAMPLE_MS, len(recording))
    seen = flow.label(recording.between, last, *label.regions(recording), plain, max(true - SAMPLE_MS, 0))
    return onset, (time.perf_counter() - begin) * US / max(seen.flow_pairs, 1)


def _searched(recording: Recording, around_ms: int) -> tuple[int, float]:
    """The stage's search for the onset in the same slices, and its labels after it."""
    start, stop = _around(recording, around_ms)
    begin = time.perf_counter()
    onset = flow.label(recording.between, stop, *label.regions(recording), _constants(), start).onset
    return onset, (time.perf_counter() - begin) * US / (stop - start)


def _around(recording: Recording, around_ms: int) -> tuple[int, int]:
    true = int(np.flatnonzero(recording.read("truth/slip"))[0])
    return max(true - around_ms, 0), min(true + around_ms, len(recording))


def _whole(params: Label) -> Method:
    return lambda recording, around_ms: _timed(recording, lambda: label.compute(recording, params))


def _shrunk(times: int) -> Method:
    def method(recording: Recording, around_ms: int) -> tuple[int, float]:
        given = (*label.regions(recording), _constants(shrink=times), label.ramp_start(recording))
        return _timed(recording, lambda: flow.label(recording.between, len(recording), *given))

    return method


def with_look_ahead(look_ahead_ms: int) -> Method:
    def method(recording: Recording, around_ms: int) -> tuple[int, float]:
        dots, radius = recording.dot_xy_px, float(recording.read("sensor/dot_radius_px"))
        assert dots is not None  # a simulated recording
        constants = event_flow.EventFlowConstants(look_ahead_ms=look_ahead_ms)
        given = (*label.regions(recording), dots.reshape(-1, 2), radius, constants, label.ramp_start(recording))
        return _timed(recording, lambda: event_flow.label(recording.between, len(recording), *given))

    return method


def _timed(recording: Recording, work: Callable[[], flow.Labels]) -> tuple[int, float]:
    """The onset of labels of a whole recording, and their run time of a recorded millisecond in us."""
    begin = time.perf_counter()
    onset = work().onset
    return onset, (time.perf_counter() - begin) * US / len(recording)
