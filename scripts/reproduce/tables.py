"""Define the tables made from the experiments' reports: their rows, columns and notes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evetac_cli.evaluate import PAPER
from evetac_cli.evaluate.common.rows import ends
from evetac_cli.evaluate.data_rate import COLUMNS
from evetac_cli.evaluate.grasp.measure import MOVED_MM, rank_correlation, without_gain
from evetac_cli.evaluate.subject import grouped
from evetac_cli.jobs import Row, Rows
from evetac_cli.kernels import estimates
from evetac_cli.kernels.estimates import Estimate
from scripts.paper.rows import BY_UNIT
from scripts.reproduce.steps import DATA_RATE_OBJECTS, GRASP_SETTINGS, TRACKING_SCENES


class Evaluation(NamedTuple):
    """What an evaluation printed, and the header of its report.

    about: facts about a measurement that are in no header, such as its sizes.
    """

    rows: Rows
    summary: Row
    simulated: bool
    header: Row | None = None
    about: Row | None = None


Evaluations = dict[str, Evaluation]


@dataclass(frozen=True)
class Column:
    """A column of a table. heading and cell: format strings over a row; paper: one over the names in PAPER.columns."""

    heading: str
    cell: str
    paper: str = ""


@dataclass(frozen=True)
class Table:
    """A table stored as docs/results/NAME.json. Placeholders in its title are filled from the reports' headers."""

    name: str
    title: str
    evaluations: tuple[str, ...]  # names of the evaluations whose reports it uses
    rows: Callable[[Evaluations], Rows]
    columns: tuple[Column, ...]
    across: Column | None = None
    notes: tuple[str, ...] = ()
    measured: bool = False  # if set, all figures of rows and summaries are stored, and columns without any are dropped
    # False if docs/results has no result of the current method yet; then no page may have marks for the table.
    kept: bool = True


def demo_rows(evaluations: Evaluations) -> Rows:
    """Return one row for each figure from the four reports of the demo."""
    labels, tracking, slip = (evaluations[name].summary for name in ("labels", "tracking", "slip"))
    still = f"{tracking['error_px_rms']:.3g} ({tracking['still_px_rms']:.3g})"
    figures = {
        "onset of gross slip: labels against truth, median": f"{labels['onset_error_ms_median']:.3g} ms",
        "... worst": f"{labels['onset_error_ms_worst']:.3g} ms",
        "... onsets that have a label": f"{labels['onsets_found']} of {labels['trajectories']}",
        "dots tracked, rms error (without tracking)": f"{still} px",
        "slip timing correct, unseen trajectories": f"{slip['slip_correct']:.3g}",
        "... too early, too late": f"{slip['slip_early']:.3g}, {slip['slip_late']:.3g}",
        "slip F1, unseen trajectories": f"{slip['f1']:.3g}",
    }
    for grasp in (row for row in evaluations["grasp"].rows if "file" in row):
        alone = grasp["setting"] == "none"
        result = "lifted" if grasp["lifted"] else "not lifted"
        if grasp["lifted"] and not alone:
            result += f", {'held' if grasp['balanced'] else 'lost in balance'}, moved {grasp['moved_mm']:.2g} mm"
        figures[f"grasp of object {grasp['object']} {'without' if alone else 'with'} the detector"] = result
    return [{"what": what, "figure": figure} for what, figure in figures.items()]


def having(evaluations: Evaluations, *columns: str) -> Rows:
    """Return the rows of all evaluations that have the given columns, which identify a table within a report."""
    return [row for each in evaluations.values() for row in each.rows if all(column in row for column in columns)]


def slip_rows(evaluations: Evaluations) -> Rows:
    """Return one row per setting, with the shares of its first detections in each interval of time."""
    timing = {row["setting"]: row for row in having(evaluations, "setting", "10_to_0_ms_ahead")}
    return [{**timing.get(row["setting"], {}), **row} for row in having(evaluations, "setting", "seeds")]


def recipe_rows(evaluations: Evaluations) -> Rows:
    """Return the rows of `slip_rows`, with the objects used for evaluation."""
    rows = []
    for name, evaluation in evaluations.items():
        what = {"objects_words": "trained on" if name.endswith("-known") else "unseen"}
        for row in slip_rows({name: evaluation}):
            by_object = {
                one["object"]: {"slip_correct": one["slip_correct"], "f1": one["f1"]}
                for one in having({name: evaluation}, "object", "slip_correct")
                if one["setting"] == row["setting"]
            }
            rows.append({**row, **what, BY_UNIT: by_object, "evaluation": name})
    return rows


