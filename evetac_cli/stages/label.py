"""label: when the object slips, from its motion in the window (paper, "Data Labelling - Slip Classifier").

A trajectory begins when the object is held stably and the gripper's current starts to fall (paper, "Experimental
Setup and Data Collection Procedure"); closing and loading before that are not examined. Without a gripper it begins at
slice 0.

Each onset has an interval that contains it. If the onset cannot be determined, the labels abstain and state why: the
slices of its interval are then neither slip nor no slip.

The methods: `event-flow` (default) counts motion from events, `farneback` is the paper's optical flow, `dis` and
`event-count` are alternatives, and `truth` copies gross slip from a simulation. The method is stored in the header of
the labels and of all files made from them.
"""

import time
from dataclasses import fields
from pathlib import Path

import numpy as np

from evetac_cli.commands.label import Label
from evetac_cli.commands.parameter import flag_of, recipe_of
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX
from evetac_cli.jobs import Job, Outcome, Progress, Rows, Stage, outcome, silent
from evetac_cli.kernels.labelling import flow
from evetac_cli.stages import label_review, per_file
from evetac_cli.stages.label_methods import compute
from evetac_cli.store.files import up_to_date, write_stage
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.store.recordings.read import open_recording

OUTPUT = "labels"
METHOD = 7
OF_REVIEW = ("after_ms",)  # parameters of the recipe that also apply to manual labels


def jobs(files: list[Path], params: Label, out: Path | None) -> list[Job]:
    """Return a job for every recording; with --review one job for all of them."""
    if params.review:
        _refuse_options_of_methods(params)
        return list(label_review.jobs(files, out))
    if params.by:
        raise InputError("has an effect only on manual labels", where="--by", expected="together with --review")
    return per_file(files, OUTPUT, out)


def _refuse_options_of_methods(params: Label) -> None:
    """Raise InputError for an option of the automatic methods if a person labels."""
    for item in fields(params):
        value = getattr(params, item.name)
        if item.metadata["recipe"] and item.name not in OF_REVIEW and value != item.default:
            hint = f"leave out {flag_of(item)}, or label with it first and review without"
            raise InputError("has no effect with --review", where=flag_of(item), found=str(value), hint=hint)


def _recipe(params: Label, recording: Header, frame_px: tuple[int, int]) -> Recipe:
    """Return the recipe; only `event-flow`, which tracks the dots, depends on the frame, and only on another one."""
    other = {"frame_px": list(frame_px)} if params.method == "event-flow" and frame_px != FRAME_PX else {}
    return Recipe(OUTPUT, METHOD, recipe_of(params) | other, parents=(recording,))


def run(job: Job, params: Label, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Find the onset by the chosen method and label every slice; with --review, a person does."""
    if params.review:
        assert isinstance(job, label_review.ReviewJob)
        return label_review.run(job, params)
    with open_recording(job.inputs[0]) as recording:
        recipe = _recipe(params, recording.header, recording.frame_px)
        simulated = recording.header["simulated"]
        if up_to_date(job.output, recipe, force=force):
            return outcome(job, made=False, simulated=simulated)
        began_s = time.process_time()
        labels = compute(recording, params, progress)
        took_s = time.process_time() - began_s
        slices = len(recording)
    arrays = {
        "label": labels.label,
        "relative_flow_px": labels.relative_flow_px,
        "onset_slice": np.int64(labels.onset),
        "earliest_slice": np.int64(labels.earliest),
        "latest_slice": np.int64(labels.latest),
        "abstained": np.uint8(bool(labels.doubt)),
        "doubt": labels.doubt,
        "confidence": np.float64(labels.confidence),
        "flow_pairs_computed": np.int64(labels.flow_pairs),
    }
    made = write_stage(job.output, recipe, arrays, force=force) is not None
    return outcome(
        job,
        made=made,
        simulated=simulated,
        method=params.method,
        slices=slices,
        onset_ms=labels.onset if labels.onset >= 0 else None,
        earliest_ms=labels.earliest if labels.earliest >= 0 else None,
        latest_ms=labels.latest if labels.latest >= 0 else None,
        confidence=labels.confidence if labels.onset >= 0 else None,
        abstained=bool(labels.doubt),
        doubt=labels.doubt or None,
        flow_pairs=labels.flow_pairs if params.method in flow.METHODS else None,
        cpu_s=took_s,
    )


def warnings(rows: Rows) -> list[str]:
    """Return a warning with the number of recordings in which labels abstain, and the reason in the first of them."""
    doubts = [row["doubt"] for row in rows if row.get("doubt")]
    if not doubts:
        return []
    message = f"labels abstain in {len(doubts)} of {len(rows)}: their onset is used neither for training nor evaluation"
    return [f"{message}; the first: {doubts[0]}"]


STAGE = Stage(jobs, run, warnings=warnings)
