"""evaluate grasp: lifted, balanced, moved, opened (paper, "Evaluation Procedure & Control Strategy").

Lift succeeds if the object hangs more than 50 mm above the table at the end of the lifting phase, balance if it still
does so at the end. Distance moved is that of the object in the gripper since the end of light contact; the change of
opening is counted in encoder ticks since then, negative where the gripper closed.
"""

from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US
from evetac_cli.kernels.grip import Phase
from evetac_cli.params import EvaluateGrasp, recipe_of
from evetac_cli.stages import Job, Outcome, Progress, silent
from evetac_cli.stages.evaluate import Rows, report, report_job
from evetac_cli.store.files import StageFile

INPUTS = ("recording",)
OUTPUT = "report"
METHOD = 1
LIFTED_MM = 50.0


def jobs(files: list[Path], params: EvaluateGrasp, out: Path | None) -> list[Job]:
    """One report over all grasps."""
    return report_job(files, "grasp", out)


def run(job: Job, params: EvaluateGrasp, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """A row for every grasp, success shares in the summary."""
    headers = []
    for path in job.inputs:
        with StageFile(path, "recording") as recording:
            for group, what in (
                ("control", "it is no grasp"),
                ("truth/table_gap_mm", "only a simulation knows its outcome"),
            ):
                if not recording.has(group):
                    raise InputError(
                        f"the outcome cannot be told: {what}", where=str(path), expected=f"{group} in the file"
                    )
            headers.append(recording.header)

    def measure() -> tuple[Rows, dict[str, Any]]:
        rows: Rows = []
        for number, path in enumerate(job.inputs):
            with StageFile(path, "recording") as recording:
                rows.append({"file": path.name, **_outcome(recording)})
            progress(number + 1, len(job.inputs))
        shares = {f"{name}_share": float(np.mean([row[name] for row in rows])) for name in ("lifted", "balanced")}
        return rows, {"grasps": len(rows), **shares}

    return report(job, "evaluate grasp", METHOD, recipe_of(params), headers, measure, force=force)


def _outcome(recording: StageFile) -> dict[str, Any]:
    """What became of one grasp."""
    gap_mm = recording.read("truth/table_gap_mm")
    force_n = recording.read("truth/normal_force_n")
    object_mm = recording.read("truth/object_xy_px") * recording.header["parameters"]["individual_row"]["mm_per_px"]
    step_ms = recording.read("control/t_us") // SLICE_US
    phase = recording.read("control/phase")
    ticks = recording.read("gripper/position_ticks")
    planned = recording.header["parameters"]
    planned_ms = round(1000 * (planned["scene"]["time"]["touch_s"] + planned["lift_s"] + planned["balance_s"]))
    touched, lifted = (np.flatnonzero(phase <= end)[-1] for end in (Phase.CONTACT, Phase.LIFT))
    touched_ms, lifted_ms, last_ms = step_ms[touched], step_ms[lifted], len(gap_mm) - 1

    def hangs(at_ms: int) -> bool:
        return bool(gap_mm[at_ms] > LIFTED_MM and force_n[at_ms] > 0)

    held = hangs(lifted_ms)
    return {
        "object": planned["object"],
        "controller": planned["controller"],
        "lifted": held,
        "balanced": held and hangs(last_ms) and len(gap_mm) >= planned_ms,
        "moved_mm": float(np.hypot(*(object_mm[last_ms] - object_mm[touched_ms]))),
        "opening_lift_ticks": int(ticks[touched] - ticks[lifted]),
        "opening_end_ticks": int(ticks[touched] - ticks[-1]),
        "force_end_n": float(force_n[last_ms]),
        "slip_events": int(np.sum(np.diff(recording.read("control/slip").astype(int)) > 0)),
    }