def cost_rows(evaluations: Evaluations) -> Rows:
    rows = having(evaluations, "setting", "pareto_f1")
    return [{**row, "pareto": "yes" if row["pareto_timing"] or row["pareto_f1"] else ""} for row in rows]


SLIP_COLUMNS = (
    Column("model", "{setting}"),
    Column("seeds", "{seeds}"),
    Column("timing correct (paper)", "{slip_correct:.2f}", "{paper_slip_correct:.2f}"),
    Column("95 % by object; sd of objects", "{slip_correct_low:.2f} to {slip_correct_high:.2f}, {slip_correct_sd:.2f}"),
    Column("sd of seeds", "{slip_correct_sd_seeds:.2f}"),
    Column("early", "{slip_early:.2f}"),
    Column("late", "{slip_late:.2f}"),
    Column("first in -10..0 ms (paper)", "{10_to_0_ms_ahead:.2f}", "{paper_10_to_0_ms_ahead:.2f}"),
    Column("F1 (paper)", "{f1:.2f}", "{paper_f1:.2f}"),
    Column("F1, 95 % by object; sd of objects", "{f1_low:.2f} to {f1_high:.2f}, {f1_sd:.2f}"),
    Column("F1, sd of seeds", "{f1_sd_seeds:.2f}"),
)
INTERVAL_NOTE = (
    "By object: 95 % interval from resampling objects (and sensors, where there are several), the means over seeds;"
    " the sd beside it is over objects and seeds, like the paper's bars."
)


def by_unit(members: Rows, *columns: str) -> Row:
    """Return the columns of rows of single trajectories by their file, as rows.py resamples them."""
    units = {row["file"]: {name: row[name] for name in columns} for row in members}
    assert len(units) == len(members)  # a file has one row
    return {BY_UNIT: units}


def preset_rows(evaluations: Evaluations) -> Rows:
    """Return a row per preset; dots lost by trajectory are those of trajectories that lose any."""
    trials = [{**row, "dots_lost_mean": row["dots_lost"] or None} for row in having(evaluations, "preset", "file")]
    return [
        {**row, **by_unit([one for one in trials if one["preset"] == row["preset"]], "dots_lost_mean")}
        for row in having(evaluations, "preset")
        if "file" not in row
    ]


def distance_rows(evaluations: Evaluations) -> Rows:
    rows = []
    for name, evaluation in evaluations.items():
        _, scene, gel = name.split("-")
        presets = {row["preset"]: row for row in evaluation.rows if "file" not in row}
        stable = presets.get("stable", {}).get("events_per_dot")
        tags = {"scene": scene, "gel": gel, "events_per_dot_stable": stable}
        for row in presets.values():
            trials = [one for one in evaluation.rows if "file" in one and one["preset"] == row["preset"]]
            rows.append({**row, **tags, **by_unit(trials, "error_px_rms", "still_px_rms")})
    return rows


def summaries(evaluations: Evaluations) -> Rows:
    return [evaluation.summary for evaluation in evaluations.values()]


def window_rows(evaluations: Evaluations) -> Rows:
    """Count the windows with a correct tone in all recordings, by method, tone and window length, then over all tones.

    Rows of the paper's method also have the paper's shares, windows whose tone is among the three strongest
    frequencies, and those in which half the tone is the strongest.
    """
    sums: dict[tuple[str, float | None, float], Row] = {}
    windows = having(evaluations, "window_s", "correct")
    for tone_hz, row in [*((row["expected_hz"], row) for row in windows), *((None, row) for row in windows)]:
        key = (row["method"], tone_hz, row["window_s"])
        total = sums.setdefault(
            key, {**dict(zip(("method", "expected_hz", "window_s"), key, strict=True)), "windows": 0}
        )
        total["tone"] = "all" if tone_hz is None else f"{tone_hz:g}"
        for count in ("windows", "correct", "among_three", "windows_at_half_tone"):
            if row.get(count) is not None:
                total[count] = total.get(count, 0) + row[count]
    rows = []
    for row in sums.values():
        is_paper = row["method"] == "paper"
        published = {name: PAPER.value_of(name, row) if is_paper else None for name in PAPERS_WINDOWS}
        shares = {name: row[count] / row["windows"] for name, count in SHARES_OF_WINDOWS.items() if count in row}
        rows.append({**row, **shares, **published})
    return rows


