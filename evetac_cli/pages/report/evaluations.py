"""Contents of the report for each evaluation: its rows and columns, and the paper's figures next to them."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from evetac_cli.evaluate import paper
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
    """A table of a section: the rows that it takes from a report, and its columns; empty: all columns of the rows."""

    command: str
    section: str
    title: str
    rows: Callable[[Found], Rows]
    columns: tuple[ReportColumn, ...] = ()


@dataclass(frozen=True)
class Section:
    """A section of the page: its name, as in `evetac evaluate NAME`, its title, and a sentence on its contents."""

    name: str
    title: str
    says: str


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


def _mean(rows: Rows, key: str) -> float | None:
    values = [row[key] for row in rows if row.get(key) is not None]
    return sum(values) / len(values) if values else None


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
        {**members[0], "trajectories": len(members), **{key: _mean(members, key) for key in keys}} for members in groups
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
            **{key: _mean(members, key) for key in keys},
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


# Of rows of `evaluate slip`: how many trajectories are behind the shares, and how many are left out.
COUNTS = (
    ReportColumn("trajectories", "trajectories"),
    ReportColumn("n", "counted"),
    ReportColumn("abstained", "abstained"),
    ReportColumn("no slip", "no_slip"),
)
SUBJECTS = (
    Subject(
        "evaluate slip",
        "slip",
        "The slips used for evaluation, median and 10-90 % range",
        having("covariate", "median"),
        (
            ReportColumn("covariate", "covariate"),
            ReportColumn("median", "median"),
            ReportColumn("10 %", "p10"),
            ReportColumn("90 %", "p90"),
            ReportColumn("n", "n"),
        ),
    ),
    Subject(
        "evaluate slip",
        "slip",
        "Models",
        having("setting", "seeds"),
        (
            ReportColumn("model", "setting"),
            ReportColumn("judged by", "judged_by"),
            ReportColumn("seeds", "seeds"),
            *COUNTS,
            ReportColumn("timing correct", "slip_correct", "paper_slip_correct"),
            ReportColumn("sd", "slip_correct_sd"),
            ReportColumn("early", "slip_early"),
            ReportColumn("late", "slip_late"),
            ReportColumn("F1", "f1", "paper_f1"),
            ReportColumn("sd of F1", "f1_sd"),
        ),
    ),
    Subject(
        "evaluate slip",
        "slip",
        "By sensor",
        having("setting", "sensor", "counted"),
        (
            ReportColumn("model", "setting"),
            ReportColumn("judged by", "judged_by"),
            ReportColumn("sensor", "sensor"),
            *COUNTS,
            ReportColumn("timing correct", "slip_correct"),
            ReportColumn("early", "slip_early"),
            ReportColumn("late", "slip_late"),
            ReportColumn("warned 10 ms ahead", "warned_10_ms"),
            ReportColumn("false alarms per min", "false_alarms_per_min"),
            ReportColumn("F1", "f1"),
        ),
    ),
    Subject(
        "evaluate slip",
        "slip",
        "First detection relative to the onset, shares of pairs of slip and model",
        _timing,
        (
            ReportColumn("model", "setting"),
            ReportColumn("judged by", "judged_by"),
            ReportColumn("n", "pairs_counted"),
            ReportColumn("median [ms]", "t_m_minus_t_c_ms_median"),
            ReportColumn("over 50 ms ahead", "over_50_ms_ahead"),
            ReportColumn("50 to 31", "50_to_31_ms_ahead"),
            ReportColumn("30 to 11", "30_to_11_ms_ahead"),
            ReportColumn("10 to 0 ms ahead", "10_to_0_ms_ahead", "paper_10_to_0_ms_ahead"),
            ReportColumn("1 to 20 ms after", "1_to_20_ms_after"),
            ReportColumn("over 20 ms after", "over_20_ms_after"),
            ReportColumn("never", "never_detected"),
        ),
    ),
    Subject(
        "evaluate labels",
        "labels",
        "Labelled onset against gross slip",
        _summary,
        (
            ReportColumn("method", "method"),
            ReportColumn("trajectories", "trajectories"),
            ReportColumn("that slip", "slips"),
            ReportColumn("n", "counted"),
            ReportColumn("abstained", "abstained"),
            ReportColumn("others: within 0.5 px of sliding", "rest_within_half_px"),
            ReportColumn("others: over 10 ms early", "rest_over_10_ms_early"),
            ReportColumn("others: within -4..+3 ms", "rest_within_minus4_plus3_ms"),
            ReportColumn("n of intervals", "intervals_counted"),
            ReportColumn("interval covers onset", "interval_coverage"),
            ReportColumn("interval width, median [px]", "interval_width_px_median"),
            ReportColumn("onsets found", "onsets_found"),
            ReportColumn("their median error [ms]", "onset_error_ms_median"),
            ReportColumn("worst [ms]", "onset_error_ms_worst"),
            ReportColumn("over 4 ms before gross slip", "earlier_than_4_ms_before_gross_slip"),
        ),
    ),
    Subject(
        "evaluate tracking",
        "tracking",
        "Presets",
        having("preset", "consistent_share"),
        (
            ReportColumn("preset", "preset"),
            ReportColumn("trajectories", "trajectories"),
            ReportColumn("n", "decided"),
            ReportColumn("all dots end at their start", "consistent_share", "paper_consistent_share"),
            ReportColumn("n otherwise", "dots_lost_counted"),
            ReportColumn("dots lost otherwise", "dots_lost_mean", "paper_dots_lost_mean"),
            ReportColumn("n with truth", "with_truth"),
            ReportColumn("error, rms [px]", "error_px_rms"),
            ReportColumn("worst dot [px]", "error_px_worst"),
            ReportColumn("standing still [px]", "still_px_rms"),
        ),
    ),
    Subject(
        "evaluate grasp",
        "grasp",
        "Controllers and settings",
        having("setting", "columns"),
        (
            ReportColumn("setting", "setting"),
            ReportColumn("trials", "trials"),
            ReportColumn("lifted and kept", "success", "paper_success"),
            ReportColumn("lifted", "lifted"),
            ReportColumn("n lifted", "lifted_trials"),
            ReportColumn("kept if lifted", "balanced"),
            ReportColumn("n kept", "held_trials"),
            ReportColumn("lost", "lost"),
            ReportColumn("grip at the end [N]", "force_end_n"),
            ReportColumn("moved, median [mm]", "moved_mm_median"),
            ReportColumn("moved, mean [mm]", "moved_mm_mean"),
            ReportColumn("objects that closed the gripper", "reopened_columns"),
            ReportColumn("reopened in balance", "reopened_share", "paper_reopened_share"),
        ),
    ),
    Subject(
        "evaluate grasp",
        "grasp",
        "By object",
        having("setting", "object", "trials"),
        (
            ReportColumn("setting", "setting"),
            ReportColumn("object", "object"),
            ReportColumn("trials", "trials"),
            ReportColumn("lifted and kept", "success", "paper_success"),
            ReportColumn("n kept", "held_trials"),
            ReportColumn(
                "opening at the end [ticks]", "opening_after_balance_ticks", "paper_opening_after_balance_ticks"
            ),
            ReportColumn("grip at the end [N]", "force_end_n"),
            ReportColumn("moved, median [mm]", "moved_mm_median"),
        ),
    ),
    Subject(
        "evaluate force",
        "force",
        "Shear force, models for one sensor",
        _forces,
        (
            ReportColumn("dots from", "sensor"),
            ReportColumn("tracker", "tracker"),
            ReportColumn("model", "model"),
            ReportColumn("sensor", "sensor_name"),
            ReportColumn("trajectories", "trajectories"),
            ReportColumn("error of Fx [N]", "mae_n_x", "paper_mae_n_x"),
            ReportColumn("error of Fy [N]", "mae_n_y", "paper_mae_n_y"),
        ),
    ),
    Subject(
        "evaluate force",
        "force",
        "Forces, a model for any sensor",
        _gel_forces,
        (
            ReportColumn("gel stiffness", "stiffness"),
            ReportColumn("trajectories", "trajectories"),
            ReportColumn("n of errors", "counted"),
            ReportColumn("shear error [N]", "mae_n"),
            ReportColumn("normal error [N]", "normal_mae_n"),
            ReportColumn("shear within its sd", "shear_within_sd"),
            ReportColumn("normal within its sd", "normal_within_sd"),
            ReportColumn("contact correct", "contact_right"),
        ),
    ),
    Subject(
        "evaluate vibration",
        "vibration",
        "Windows with the correct tone",
        _windows,
        (
            ReportColumn("method", "method"),
            ReportColumn("tone [Hz]", "expected_hz"),
            ReportColumn("window [s]", "window_s"),
            ReportColumn("recordings", "recordings"),
            ReportColumn("windows", "windows"),
            ReportColumn("share correct", "share", "paper_share"),
        ),
    ),
    Subject(
        "evaluate vibration",
        "vibration",
        "Recordings",
        having("file", "method", "seconds"),
        (
            ReportColumn("recording", "file"),
            ReportColumn("method", "method"),
            ReportColumn("duration [s]", "seconds"),
            ReportColumn("frequency [Hz]", "frequency_hz"),
            ReportColumn("uncertainty [Hz]", "uncertainty_hz"),
            ReportColumn("tone [Hz]", "expected_hz"),
        ),
    ),
    Subject(
        "evaluate data-rate",
        "data-rate",
        "Share of an RGB sensor's bytes",
        having("interval", "share_mean"),
        (
            ReportColumn("interval", "interval"),
            ReportColumn("object", "object"),
            ReportColumn("n", "trajectories"),
            ReportColumn("left out", "left_out"),
            ReportColumn("why", "left_out_because"),
            ReportColumn("share", "share_mean", "paper_share_mean"),
            ReportColumn("sd", "share_sd", "paper_share_sd"),
            ReportColumn("columns", "columns"),
            ReportColumn("the window's share", "window_share_mean"),
        ),
    ),
    Subject("evaluate realism", "realism", "Figures", having("figure", "distance")),
    Subject(
        "evaluate likeness",
        "likeness",
        "Facts with figures",
        lambda found: [row for row in having("fact", "public")(found) if row["not_told"] is None],
        (
            ReportColumn("counted", "counts"),
            ReportColumn("fact", "fact"),
            ReportColumn("public", "public"),
            ReportColumn("simulated", "simulated"),
            ReportColumn("from", "simulated_from"),
            ReportColumn("compared", "compared"),
            ReportColumn("real", "real"),
            ReportColumn("unit", "unit"),
            ReportColumn("class", "class"),
        ),
    ),
    Subject(
        "evaluate benchmark",
        "benchmark",
        "Scores by task and split",
        having("task", "split"),
        (
            ReportColumn("task", "task"),
            ReportColumn("split", "split"),
            ReportColumn("score", "value"),
            ReportColumn("low", "low"),
            ReportColumn("high", "high"),
            ReportColumn("unit", "unit"),
            ReportColumn("n", "n"),
            ReportColumn("left out", "left_out"),
            ReportColumn("why", "left_out_because"),
            ReportColumn("sensors", "sensors"),
            ReportColumn("objects", "objects"),
        ),
    ),
    Subject("evaluate cost", "cost", "Settings", having("setting")),
    Subject(
        "evaluate stability",
        "stability",
        "Cases, each with the quantity nearest to its bound",
        _cases,
        (
            ReportColumn("part", "part"),
            ReportColumn("case", "case"),
            ReportColumn("ok", "ok"),
            ReportColumn("quantity", "quantity"),
            ReportColumn("value", "value"),
            ReportColumn("bound", "bound"),
            ReportColumn("unit", "unit"),
            ReportColumn("outcome", "outcome"),
            ReportColumn("reason for the bound", "reason"),
        ),
    ),
)


def columns_of(subject: Subject, rows: Rows) -> tuple[ReportColumn, ...]:
    """Return the columns that have a value in any row."""
    every = dict.fromkeys(key for row in rows for key in row)
    columns = subject.columns or tuple(ReportColumn(key.replace("_", " "), key) for key in every)
    return tuple(column for column in columns if any(row.get(column.key) is not None for row in rows))
