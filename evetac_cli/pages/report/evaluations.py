"""Contents of the report for each evaluation: its rows and columns, and the paper's figures next to them."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from evetac_cli.evaluate.common import paper
from evetac_cli.evaluate.common.rows import mean
from evetac_cli.jobs import Row, Rows
from evetac_cli.pages.report.study import Found


@dataclass(frozen=True)
class ReportColumn:
    """A column: its heading, the key of evetac's figure, and the key of the paper's in paper.SHOWN."""

    heading: str
    key: str
    paper: str = ""


@dataclass(frozen=True)
class Subject:
    """A table of a section: the rows that it takes from a report, and their columns; empty: all columns of the rows."""

    command: str
    title: str
    rows: Callable[[Found], Rows]
    columns: tuple[str, ...] = ()

    @property
    def section(self) -> str:
        """The section in which it is."""
        return self.command.removeprefix("evaluate ")


@dataclass(frozen=True)
class Section:
    """A section of the page: its name, as in `evetac evaluate NAME`, its title, and a sentence on its contents."""

    name: str
    title: str
    caption: str


SECTIONS = (
    Section(
        "slip",
        "Slip detection by model",
        "A first detection is correct from 50 ms before to 20 ms after the onset of labels or, where a row says so, of"
        " the simulation's truth; earlier is early, later or never is late. Shares are over the n trajectories that"
        " count, without those whose labels abstain or that do not slip."
        " Means over objects and trainings, as in the paper.",
    ),
    Section("labels", "Labels against the truth", "t_c - t_s, in simulations only."),
    Section(
        "tracking",
        "Dot tracking",
        "Whether every dot ends where it began, and its distance from the truth. The first is unknown for a simulated"
        " trajectory that ends with the gel sheared, so n is smaller.",
    ),
    Section(
        "grasp",
        "Grasps",
        "Objects lifted and kept using touch, by controller and object. Grip, opening and motion are over the n kept.",
    ),
    Section(
        "force",
        "Forces from dots",
        "Mean absolute error over unseen trajectories. Touch maps have errors only where a contact is found and enough"
        " dots are tracked.",
    ),
    Section(
        "vibration",
        "Vibration",
        "Windows in which the frequency of the tone is detected, in recordings with a known tone that are long enough.",
    ),
    Section(
        "data-rate",
        "Data rate",
        f"Bytes per second of {paper.COLUMNS} columns as a share of an RGB sensor's, as in the paper; next to it the"
        " share of the columns beyond, where a cut gel has its window.",
    ),
    Section(
        "realism",
        "Simulated against real",
        "Differences between figures of a simulated recording and a real one.",
    ),
    Section(
        "likeness",
        "Public facts about the sensor",
        "Publicly known facts about the real sensor, compared with recordings and with evetac's trainings and grasps.",
    ),
    Section(
        "benchmark",
        "Benchmark",
        "Five scores on recordings of sensors and objects that no method of evetac was trained on, with 95 % intervals"
        " over sensors and objects.",
    ),
    Section(
        "cost",
        "Error against run time",
        "Run times depend on the computer and its load when they were measured.",
    ),
    Section(
        "stability",
        "Stiff and extreme cases",
        "Each case must stay within a stated bound or be refused with a reason; cases that do neither come first.",
    ),
)


def having(*keys: str) -> Callable[[Found], Rows]:
    """Return a function that selects rows with these columns; each table of a report has its own columns."""
    return lambda evaluation: [row for row in evaluation.rows if all(key in row for key in keys)]


# Combined rows --------------------------------------------------------------------------------------------------------


def _grouped(rows: Iterable[Row], keys: tuple[str, ...]) -> list[Rows]:
    groups: dict[tuple[Any, ...], Rows] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return list(groups.values())


def _timing(evaluation: Found) -> Rows:
    """Return the detection times of each setting, joined with the setting's own row."""
    settings = {row["setting"]: row for row in having("setting", "seeds")(evaluation)}
    return [{**settings.get(row["setting"], {}), **row} for row in having("setting", "over_50_ms_ahead")(evaluation)]