PAPERS_WINDOWS = ("paper_share", "paper_among_three_share", "paper_half_tone_share")
SHARES_OF_WINDOWS = {
    "share": "correct",
    "among_three_share": "among_three",
    "half_tone_share": "windows_at_half_tone",
}
VIBRATION_COLUMNS = (Column("method", "{method}"), Column("tone [Hz]", "{tone}"))
VIBRATION_ACROSS = Column("{window_s:g} s", "{correct}/{windows}", "{paper_share:.3g}")


def interval_rows(evaluations: Evaluations) -> Rows:
    """Return one row per object and interval."""
    words = {"whole": "whole trajectory", "contact": "contact", "slip": "about slip"}
    rows = []
    for name, evaluation in evaluations.items():
        what = {"object": int(name.rpartition("-")[2]), "evaluation": name}
        intervals = [row for row in evaluation.rows if "interval" in row]
        rows += [{**row, **what, "interval_words": words[row["interval"]]} for row in intervals]
    return rows


# By tracker of the dots.
CAMERAS = {"paper": "Evetac", "paper-5-events": "Evetac", "stable": "Evetac", "rgb": "RGB sensor"}
FORCE_MODELS = {"regression": "linear regression", "network": "network"}


def force_rows(evaluations: Evaluations) -> Rows:
    """Return mean errors over trajectories, by camera and tracker, model and sensor."""
    rows = []
    for name, evaluation in evaluations.items():
        dots = name.removeprefix("force-")
        for members in grouped(having({name: evaluation}, "mae_n_x"), ("sensor", "model", "sensor_name")):
            errors = ("mae_n_x", "mae_n_y")
            mean = {key: sum(row[key] for row in members) / len(members) for key in errors} | by_unit(members, *errors)
            what = {key: members[0][key] for key in ("sensor", "model", "sensor_name", "models")}
            what["trajectories"] = len(members)
            published = {key: members[0][key] for key in ("paper_mae_n_x", "paper_mae_n_y")}
            words = {"tracker": dots, "camera": CAMERAS[dots], "model_words": FORCE_MODELS[what["model"]]}
            rows.append({**what, **words, "evaluation": name, **mean, **published})
    return rows


DETECTORS = {
    "paper": "`fast-slow` 10 ms, the paper's tracker and threshold",
    "paper-reset": "`fast-slow` 10 ms, the paper's tracker and threshold",
    "load-proportional": "pretrained",
    "alone": "none",
}


def _with_detector(evaluations: Evaluations, *columns: str) -> Rows:
    """Return the rows of all evaluations that have the given columns, with the detector of their grasps."""
    rows = []
    for name, evaluation in evaluations.items():
        setting = name.removeprefix("grasps-").removeprefix("grasp-robustness-")
        chosen = (row for row in evaluation.rows if all(column in row for column in columns))
        rows += [{**row, "detector": DETECTORS[setting], "evaluation": name} for row in chosen]
    return rows


def grasp_rows(evaluations: Evaluations) -> Rows:
    """Return a row per setting, with motion by trial, and with the interval of the rank correlation."""
    rows = []
    for row in _with_detector(evaluations, "setting", "columns"):
        trials = [one for one in evaluations[row["evaluation"]].rows if "file" in one]
        trials = [one for one in trials if without_gain(one["setting"]) == row["setting"]]
        moved = [
            {
                "file": f"{one['object']}/{one['setting']}, {one['file']}",
                "moved_lift_mm_median": one["moved_lift_mm"] if one["balanced"] else None,
                "moved_below_10_mm_share": one["moved_mm"] < MOVED_MM if one["balanced"] else None,
            }
            for one in trials
        ]
        rows.append({**row, **by_unit(moved, *MOVED), **ends("force_follows_weight", _follows_weight(trials))})
    return rows


MOVED = ("moved_lift_mm_median", "moved_below_10_mm_share")


def _follows_weight(trials: Rows) -> Estimate | None:
    """Return the rank correlation of force and weight of objects that were kept, from resampling objects."""
    kept = [one for one in trials if one["balanced"] and one.get("over_holding_end") is not None]
    weight, force = (np.array([one[name] for one in kept]) for name in ("carried_g", "force_end_n"))
    value = rank_correlation(weight, force)
    if value is None:
        return None
    times = estimates.cluster_weights([one["object"] for one in kept]).astype(int)
    samples = [rank_correlation(np.repeat(weight, one), np.repeat(force, one)) for one in times]
    return estimates.of_samples(value, np.array([one for one in samples if one is not None]))


