"""evaluate labels: the onset of the labels against the true onset, where a simulation knows it."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.jobs import Job, Outcome, Progress, silent
from evetac_cli.params import EvaluateLabels, recipe_of
from evetac_cli.stages.evaluate import Rows, report, report_job
from evetac_cli.stages.related_files import recording_with_truth
from evetac_cli.store.files import StageFile

OUTPUT = "report"
METHOD = 2
EARLIEST_MS = -4  # labels look 4 ms ahead
LATEST_MS = 3


def jobs(files: list[Path], params: EvaluateLabels, out: Path | None) -> list[Job]:
    """One report over all labels files."""
    return report_job(files, "labels", out)


def run(job: Job, params: EvaluateLabels, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """A row for every trajectory: t_c from labels, t_s and the start of gross slip from truth, in ms.

    Rows and summary name the labels' method, because labels may themselves be copied from truth.
    """
    rows: Rows = []
    headers = []
    for number, path in enumerate(job.inputs):
        with StageFile(path, "labels") as labels, recording_with_truth(labels) as recording:
            onset = int(labels.read("onset_slice"))
            true = np.flatnonzero(recording.read("truth/slip"))
            gross = _gross_start(recording.read("truth/slid_px"), int(true[0])) if len(true) else None
            headers.append(labels.header)
        both = onset >= 0 and len(true) > 0
        rows.append(
            {
                "file": path.name,
                "method": labels.header["parameters"].get("method", "farneback"),
                "t_c_ms": onset if onset >= 0 else None,
                "t_s_ms": int(true[0]) if len(true) else None,
                "gross_slip_start_ms": gross,
                "onset_error_ms": onset - int(true[0]) if both else None,
                "onset_before_gross_slip_ms": gross - onset if both and gross is not None else None,
            }
        )
        progress(number + 1, len(job.inputs))

    def measure() -> tuple[Rows, dict[str, Any]]:
        errors = np.array([row["onset_error_ms"] for row in rows if row["onset_error_ms"] is not None], float)
        any_error = len(errors) > 0
        early = [
            row
            for row in rows
            if row["onset_before_gross_slip_ms"] is not None and row["onset_before_gross_slip_ms"] > -EARLIEST_MS
        ]
        right = (errors >= EARLIEST_MS) & (errors <= LATEST_MS)
        slipped = sum(row["t_s_ms"] is not None for row in rows)
        return rows, {
            "method": ", ".join(sorted({row["method"] for row in rows})),
            "trajectories": len(rows),
            "onsets_found": len(errors),
            "onset_error_ms_median": float(np.median(errors)) if any_error else None,
            "onset_error_ms_worst": float(errors[np.argmax(np.abs(errors))]) if any_error else None,
            "within_minus4_plus3_ms": float(right.sum() / slipped) if slipped else None,
            "earlier_than_4_ms_before_gross_slip": len(early),
        }

    return report(job, "evaluate labels", METHOD, recipe_of(params), headers, measure, force=force)


def _gross_start(slid_px: NDArray[np.float64], onset: int) -> int:
    """First slice of the gross slip that leads to the onset: the slice after the last without any sliding."""
    still = np.flatnonzero(slid_px[:onset] == 0.0)
    return int(still[-1]) + 1 if len(still) else 0
