"""evaluate labels: the onset of the labels against the true onset, where a simulation knows it.

The true onset, t_s, is that of gross slip: the object slides as one body over the gel that the camera sees. Beside it
stands `t_every_node_ms`: the last stuck node of the pad has let go, seen or not, and the object has slid as far since;
it was the true onset of the first edition. Errors are those against t_s.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.evaluate import EvaluateLabels
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.evaluate import report, report_job
from evetac_cli.jobs import Job, Outcome, Progress, Rows, Stage, silent
from evetac_cli.stages.related_files import recording_with_truth
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings import slip_grid
from evetac_cli.store.recordings.read import Recording, first_slice, ramp_start, true_onset

OUTPUT = "report"
METHOD = 3
EARLIEST_MS = -4  # labels look 4 ms ahead
LATEST_MS = 3


def jobs(files: list[Path], params: EvaluateLabels, out: Path | None) -> list[Job]:
    """One report over all labels files."""
    return report_job(files, "labels", out)


def run(job: Job, params: EvaluateLabels, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """A row for every trajectory: t_c from labels; t_s, the start of its slip and t_every_node from truth, in ms.

    Rows and summary name the labels' method, because labels may themselves be copied from truth.
    """
    rows: Rows = []
    headers = []
    for number, path in enumerate(job.inputs):
        with StageFile(path, "labels") as labels, recording_with_truth(labels) as recording:
            onset = int(labels.read("onset_slice"))
            true, nodes = true_onsets(recording), slip_grid.nodes_of(recording)
            headers.append(labels.header)
        has_onset = onset >= 0
        t_s, gross = true["t_s_ms"], true["gross_slip_start_ms"]
        rows.append(
            {
                "file": path.name,
                "method": str(labels.header["parameters"].get("method", "farneback")),
                "t_c_ms": onset if has_onset else None,
                **true,
                "onset_error_ms": onset - t_s if has_onset and t_s is not None else None,
                "onset_before_gross_slip_ms": gross - onset if has_onset and gross is not None else None,
                slip_grid.COLUMN: nodes,
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
        later = [
            row["t_every_node_ms"] - row["t_s_ms"]
            for row in rows
            if row["t_every_node_ms"] is not None and row["t_s_ms"] is not None
        ]
        return rows, {
            "method": ", ".join(sorted({row["method"] for row in rows})),
            "trajectories": len(rows),
            "onsets_found": len(errors),
            "onset_error_ms_median": float(np.median(errors)) if any_error else None,
            "onset_error_ms_worst": float(errors[np.argmax(np.abs(errors))]) if any_error else None,
            "within_minus4_plus3_ms": float(right.sum() / slipped) if slipped else None,
            "earlier_than_4_ms_before_gross_slip": len(early),
            "every_node_after_t_s_ms_median": float(np.median(later)) if later else None,
            "every_node_after_t_s_ms_most": max(later, key=abs) if later else None,
        }

    return report(job, "evaluate labels", METHOD, recipe_of(params), headers, measure, force=force)


def for_people(rows: Rows, params: EvaluateLabels) -> tuple[Rows, list[str]]:
    """All rows, and how many onsets are right."""
    errors = [row["onset_error_ms"] for row in rows if row["onset_error_ms"] is not None]
    slipped = sum(row["t_s_ms"] is not None for row in rows)
    missed = sum(row["t_s_ms"] is not None and row["t_c_ms"] is None for row in rows)
    early = sum(error < EARLIEST_MS for error in errors)
    late = sum(error > LATEST_MS for error in errors)
    right = len(errors) - early - late
    words = f"Onset within {EARLIEST_MS} to +{LATEST_MS} ms of the true one in {right} of {slipped} that slip"
    wrong = ((early, "early"), (late, "late"), (missed, "not found"))
    told = ", ".join([words, *(f"{name} in {count}" for count, name in wrong if count)]) + "."
    return rows, [told, *slip_grid.resting_on(rows)]


def true_onsets(recording: Recording) -> dict[str, int | None]:
    """The first slice of gross slip, where that slip started, and the first slice by the pad's last stuck node.

    As for labels, a trial begins where the current starts to fall.
    """
    from evetac_cli.sim.scenes.true_slip import SLIP_PX  # here, as `report` needs no simulator for the limits above

    start, onset = ramp_start(recording), true_onset(recording)
    return {
        "t_s_ms": onset,
        "gross_slip_start_ms": None if onset is None else _gross_start(recording.read("truth/slid_px"), onset),
        "t_every_node_ms": first_slice(recording.read("truth/every_node_slid_px") > SLIP_PX, start),
    }


def _gross_start(slid_px: NDArray[np.float32], onset: int) -> int:
    """First slice of the gross slip that leads to the onset: the slice after the last without any sliding."""
    still = np.flatnonzero(slid_px[:onset] == 0.0)
    return int(still[-1]) + 1 if len(still) else 0


STAGE = Stage(jobs, run, for_people=for_people)