def object_rows(evaluations: Evaluations) -> Rows:
    """Return a row per setting and object, with success and final force by trial."""
    rows = []
    for row in _with_detector(evaluations, "setting", "object", "trials"):
        if row["detector"] != "none":
            trials = [one for one in evaluations[row["evaluation"]].rows if "file" in one]
            own = [
                {
                    "file": one["file"],
                    "success": float(one["balanced"]),
                    "force_end_n": one["force_end_n"] if one["balanced"] else None,
                }
                for one in trials
                if (one["setting"], one["object"]) == (row["setting"], row["object"])
            ]
            rows.append({**row, **by_unit(own, "success", "force_end_n")})
    return sorted(rows, key=lambda row: int(row["object"]))


GRASP_COLUMNS = (
    Column("controller", "{setting}"),
    Column("detector", "{detector}"),
    Column("trials", "{trials}"),
    Column("lifted and kept (paper)", "{success:.2f}", "{paper_success:.2f}"),
    Column("grip at the end [N]", "{force_end_n:.2f}"),
    Column("moved, median [mm]", "{moved_mm_median:.2f}"),
    Column("moved, mean [mm]", "{moved_mm_mean:.2f}"),
    Column("opened again in balance (paper)", "{reopened_share:.2f}", "{paper_reopened_share:.2f}"),
)


DEMO = Table(
    "demo",
    "From touch to grasp, objects {objects}",
    ("labels", "tracking", "slip", "grasp"),
    demo_rows,
    (Column("what", "{what}"), Column("figure", "{figure}")),
    kept=False,
)

PAPER_RECIPE = Table(
    "paper-recipe",
    "The paper's recipe: networks trained, and their thresholds chosen, on {training_recordings} trajectories of"
    " objects {training_objects}, for at most {training_steps} steps",
    ("recipe-known", "recipe-unseen"),
    recipe_rows,
    (Column("objects", "{objects_words}"), *SLIP_COLUMNS),
    notes=(
        "The paper's tracker, labels by Farneback's flow, training and choice of threshold, at the paper's sizes.",
        INTERVAL_NOTE,
    ),
)

IMAGE_NETWORKS = Table(
    "paper-recipe-images",
    "Networks on event images of 90 x 80 px, trained on {training_recordings} trajectories of objects"
    " {training_objects} for at most {training_steps} steps",
    ("images-known", "images-unseen"),
    recipe_rows,
    (Column("objects", "{objects_words}"), *SLIP_COLUMNS),
    notes=("The paper's images have 540 x 480 px, which take a GPU to train, and 360 trajectories.", INTERVAL_NOTE),
    kept=False,
)

MODEL_COST = Table(
    "model-cost",
    "Run time of a detector, one core, median, and its accuracy on {recordings} trajectories of objects {objects}",
    ("model-cost",),
    cost_rows,
    (
        Column("model", "{setting}"),
        Column("parameters", "{parameters}"),
        Column("inference [ms] (paper, on a GPU)", "{inference_ms_median:.4f}", "{paper_inference_ms:g}"),
        Column("step from events on [us]", "{step_us_median:.1f}"),
        Column("timing correct", "{slip_correct:.2f}"),
        Column("F1", "{f1:.2f}"),
        Column("Pareto front", "{pareto}"),
    ),
    notes=("There is one Pareto front for each of 0, 10 and 20 ms ahead.",),
)
TRACKING_EDGE = Table(
    "tracking-edge",
    "Tracking, a finger or a handle rubs over the cut gel",
    ("tracking-edge-cut",),
    preset_rows,
    (
        Column("preset", "{preset}"),
        Column(
            "all dots end where they began (paper)",
            "{consistent} of {trajectories}",
            "{paper_consistent_share:.0%}",
        ),
        Column("dots lost where not (paper)", "{dots_lost_mean:.1f}", "{paper_dots_lost_mean:.1f}"),
        Column("... before lost dots are put back", "{consistent_before_reset} of {trajectories}"),
        Column("times a dot was put back", "{dots_put_back}"),
    ),
    notes=(
        "Contrast and blur of the edges were adjusted until the preset `paper` reached about the paper's"
        f" {PAPER.figures['consistent', 'paper'].value:.0%}.",
    ),
)

