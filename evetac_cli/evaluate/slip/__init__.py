"""evaluate slip: timing, F1 and warnings of slip detectors."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.parameter import parameter
from evetac_cli.evaluate.slip.paper import PAPER
from evetac_cli.evaluate.subject import OWN_DATA, Subject, SubjectTable, having
from evetac_cli.jobs import Row, Rows


@dataclass(frozen=True)
class EvaluateSlip:
    """Measure the slip timing and F1 of models on trajectories not used in their training."""

    model: Path | None = parameter(
        None,
        "Model file, folder of models, glob, or `shipped` for the pretrained one; several with commas. Models may also"
        " be among the files.",
        recipe=False,
    )
    truth: bool = parameter(
        False,
        "Judge simulated trials by the true onset of slip instead of the labels'. No trial abstains then.",
    )
    by: str | None = parameter(
        None,
        "Print a row per sensor, object or model file. --json always includes these rows.",
        choices=("sensor", "object", "model"),
        recipe=False,
    )
    threshold: float | None = parameter(None, "Use this threshold instead of each model's own.", low=0.0, high=1.0)
    false_alarms_per_min: float | None = parameter(
        None,
        "Use each model's lowest threshold with at most this many false alarms per minute, as counted during its"
        " training.",
        unit="1/min",
        low=0.0,
        high=300.0,
        recipe=False,  # the thresholds are
    )
    recordings: Path | None = parameter(
        None,
        "Folder of the recordings. Default: the features' folder, the one above and its sub-folders, where they are"
        " recognized by their ids. Covariates of the slips, and --truth, need simulated recordings.",
        recipe=False,
    )
    all_tables: bool = parameter(
        False,
        "Print all tables: timing by setting, object, model and trajectory. --json always includes them.",
        recipe=False,
        flag="--all",
    )


# How many trajectories are behind the shares, and how many are left out.
COUNTS = ("trajectories", "counted", "abstained", "no_slip")
SHARES = ("slip_correct", "slip_early", "slip_late", "f1")


def _timing(rows: Rows, summary: Row) -> Rows:
    """Return the detection times of each setting, joined with the setting's own row."""
    settings = {row["setting"]: row for row in having("setting", "seeds")(rows, summary)}
    return [{**settings.get(row["setting"], {}), **row} for row in having("setting", "over_50_ms_ahead")(rows, summary)]


SUBJECT = Subject(
    "slip",
    EvaluateSlip,
    "evaluate.slip.measure",
    "Labelled features not used in training.",
    kind="features",
    examples=(
        "evetac evaluate slip unseen --model hist10.model.h5",
        "evetac evaluate slip unseen --model hist10.model.h5,shipped",
        "evetac evaluate slip soft stiff --model shipped --by sensor --truth",
    ),
    panel=OWN_DATA,
    title="Slip detection by model",
    about=(
        "A first detection is correct from 50 ms before to 20 ms after the onset of labels or, where a row says so, of"
        " the simulation's truth; earlier is early, later or never is late. Shares are over the n trajectories that"
        " count, without those whose labels abstain or that do not slip."
        " Means over objects and trainings, as in the paper."
    ),
    tables=(
        SubjectTable(
            "The slips used for evaluation, median and 10-90 % range",
            having("covariate", "median"),
            ("covariate", "median", "p10", "p90", "n"),
        ),
        SubjectTable(
            "Models",
            having("setting", "seeds"),
            ("setting", "judged_by", "seeds", *COUNTS, *SHARES, "slip_correct_sd", "f1_sd"),
        ),
        SubjectTable(
            "By sensor",
            having("setting", "sensor", "counted"),
            ("setting", "judged_by", "sensor", *COUNTS, *SHARES, "warned_10_ms", "false_alarms_per_min"),
        ),
        SubjectTable(
            "First detection relative to the onset, shares of pairs of slip and model",
            _timing,
            (
                *("setting", "judged_by", "pairs_counted", "t_m_minus_t_c_ms_median"),
                *("over_50_ms_ahead", "50_to_31_ms_ahead", "30_to_11_ms_ahead", "10_to_0_ms_ahead", "1_to_20_ms_after"),
                *("over_20_ms_after", "never_detected"),
            ),
        ),
    ),
    paper=PAPER,
)
