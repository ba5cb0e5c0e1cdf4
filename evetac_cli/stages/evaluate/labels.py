"""evaluate labels: the onset of the labels against the true onset, where a simulation knows it."""

from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.params import EvaluateLabels, recipe_of
from evetac_cli.stages import Job, Outcome, Progress, silent
from evetac_cli.stages.evaluate import Rows, report, report_job, with_truth
from evetac_cli.store.files import StageFile

INPUTS = ("labels", "recording")
OUTPUT = "report"
METHOD = 1


def jobs(files: list[Path], params: EvaluateLabels, out: Path | None) -> list[Job]:
    """One report over all labels files."""
    return report_job(files, "labels", out)


def run(job: Job, params: EvaluateLabels, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """A row for every trajectory: t_c from labels, t_s from truth, in ms."""
    rows: Rows = []
    headers = []
    for number, path in enumerate(job.inputs):
        with StageFile(path, "labels") as labels, with_truth(labels) as recording:
            onset = int(labels.read("onset_slice"))
            true = np.flatnonzero(recording.read("truth/slip"))
            headers.append(labels.header)
        both = onset >= 0 and len(true) > 0
        rows.append(
            {
                "file": path.name,
                "t_c_ms": onset if onset >= 0 else None,
                "t_s_ms": int(true[0]) if len(true) else None,
                "onset_error_ms": onset - int(true[0]) if both else None,
            }
        )
        progress(number + 1, len(job.inputs))

    def measure() -> tuple[Rows, dict[str, Any]]:
        errors = np.array([row["onset_error_ms"] for row in rows if row["onset_error_ms"] is not None], float)
        found = len(errors) > 0
        return rows, {
            "trajectories": len(rows),
            "onsets_found": len(errors),
            "onset_error_ms_median": float(np.median(errors)) if found else None,
            "onset_error_ms_worst": float(errors[np.argmax(np.abs(errors))]) if found else None,
            "within_minus4_plus3_ms": float(np.mean((errors >= -4) & (errors <= 3))) if found else None,
        }

    return report(job, "evaluate labels", METHOD, recipe_of(params), headers, measure, force=force)
