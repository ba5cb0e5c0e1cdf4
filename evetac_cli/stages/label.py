"""label: when the object slips, from optical flow in the window (paper, "Data Labelling - Slip Classifier").

A trajectory begins where the object is held stably and the gripper's current starts to fall (paper, "Experimental
Setup and Data Collection Procedure"); closing and loading before are not examined. Without a gripper it begins at 0.
"""

from dataclasses import asdict
from pathlib import Path

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.kernels import flow
from evetac_cli.params import Label, recipe_of
from evetac_cli.stages import Job, Outcome, Progress, outcome, per_file, silent
from evetac_cli.store.files import up_to_date, write_stage
from evetac_cli.store.provenance import Recipe
from evetac_cli.store.read import Recording, open_recording

INPUTS = ("recording",)
OUTPUT = "labels"
METHOD = 1


def jobs(files: list[Path], params: Label, out: Path | None) -> list[Job]:
    """One labels file for every recording."""
    return per_file(files, OUTPUT, out)


def run(job: Job, params: Label, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Compute the flow where it can matter, and label every slice."""
    constants = flow.FlowConstants(**recipe_of(params))
    with open_recording(job.inputs[0]) as recording:
        recipe = Recipe(OUTPUT, METHOD, asdict(constants), parents=(recording.header,))
        simulated = recording.header["simulated"]
        if up_to_date(job.output, recipe, force=force):
            return outcome(job, made=False, simulated=simulated)
        window = recording.window_px
        if window is None:
            raise InputError(
                "slip cannot be labelled: the gel has no window",
                where=str(recording.path),
                expected="a recording with sensor/window_px",
                hint="record with a cut gel, or give window_px in the calibration",
            )
        slices = len(recording)
        gel = (0, 0, window[0], recording.frame_px[1])

        def between(start: int, stop: int) -> Events:
            progress(start, slices)
            return recording.between(start, stop)

        start = ramp_start(recording)
        labels = flow.label(between, slices, window, gel, constants, start)
    arrays = {
        "label": labels.label,
        "relative_flow_px": labels.relative_flow_px,
        "onset_slice": np.int64(labels.onset),
        "confidence": np.float64(labels.confidence),
        "pairs_computed": np.int64(labels.pairs),
    }
    write_stage(job.output, recipe, arrays)
    return outcome(
        job,
        made=True,
        simulated=simulated,
        slices=slices,
        onset_ms=labels.onset,
        confidence=labels.confidence,
        pairs=labels.pairs,
    )


def ramp_start(recording: Recording) -> int:
    """The slice in which the target current first departs from the one that holds the object; 0 without a gripper."""
    if not recording.has("gripper"):
        return 0
    target_ma = recording.read("gripper/current_target_ma")
    change = np.diff(target_ma)  # NaN in position mode
    changed = np.flatnonzero(np.isfinite(change) & (change != 0))
    return int(recording.read("gripper/t_us")[changed[0] + 1] // SLICE_US) if len(changed) else 0
