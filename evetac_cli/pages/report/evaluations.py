"""Columns of the tables of evaluations: their headings, and the paper's figures next to them."""

from dataclasses import dataclass

from evetac_cli.evaluate.subject import SubjectTable
from evetac_cli.evaluate.subjects import PAPER
from evetac_cli.jobs import Rows


@dataclass(frozen=True)
class ReportColumn:
    """A column: its heading, the key of evetac's figure, and the key of the paper's in PAPER.columns."""

    heading: str
    key: str
    paper: str = ""


# Headings of columns, where that is not the name of the column with spaces.
HEADINGS = {
    "10_to_0_ms_ahead": "10 to 0 ms ahead",
    "balanced": "kept if lifted",
    "consistent_share": "all dots end at their start",
    "contact_right": "contact correct",
    "counted": "n",
    "decided": "n",
    "dots_lost_counted": "n otherwise",
    "dots_lost_mean": "dots lost otherwise",
    "error_px_rms": "error, rms [px]",
    "error_px_worst": "worst dot [px]",
    "expected_hz": "tone [Hz]",
    "f1": "F1",
    "f1_sd": "sd of F1",
    "force_end_n": "grip at the end [N]",
    "frequency_hz": "frequency [Hz]",
    "held_trials": "n kept",
    "intervals_counted": "n of intervals",
    "lifted_trials": "n lifted",
    "mae_n": "shear error [N]",
    "mae_n_x": "error of Fx [N]",
    "mae_n_y": "error of Fy [N]",
    "moved_mm_mean": "moved, mean [mm]",
    "moved_mm_median": "moved, median [mm]",
    "normal_mae_n": "normal error [N]",
    "opening_after_balance_ticks": "opening at the end [ticks]",
    "p10": "10 %",
    "p90": "90 %",
    "pairs_counted": "n",
    "reopened_columns": "objects that closed the gripper",
    "reopened_share": "reopened in balance",
    "rest_over_10_ms_early": "others: over 10 ms early",
    "rest_within_half_px": "others: within 0.5 px of sliding",
    "rest_within_minus4_plus3_ms": "others: within -4..+3 ms",
    "seconds": "duration [s]",
    "share": "share correct",
    "slip_correct": "timing correct",
    "slip_correct_sd": "sd",
    "slip_early": "early",
    "slip_late": "late",
    "slips": "that slip",
    "stiffness": "gel stiffness",
    "still_px_rms": "standing still [px]",
    "success": "lifted and kept",
    "uncertainty_hz": "uncertainty [Hz]",
    "window_s": "window [s]",
}


def columns_of(shown: SubjectTable, rows: Rows) -> tuple[ReportColumn, ...]:
    """Return the columns that have a value in any row; the paper's figure is next to evetac's."""
    every = dict.fromkeys(key for row in rows for key in row)
    names = shown.columns or tuple(
        name for name in every if not (name.startswith("paper_") and name.removeprefix("paper_") in every)
    )
    return tuple(
        ReportColumn(HEADINGS.get(name, name.replace("_", " ")), name, of_paper if of_paper in PAPER.columns else "")
        for name in names
        for of_paper in [f"paper_{name}"]
        if any(row.get(name) is not None for row in rows)
    )
