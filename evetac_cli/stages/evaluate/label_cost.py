"""What a method of labelling costs and how late it is: onset error against run time, on small seeded slip trials.

The reference is optical flow of both regions, computed for every slice whether or not it can change the answer, in the
slices round the true onset: elsewhere it would take a minute a recorded second. Its run time is that of the slices it
looked at.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from evetac_cli.kernels import event_flow, flow
from evetac_cli.params import Label, Record, recipe_of
from evetac_cli.stages import label, record
from evetac_cli.store.read import Recording, open_recording

US = 1e6


@dataclass(frozen=True)
class Extent:
    """Objects that slip, one trial each, and how many slices on either side of the onset the reference looks at."""

    objects: str
    around_ms: int


USUAL = Extent("3,8,16", 40)
FULL = Extent("1,3,4,6,8,10,12,14,16,17", 200)

# What is asked for -> onset and how many slices were looked at.
Method = Callable[[Recording, int], tuple[int, int]]


def methods() -> list[tuple[str, Method]]:
    """The settings that are compared; the first is the reference."""
    default = Label()
    chosen = [
        *((f"farneback, steps of {step} ms", replace(default, method="farneback", coarse_ms=step)) for step in (5, 20)),
        *((f"dis, steps of {step} ms", replace(default, method="dis", coarse_ms=step)) for step in (5, 20)),
        ("event-count, steps of 5 ms", replace(default, method="event-count")),
    ]
    shrunk = [(f"farneback in steps of 5 ms, {times} x smaller", times) for times in (2, 4)]
    ahead = [(f"event-flow, look-ahead {ahead_ms} ms", ahead_ms) for ahead_ms in (1, 2, 4)]
    return [
        ("farneback of both regions, every slice", _plain),
        *((setting, _whole(params)) for setting, params in chosen),
        *((setting, _shrunk(times)) for setting, times in shrunk),
        *((setting, _ahead(ahead_ms)) for setting, ahead_ms in ahead),
    ]


def label_cost(seed: int, extent: Extent) -> Iterator[dict[str, Any]]:
    """Rows of every setting; `error_ms_*` in ms, run times those of a recorded millisecond.

    `error_ms_onset` is the median of |t_c - t_s| over the trials with an onset, `onsets_found` their share,
    `error_ms_reference` the largest distance from the reference's onset; run times are over the trials.
    """
    with TemporaryDirectory() as folder:
        chosen = Record(scene="slip", objects=extent.objects, seed=seed)
        files = [job.output for job in _recorded(chosen, Path(folder))]
        reference: list[int] = []
        for setting, method in methods():
            onsets, true, took_us = [], [], []
            for path in files:
                with open_recording(path) as recording:
                    slips = np.flatnonzero(recording.read("truth/slip"))
                    if not len(slips):
                        continue
                    begin = time.perf_counter()
                    onset, looked_at = method(recording, extent.around_ms)
                    took_us.append((time.perf_counter() - begin) * US / max(looked_at, 1))
                onsets.append(onset)
                true.append(int(slips[0]))
            reference = reference or onsets
            yield _row(setting, np.array(onsets), np.array(true), np.array(reference), np.array(took_us))


def _recorded(chosen: Record, folder: Path) -> list[Any]:
    """Record the trials, and run the default on each: reading it first, and compiling, is nobody's cost."""
    jobs = record.jobs([], chosen, folder)
    for job in jobs:
        record.run(job, chosen)
        with open_recording(job.output) as recording:
            label.compute(recording, Label())
    return jobs


def _row(setting: str, onset: Any, true: Any, reference: Any, took_us: Any) -> dict[str, Any]:
    found = onset >= 0
    both = found & (reference >= 0)
    return {
        "part": "label",
        "setting": setting,
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


def _plain(recording: Recording, around_ms: int) -> tuple[int, int]:
    """Optical flow of every slice round the true onset up to the one found; how many it looked at."""
    onset = int(np.flatnonzero(recording.read("truth/slip"))[0])
    start, stop = max(onset - around_ms, 0), min(onset + around_ms, len(recording))
    constants = _constants(plain=True, coarse_ms=1, after_ms=0)
    found = flow.label(recording.between, stop, *label.regions(recording), constants, start)
    return found.onset, found.pairs


def _whole(params: Label) -> Method:
    return lambda recording, around_ms: (label.compute(recording, params).onset, len(recording))


def _shrunk(times: int) -> Method:
    def method(recording: Recording, around_ms: int) -> tuple[int, int]:
        window, gel = label.regions(recording)
        start = label.ramp_start(recording)
        found = flow.label(recording.between, len(recording), window, gel, _constants(shrink=times), start)
        return found.onset, len(recording)

    return method


def _ahead(ahead_ms: int) -> Method:
    def method(recording: Recording, around_ms: int) -> tuple[int, int]:
        dots, radius = recording.dot_xy_px, float(recording.read("sensor/dot_radius_px"))
        assert dots is not None  # a simulated recording
        constants = event_flow.EventFlowConstants(look_ahead_ms=ahead_ms)
        start = label.ramp_start(recording)
        window, gel = label.regions(recording)
        given = (recording.between, len(recording), window, gel, dots.reshape(-1, 2), radius, constants, start)
        return event_flow.label(*given).onset, len(recording)

    return method