TRACKING_DISTANCE = Table(
    "tracking-distance",
    "Tracking, distance from truth in px, rms and worst dot",
    tuple(f"tracking-{name}" for name, _ in TRACKING_SCENES),
    distance_rows,
    (
        Column("scene, gel", "{scene}, {gel}"),
        Column("trajectories", "{trajectories}"),
        Column("without tracking", "{still_px_rms:.2f}"),
        Column("events per dot and slice", "{events_per_dot_stable:.1f}"),
    ),
    across=Column("{preset}", "{error_px_rms:.2f}, {error_px_worst:.1f}"),
)

DATA_RATE = Table(
    "data-rate",
    "Bytes per second, as a share of an RGB sensor's, {recordings} trajectories of objects {objects}",
    tuple(f"data-rate-object-{number}" for number in DATA_RATE_OBJECTS),
    interval_rows,
    (
        Column("object", "{object}"),
        Column("interval", "{interval_words}"),
        Column(
            "share (paper)",
            "{share_mean:.4f}, sd {share_sd:.4f}",
            "{paper_share_mean:g}, sd {paper_share_sd:g}",
        ),
        Column("columns", "{columns}"),
        Column("window, not counted", "{window_share_mean:.4f}"),
    ),
    notes=(
        f"The paper counts {COLUMNS} columns for both sensors, without the window. The object is unknown: its mass,"
        " 550 g for every object, was fitted to the share of object 1 about slip. The shares of the whole trajectory"
        " and of contact are predictions.",
    ),
)

VIBRATION = Table(
    "vibration",
    "Vibration, {tone_s:g} s per tone: windows whose tone is correct within 1 Hz (2 Hz in 0.25 s; paper)",
    ("vibration",),
    window_rows,
    VIBRATION_COLUMNS,
    VIBRATION_ACROSS,
    notes=("Amplitudes and size of the patch were adjusted to the paper's pattern.",),
)

VIBRATION_RANDOMIZED = Table(
    "vibration-randomized",
    "Vibration, {tone_s:g} s per tone, random loudness, position and harmonics: windows whose tone is correct"
    " within 1 Hz (2 Hz in 0.25 s; paper)",
    ("vibration-randomized",),
    window_rows,
    VIBRATION_COLUMNS,
    VIBRATION_ACROSS,
    notes=(
        "Random about the adjusted amplitudes of the table above; the paper's figures are for its one set-up."
        " The second harmonic is at most 0.65 of the tone.",
    ),
)

FORCE = Table(
    "force",
    "Shear force, mean absolute error of Fx, Fy in N, by sensor; trained on the sensor {training_sensors} alone",
    tuple(f"force-{dots}" for dots in CAMERAS),
    force_rows,
    (Column("camera", "{camera}"), Column("tracker", "{tracker}"), Column("model", "{model_words}")),
    across=Column("{sensor_name}", "{mae_n_x:.2f}, {mae_n_y:.2f}", "{paper_mae_n_x:g}, {paper_mae_n_y:g}"),
    notes=(
        "Means over the trajectories of a sensor, and for networks over trainings. The paper evaluated 1 trajectory."
        " The RGB sensor's frames are rendered from the true dots, without the light of a real gel.",
    ),
)

GRASPS = Table(
    "grasps",
    "Grasps, {recordings} trials of objects {objects}, lifted and balanced with the sense of touch alone",
    tuple(f"grasps-{setting}" for setting in DETECTORS),
    grasp_rows,
    GRASP_COLUMNS,
    notes=(
        "Fitted: the gripper's friction was set so that contact alone lifts nothing (with 0.9 of it object 12"
        " is lifted). Grip and distance moved are means over the trials in which the object was kept.",
    ),
)

GRASPS_BY_OBJECT = Table(
    "grasps-by-object",
    "Grasps by object, {recordings} trials: kept, ticks closed at the end of balance (paper), grip at the end in N",
    tuple(f"grasps-{setting}" for setting in DETECTORS),
    object_rows,
    (Column("object", "{object}"),),
    across=Column(
        "{setting}; {detector}",
        "{success:.0%}, {opening_after_balance_ticks:.1f}, {force_end_n:.1f}",
        "{paper_opening_after_balance_ticks:.1f}",
    ),
    notes=(
        "The model of the gripper was fitted to the paper's"
        f" {PAPER.figures['opening', '17', '1'].value} and {PAPER.figures['opening', '18', '1'].value} ticks.",
    ),
)

GRASP_ROBUSTNESS = Table(
    "grasp-robustness",
    "Grasps, sideways, with a falling weight, on another sensor, {recordings} trials",
    tuple(f"grasp-robustness-{setting}" for setting in GRASP_SETTINGS),
    grasp_rows,
    GRASP_COLUMNS,
)
