"""evaluate tracking: tracked dots against true dots, where a simulation knows them."""

from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.params import EvaluateTracking, recipe_of
from evetac_cli.stages import Job, Outcome, Progress, silent
from evetac_cli.stages.evaluate import Rows, report, report_job, with_truth
from evetac_cli.store.files import StageFile

INPUTS = ("tracks", "recording")
OUTPUT = "report"
METHOD = 1


def jobs(files: list[Path], params: EvaluateTracking, out: Path | None) -> list[Job]:
    """One report over all tracks files."""
    return report_job(files, "tracking", out)


def run(job: Job, params: EvaluateTracking, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """A row for every trajectory: rms and worst distance from the true centre over all dots and slices, in px."""
    headers = []
    for path in job.inputs:
        with StageFile(path, "tracks") as tracks, with_truth(tracks):
            headers.append(tracks.header)

    def measure() -> tuple[Rows, dict[str, Any]]:
        rows: Rows = []
        for number, path in enumerate(job.inputs):
            with StageFile(path, "tracks") as tracks, with_truth(tracks) as recording:
                rows.append({"file": path.name, **_errors(tracks, recording)})
            progress(number + 1, len(job.inputs))
        squares = [row["error_px_rms"] ** 2 for row in rows]
        summary = {
            "trajectories": len(rows),
            "error_px_rms": float(np.sqrt(np.mean(squares))),
            "error_px_worst": max(row["error_px_worst"] for row in rows),
            "still_px_rms": float(np.sqrt(np.mean([row["still_px_rms"] ** 2 for row in rows]))),
            "dots_lost": sum(row["dots_lost"] for row in rows),
        }
        return rows, summary

    return report(job, "evaluate tracking", METHOD, recipe_of(params), headers, measure, force=force)


def _errors(tracks: StageFile, recording: StageFile) -> dict[str, Any]:
    """Distances from truth; `still` is the error of a tracker that never moves, for comparison."""
    true = recording.read("truth/dot_xy_px")
    error = np.linalg.norm(tracks.read("dot_xy_px") - true, axis=2)
    rest = tracks.read("sensor/dot_xy_px").reshape(-1, 2)
    still = np.linalg.norm(rest - true, axis=2)
    return {
        "error_px_rms": float(np.sqrt(np.mean(error**2))),
        "error_px_worst": float(error.max()),
        "still_px_rms": float(np.sqrt(np.mean(still**2))),
        "dots_lost": int(tracks.read("lost")[-1].sum()),
    }