def _forces(evaluation: Found) -> Rows:
    """Return means over trajectories for each sensor and model of the paper's method."""
    rows = [{"tracker": None, **row} for row in having("model", "sensor", "mae_n_x")(evaluation)]
    groups = _grouped(rows, ("sensor", "tracker", "model", "sensor_name"))
    keys = ("mae_n_x", "mae_n_y", "paper_mae_n_x", "paper_mae_n_y")
    return [
        {**members[0], "trajectories": len(members), **{key: mean(row.get(key) for row in members) for key in keys}}
        for members in groups
    ]


def _gel_forces(evaluation: Found) -> Rows:
    """Return means over trajectories by knowledge of the gel."""
    keys = ("mae_n", "normal_mae_n", "shear_within_sd", "normal_within_sd", "contact_right")
    groups = _grouped(having("stiffness", "mae_n")(evaluation), ("stiffness",))
    return [
        {
            **members[0],
            "trajectories": len(members),
            "counted": sum(row["mae_n"] is not None for row in members),
            **{key: mean(row.get(key) for row in members) for key in keys},
        }
        for members in groups
    ]


def _windows(evaluation: Found) -> Rows:
    """Return shares over all recordings of a tone."""
    rows = []
    for members in _grouped(
        having("window_s", "correct", "expected_hz")(evaluation), ("method", "expected_hz", "window_s")
    ):
        correct, windows = (sum(row[key] for row in members) for key in ("correct", "windows"))
        recordings = {"recordings": len(members), "correct": correct, "windows": windows, "share": correct / windows}
        rows.append({**members[0], **recordings})
    return rows


def _cases(evaluation: Found) -> Rows:
    """Return a row per case: the quantity nearest to its bound or farthest beyond it; failed cases come first."""
    part = next(
        (key for key in ("part", "preset", "controller") if evaluation.rows and key in evaluation.rows[0]), "case"
    )
    worst = []
    for members in _grouped(evaluation.rows, (part, "case")):
        row = min(members, key=lambda row: (row["ok"], -(row["value"] or 0.0) / (row["bound"] or 1.0)))
        worst.append({**row, "part": row[part]})
    return sorted(worst, key=lambda row: bool(row["ok"]))


