"""Say for each table how a check repeats it: with what sizes, which figures are judged, and on which trials.

check_tables.py runs the checks. The sizes are about a tenth of the experiment's, and its first trials, so a row whose
trials are all repeated must come out equal. Where the whole experiment takes minutes, it is repeated whole.
"""

from evetac_cli.jobs import Rows
from scripts.reproduce.experiment import Check, Figure
from scripts.reproduce.plan import STUDIES
from scripts.reproduce.steps import Sizes
from scripts.reproduce.tables import Evaluations, grasp_rows, object_rows

# Sizes of the experiments of which a part is repeated; the others are repeated whole.
SIZES: dict[str, Sizes] = {
    **{name: sizes for study in STUDIES for name, sizes in study.check_sizes.items()},
    "paper-recipe": {"test": 1},  # of 10 trajectories of each object
    "tracking": {"edges": 5, "others": 1},  # of 50 and 5
    "vibration": {"randomized": 2},  # of 20
    "force": {"trials": 1},  # of 5
    "grasp-table": {"trials": 1, "alone": 1},  # of 10 and 5
}


def slip_trials(evaluations: Evaluations) -> Rows:
    """Return a row per model and trajectory of slip; the unit is the object."""
    rows: Rows = []
    for name, evaluation in evaluations.items():
        tags = {"objects_words": "trained on" if name.endswith("-known") else "unseen"}
        settings = {row["setting"]: row for row in evaluation.rows if "seeds" in row and "slip_correct" in row}
        for row in (row for row in evaluation.rows if "timing" in row and row["timing"] is not None):
            setting = settings[row["setting"]]
            what = {key: setting[key] for key in ("setting", "model", "horizon_ms")}
            timing = {f"slip_{when}": row["timing"] == when for when in ("correct", "early", "late")}
            rows.append({**tags, **what, **timing, "f1": row["f1"], "file": row["file"], "unit": row["object"]})
    return rows


SLIP = tuple(map(Figure, ("slip_correct", "slip_early", "slip_late", "f1")))


def edge_trials(evaluations: Evaluations) -> Rows:
    """Return a row per preset and trajectory; the unit is the trajectory."""
    rows = [row for each in evaluations.values() for row in each.rows if "file" in row]
    return [
        {
            "preset": row["preset"],
            "file": row["file"],
            "unit": row["file"],
            "consistent": row["consistent"],
            "trajectories": 1,
            "dots_lost_mean": row["dots_lost"] or None,  # a mean over the trajectories that lose any
        }
        for row in rows
        if row["consistent"] is not None
    ]


def distance_trials(evaluations: Evaluations) -> Rows:
    """Return a row per scene, gel, preset and trajectory; the unit is the trajectory."""
    rows = []
    for name, evaluation in evaluations.items():
        _, scene, gel = name.split("-")
        trials = (row for row in evaluation.rows if "file" in row)
        rows += [{**row, "scene": scene, "gel": gel, "unit": row["file"]} for row in trials]
    return rows


def window_trials(evaluations: Evaluations) -> Rows:
    """Return a row per method, tone, window length and recording; the unit is the recording."""
    rows = [row for each in evaluations.values() for row in each.rows if "window_s" in row and "correct" in row]
    return [{**row, "unit": row["file"]} for row in rows]


def rate_trials(evaluations: Evaluations) -> Rows:
    """Return a row per object, interval and recording; the unit is the recording."""
    rows = []
    for name, evaluation in evaluations.items():
        what = {"object": int(name.rpartition("-")[2])}
        for row in (row for row in evaluation.rows if "file" in row):
            for interval in ("whole", "contact", "slip"):
                share = {"share_mean": row[f"share_{interval}"], "interval": interval}
                rows.append({**what, **share, "file": row["file"], "unit": row["file"]})
    return rows


def force_trials(evaluations: Evaluations) -> Rows:
    """Return a row per tracker, model, sensor and trajectory; the unit is the trajectory."""
    return [
        {**row, "tracker": name.removeprefix("force-"), "unit": row["file"]}
        for name, evaluation in evaluations.items()
        for row in evaluation.rows
        if "mae_n_x" in row
    ]


def grasp_trials(evaluations: Evaluations) -> Rows:
    """Return a row per grasp with its setting without gain, as the table has it; the unit is the object."""
    from evetac_cli.evaluate.grasp.measure import without_gain

    rows = []
    for name, evaluation in evaluations.items():
        shown = [*grasp_rows({name: evaluation}), *object_rows({name: evaluation})]
        detectors = {row["setting"]: row["detector"] for row in shown}
        for row in (row for row in evaluation.rows if "file" in row):
            held = {"success": bool(row["balanced"]), "unit": row["object"]}
            if not row["balanced"]:  # the table's means are over trials that kept the object
                held |= dict.fromkeys(("force_end_n", "moved_mm_mean"))
            else:
                held["moved_mm_mean"] = row["moved_mm"]
            setting = without_gain(row["setting"])
            rows.append({**row, **held, "setting": setting, "detector": detectors.get(setting, "none")})
    return rows


GRASPS = tuple(map(Figure, ("success", "force_end_n", "moved_mm_mean")))
PAPER: dict[str, Check] = {
    "paper-recipe": Check(
        ("objects_words", "model", "horizon_ms"), SLIP, slip_trials,
        training=("--model", "fast-slow", "--horizon-ms", "10"),
    ),
    "paper-recipe-images": Check(
        ("objects_words", "model", "horizon_ms"), SLIP, slip_trials, training=("--model", "hist10-img-6x6"),
    ),
    "model-cost": Check(("setting",), unpromised=("time_us_median", "step_us_median", "pareto")),
    # A tenth has one trial of each object: the interval of a single object is wide.
    "slip-timing": Check(("object", "bin_words"), (Figure("share", count="slips"),)),
    "slip-by-object": Check(("object", "setting"), (Figure("slip_correct", count="trajectories"),)),
    "slip-over-time": Check(("model", "after_onset_ms")),  # one trajectory, in which one time follows from another
    "tracking-edge": Check(("preset",), (Figure("consistent", "trajectories"), Figure("dots_lost_mean")), edge_trials),
    "tracking-distance": Check(("scene", "gel", "preset"), (Figure("error_px_rms", squared=True),), distance_trials),
    "data-rate": Check(("object", "interval"), (Figure("share_mean"),), rate_trials),
    "vibration": Check(("method", "expected_hz", "window_s"), (Figure("correct", "windows"),), window_trials),
    "vibration-randomized": Check(
        ("method", "expected_hz", "window_s"), (Figure("correct", "windows"),), window_trials
    ),
    "force": Check(
        ("tracker", "model", "sensor_name"), (Figure("mae_n_x"), Figure("mae_n_y")), force_trials,
    ),
    "grasps": Check(("setting", "detector"), GRASPS, grasp_trials),
    "grasp-robustness": Check(("setting", "detector"), GRASPS, grasp_trials),
    "grasps-by-object": Check(("setting", "detector", "object"), (Figure("success", count="trials"),)),
}  # fmt: skip
OF_STUDIES = {name: check for study in STUDIES for name, check in study.checks.items()}
CHECKS = PAPER | {name: check for name, check in OF_STUDIES.items() if isinstance(check, Check)}
# Tables that no check repeats, with the reason.
NOT_CHECKED = {name: why for name, why in OF_STUDIES.items() if isinstance(why, str)}
SCRIPTS = {name: check for study in STUDIES for name, check in study.scripts.items()}
