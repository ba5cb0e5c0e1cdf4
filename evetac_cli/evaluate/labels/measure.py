"""evaluate labels: error of the labelled onset against the true onset of a simulation.

The true onset, t_s, is that of gross slip: the object slides as one body over the gel that the camera sees. The column
`t_every_node_ms` is another definition, used in the first edition: the last stuck node of the pad has let go, visible
or not, and the object has slid equally far since. Errors are relative to t_s.

An error in px is how far the object truly slid as one body between the labels' onset and t_s; negative values are
early. Errors in ms alone would mislead. At 0.05 px/ms the 0.5 px of gross slip take 10 ms, none of which is the onset.
When gel snaps back, an object slides 5 px in 1 ms. Labels that abstain are counted but not evaluated.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.evaluate.common.report import report, report_job
from evetac_cli.evaluate.common.rows import each, mean, quantile
from evetac_cli.evaluate.labels import EvaluateLabels
from evetac_cli.jobs import Job, Outcome, Progress, Row, Rows, Stage, silent
from evetac_cli.stages.related_files import recording_with_truth
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings import slip_grid
from evetac_cli.store.recordings.onset import LabelledOnset, in_short, labelled_onset
from evetac_cli.store.recordings.read import Recording, first_slice, ramp_start, true_onset

METHOD = 6
EARLIEST_MS = -4  # labels look 4 ms ahead
LATEST_MS = 3
NEAR_PX = 0.5  # of true sliding, early or late: an onset this near is correct ...
EARLY_MS = 10  # ... unless it is more than this early


def jobs(files: list[Path], params: EvaluateLabels, out: Path | None) -> list[Job]:
    """Return one report job over all labels files."""
    return report_job(files, "labels", out)


def run(job: Job, params: EvaluateLabels, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return a row per trajectory, in ms: t_c from labels; t_s, the start of its slip and t_every_node from truth.

    Rows and summary name the method of the labels, because labels may be copied from the truth.
    """
    rows: Rows = []
    headers = []
    for path in each(job.inputs, progress):
        with StageFile(path, "labels") as labels, recording_with_truth(labels, "truth/slid_px") as recording:
            labelled = labelled_onset(labels)
            true, nodes = true_onsets(recording), slip_grid.nodes_of(recording)
            slid_px = recording.read("truth/slid_px")
            headers.append(labels.header)
        method = str(labels.header["parameters"].get("method", "farneback"))
        row = {"file": path.name, "method": method, **judged(labelled, true, slid_px), slip_grid.COLUMN: nodes}
        rows.append(row)

    def measure() -> tuple[Rows, dict[str, Any]]:
        return rows, summary(rows)

    return report(job, "evaluate labels", METHOD, recipe_of(params), headers, measure, force=force)


def judged(estimate: LabelledOnset, true: dict[str, int | None], slid_px: NDArray[np.float32]) -> Row:
    """Return the row of a labelled onset against truth: errors in ms and px, coverage and width of its interval.

    true: from `true_onsets`; slid_px (slices,): from the truth. Negative errors are early.
    """
    t_c, t_s, gross = estimate.slice_, true["t_s_ms"], true["gross_slip_start_ms"]
    slid = slid_so_far(slid_px)
    row: Row = {"t_c_ms": t_c, **true, "onset_error_ms": None, "onset_error_px": None}
    if t_c is not None and t_s is not None:
        row |= {"onset_error_ms": t_c - t_s, "onset_error_px": float(slid[t_c] - slid[t_s])}
    row["onset_before_gross_slip_ms"] = gross - t_c if t_c is not None and gross is not None else None
    row |= {"earliest_ms": estimate.earliest, "latest_ms": estimate.latest}
    row |= dict.fromkeys(("interval_covers", "interval_width_px", "interval_width_ms"))
    if estimate.earliest is not None and estimate.latest is not None and t_s is not None:
        row |= {
            "interval_covers": estimate.earliest <= t_s <= estimate.latest,
            "interval_width_px": float(slid[estimate.latest] - slid[estimate.earliest]),
            "interval_width_ms": estimate.latest - estimate.earliest,
        }
    return row | {"confidence": estimate.confidence, "abstained": estimate.abstained, "doubt": estimate.doubt or None}


def slid_so_far(slid_px: NDArray[np.float32]) -> Floats:
    """Return the total sliding of the object as one body up to each slice, over all slides; slid_px (slices,)."""
    return np.concatenate([[0.0], np.cumsum(np.maximum(np.diff(slid_px.astype(np.float64)), 0.0))])