def _summary(evaluation: Found) -> Rows:
    return [evaluation.summary]


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
# How many trajectories are behind the shares of `evaluate slip`, and how many are left out.
COUNTS = ("trajectories", "counted", "abstained", "no_slip")
SHARES = ("slip_correct", "slip_early", "slip_late", "f1")
SUBJECTS = (
    Subject(
        "evaluate slip",
        "The slips used for evaluation, median and 10-90 % range",
        having("covariate", "median"),
        ("covariate", "median", "p10", "p90", "n"),
    ),
    Subject(
        "evaluate slip",
        "Models",
        having("setting", "seeds"),
        ("setting", "judged_by", "seeds", *COUNTS, *SHARES, "slip_correct_sd", "f1_sd"),
    ),
    Subject(
        "evaluate slip",
        "By sensor",
        having("setting", "sensor", "counted"),
        ("setting", "judged_by", "sensor", *COUNTS, *SHARES, "warned_10_ms", "false_alarms_per_min"),
    ),
    Subject(
        "evaluate slip",
        "First detection relative to the onset, shares of pairs of slip and model",
        _timing,
        (
            *("setting", "judged_by", "pairs_counted", "t_m_minus_t_c_ms_median"),
            *("over_50_ms_ahead", "50_to_31_ms_ahead", "30_to_11_ms_ahead", "10_to_0_ms_ahead", "1_to_20_ms_after"),
            *("over_20_ms_after", "never_detected"),
        ),
    ),
    Subject(
        "evaluate labels",
        "Labelled onset against gross slip",
        _summary,
        (
            *("method", "trajectories", "slips", "counted", "abstained"),
            *("rest_within_half_px", "rest_over_10_ms_early", "rest_within_minus4_plus3_ms"),
            *("intervals_counted", "interval_coverage", "interval_width_px_median"),
            *("onsets_found", "onset_error_ms_median", "onset_error_ms_worst", "earlier_than_4_ms_before_gross_slip"),
        ),
    ),
    Subject(
        "evaluate tracking",
        "Presets",
        having("preset", "consistent_share"),
        (
            *("preset", "trajectories", "decided", "consistent_share", "dots_lost_counted", "dots_lost_mean"),
            *("with_truth", "error_px_rms", "error_px_worst", "still_px_rms"),
        ),
    ),
    Subject(
        "evaluate grasp",
        "Controllers and settings",
        having("setting", "columns"),
        (
            *("setting", "trials", "success", "lifted", "lifted_trials", "balanced", "held_trials", "lost"),
            *("force_end_n", "moved_mm_median", "moved_mm_mean", "reopened_columns", "reopened_share"),
        ),
    ),
    Subject(
        "evaluate grasp",
        "By object",
        having("setting", "object", "trials"),
        (
            *("setting", "object", "trials", "success", "held_trials", "opening_after_balance_ticks"),
            *("force_end_n", "moved_mm_median"),
        ),
    ),
    Subject(
        "evaluate force",
        "Shear force, models for one sensor",
        _forces,
        ("sensor", "tracker", "model", "sensor_name", "trajectories", "mae_n_x", "mae_n_y"),
    ),
    Subject(
        "evaluate force",
        "Forces, a model for any sensor",
        _gel_forces,
        (
            *("stiffness", "trajectories", "counted", "mae_n", "normal_mae_n"),
            *("shear_within_sd", "normal_within_sd", "contact_right"),
        ),
    ),
    Subject(
        "evaluate vibration",
        "Windows with the correct tone",
        _windows,
        ("method", "expected_hz", "window_s", "recordings", "windows", "share"),
    ),
    Subject(
        "evaluate vibration",
        "Recordings",
        having("file", "method", "seconds"),
        ("file", "method", "seconds", "frequency_hz", "uncertainty_hz", "expected_hz"),
    ),
    Subject("evaluate data-rate", "Share of an RGB sensor's bytes", having("interval", "share_mean")),
    Subject("evaluate realism", "Figures", having("figure", "distance")),
    Subject(
        "evaluate likeness",
        "Facts with figures",
        lambda found: [row for row in having("fact", "public")(found) if row["not_measured"] is None],
        ("counts", "fact", "public", "simulated", "simulated_from", "compared", "real", "unit", "class"),
    ),
    Subject(
        "evaluate benchmark",
        "Scores by task and split",
        having("task", "split"),
        (
            *("task", "split", "value", "low", "high", "unit", "n", "left_out", "left_out_because"),
            *("sensors", "objects"),
        ),
    ),
    Subject("evaluate cost", "Settings", having("setting")),
    Subject(
        "evaluate stability",
        "Cases, each with the quantity nearest to its bound",
        _cases,
        ("part", "case", "ok", "quantity", "value", "bound", "unit", "outcome", "reason"),
    ),
)


def columns_of(subject: Subject, rows: Rows) -> tuple[ReportColumn, ...]:
    """Return the columns that have a value in any row; the paper's figure is next to evetac's."""
    every = dict.fromkeys(key for row in rows for key in row)
    names = subject.columns or tuple(
        name for name in every if not (name.startswith("paper_") and name.removeprefix("paper_") in every)
    )
    return tuple(
        ReportColumn(HEADINGS.get(name, name.replace("_", " ")), name, of_paper if of_paper in paper.SHOWN else "")
        for name in names
        for of_paper in [f"paper_{name}"]
        if any(row.get(name) is not None for row in rows)
    )