def summary(rows: Rows) -> dict[str, Any]:
    """Return the summary of rows.

    `rest_` marks shares of the `counted` trajectories, which slip and whose labels do not abstain; errors are over the
    `onsets_found` among these. Other shares are of all that slip, where the best guess of an abstention counts.
    """
    slipped = [row for row in rows if row["t_s_ms"] is not None]
    rest = [row for row in slipped if not row["abstained"]]
    found = [row for row in rest if row["onset_error_ms"] is not None]
    errors = [row["onset_error_ms"] for row in found]
    early = [row for row in rows if not row["abstained"] and (row["onset_before_gross_slip_ms"] or 0) > -EARLIEST_MS]
    later = [row["t_every_node_ms"] - row["t_s_ms"] for row in slipped if row["t_every_node_ms"] is not None]
    judged_rest = [row for row in rest if row["interval_covers"] is not None]
    return {
        "method": ", ".join(sorted({row["method"] for row in rows})),
        "trajectories": len(rows),
        "slips": len(slipped),
        "counted": len(rest),
        "onsets_found": len(errors),
        "abstained": sum(row["abstained"] for row in rows),
        "abstained_share": mean(row["abstained"] for row in slipped),
        "rest_within_half_px": mean(is_near(row) for row in rest),
        "rest_over_10_ms_early": sum((row["onset_error_ms"] or 0) < -EARLY_MS for row in rest),
        "rest_within_minus4_plus3_ms": mean(_in_time(row) for row in rest),
        "within_half_px": mean(is_near(row) for row in slipped),
        "intervals_counted": len(judged_rest),
        "interval_coverage": mean(row["interval_covers"] for row in judged_rest),
        "interval_width_px_median": quantile(row["interval_width_px"] for row in judged_rest),
        "interval_width_ms_median": quantile(row["interval_width_ms"] for row in judged_rest),
        "onset_error_px_median": quantile(row["onset_error_px"] for row in found),
        "onset_error_ms_median": quantile(errors),
        "onset_error_ms_worst": float(max(errors, key=abs)) if errors else None,
        "within_minus4_plus3_ms": mean(_in_time(row) for row in slipped),
        "earlier_than_4_ms_before_gross_slip": len(early),
        "every_node_counted": len(later),
        "every_node_after_t_s_ms_median": quantile(later),
        "every_node_after_t_s_ms_most": max(later, key=abs) if later else None,
    }


def is_near(row: Row) -> bool:
    """Whether an onset is correct: within NEAR_PX of true sliding of the true onset, and at most EARLY_MS early."""
    found = row["onset_error_px"] is not None
    return found and abs(row["onset_error_px"]) <= NEAR_PX and row["onset_error_ms"] >= -EARLY_MS


def _in_time(row: Row) -> bool:
    return row["onset_error_ms"] is not None and EARLIEST_MS <= row["onset_error_ms"] <= LATEST_MS


def for_people(rows: Rows, params: EvaluateLabels) -> tuple[Rows, list[str]]:
    """Return all rows, and sentences with the number of correct onsets."""
    slipped = [row for row in rows if row["t_s_ms"] is not None]
    rest = [row for row in slipped if not row["abstained"]]
    wrong = [row["onset_error_ms"] for row in rest if row["onset_error_ms"] is not None and not is_near(row)]
    sentences = [
        f"Onset within {NEAR_PX} px of sliding of the true onset, at most {EARLY_MS} ms early, in"
        f" {sum(is_near(row) for row in rest)} of {len(rest)}, early in {sum(error < 0 for error in wrong)}, late in"
        f" {sum(error >= 0 for error in wrong)}, not found in {sum(row['t_c_ms'] is None for row in rest)}.",
        f"Within {EARLIEST_MS} to +{LATEST_MS} ms: {sum(_in_time(row) for row in rest)} of {len(rest)}.",
    ]
    if abstained := len(slipped) - len(rest):
        sentences.append(
            f"The labels abstain in {abstained} of {len(slipped)} trials that slip; these are not evaluated:"
            f" {in_short(row['doubt'] for row in slipped if row['abstained'])}."
        )
    if still := len(rows) - len(slipped):
        sentences.append(f"{still} of {len(rows)} trials do not slip and are not evaluated.")
    return rows, [*sentences, *slip_grid.resting_on(rows)]


def true_onsets(recording: Recording) -> dict[str, int | None]:
    """Return the true onset t_s, the start of its gross slip, and the onset by the pad's last stuck node.

    As for labels, a trial begins when the current starts to fall.
    """
    from evetac_cli.sim.scenes.true_slip import SLIP_PX  # late: `report` needs the limits above, not the simulator

    start, onset = ramp_start(recording), true_onset(recording)
    return {
        "t_s_ms": onset,
        "gross_slip_start_ms": None if onset is None else _gross_start(recording.read("truth/slid_px"), onset),
        "t_every_node_ms": first_slice(recording.read("truth/every_node_slid_px") > SLIP_PX, start),
    }


def _gross_start(slid_px: NDArray[np.float32], onset: int) -> int:
    """Return the first slice of the gross slip that leads to the onset: the one after the last without sliding."""
    still = np.flatnonzero(slid_px[:onset] == 0.0)
    return int(still[-1]) + 1 if len(still) else 0


STAGE = Stage(jobs, run, for_people=for_people)
