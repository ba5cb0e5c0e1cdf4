"""evaluate grasp: the paper's table of grasps by controller and object, and its robustness tables (section VII).

Grasps with several controllers, in several scenes and on several sensors are evaluated together. Grasps that differ
only in object and trial belong to one setting. The rows form three tables with different columns: over all objects, by
object, and by trial. The table over all objects merges gains, as the paper's figure does, in which some objects were
held with a higher gain; there a column is an object with a gain. The paper's figures are included. If detectors or
their thresholds differ, they are part of the setting.

Balance counts only trials that lifted the object, as in the paper; `success` counts both phases. Motion of the object,
grip force and reopening of the gripper are means (or medians) over trials that held the object to the end, because an
object that fell may have moved by any distance. The grip force is also given relative to the least force that holds the
object, by class of mass, and whether it follows the weight, only for objects that were held to the end.
"""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.common.marks import Source
from evetac_cli.evaluate.common.report import report, report_job
from evetac_cli.evaluate.common.rows import each, ends, mean, quantile, resampled, sd
from evetac_cli.evaluate.grasp import PAPER, PAPERS_SENSOR, EvaluateGrasp
from evetac_cli.evaluate.subject import grouped
from evetac_cli.events import SLICES_PER_S
from evetac_cli.jobs import Job, Outcome, Progress, Row, Rows, Stage, silent
from evetac_cli.kernels import estimates
from evetac_cli.kernels.grip.load_law import MARGIN
from evetac_cli.sim import grasp_outcome
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2
from evetac_cli.sim.setup.plan import Plan, one_sensor, read_plan
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings import slip_grid

METHOD = 7
ALIKE = ("scene", "sensor", "gel", "slip_detector", "tracker", "slip_threshold")  # of all trials of a setting
MEANS = (
    "opening_after_lift_ticks",
    "opening_after_balance_ticks",
    "opening_after_lift_mm",
    "opening_after_balance_mm",
    "reopened_share",
)

USUAL = {"gain": 1.0, "latency_ms": 0, "control_hz": 500.0}  # named in a setting only if they differ from these
MOST_SETTINGS = 8  # this many markers can be distinguished
CLASSES_G = ((30.0, 100.0), (100.0, 250.0), (250.0, 600.0))
STAYED_MM = 3.0  # an object that moved less counts as not moved
MOVED_MM = PAPER.figures["moved less in most trials",].value


def jobs(files: list[Path], params: EvaluateGrasp, out: Path | None) -> list[Job]:
    """Return one report job over all grasps; recordings of a second finger are left out."""
    return report_job([file for file in files if not _is_second_finger(file)] or files, "grasp", out)


def _is_second_finger(path: Path) -> bool:
    """Whether a file is the recording of a second finger's camera; the first finger's has the decisions."""
    with StageFile(path) as file:
        return file.kind == "recording" and file.has("capture/clock_offset_us") and not file.has("control")


def run(job: Job, params: EvaluateGrasp, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return rows of settings, objects and trials; plot force against weight if the forces that hold are known."""
    headers = []
    for path in job.inputs:
        with StageFile(path, "recording") as recording:
            lacking = [name for name in ("control", "truth/table_gap_mm") if not recording.has(name)]
            if lacking:
                raise InputError("not a simulated grasp", where=str(path), expected=f"{lacking[0]} in the file")
            headers.append(recording.header)

    def measure() -> tuple[Rows, dict[str, Any]]:
        paths = zip(each(job.inputs, progress), headers, strict=True)
        return tables(with_detectors([trial_row(path, header) for path, header in paths], headers))

    outcome = report(job, "evaluate grasp", METHOD, recipe_of(params), headers, measure, force=force)
    trials = [row for row in outcome.rows if "file" in row and row["balanced"] and row.get("holding_end_n")]
    by_setting = grouped(trials, ("setting",))[:MOST_SETTINGS]
    settings = [(number, rows[0]["setting"], rows) for number, rows in enumerate(by_setting)]
    if not settings:
        return outcome
    return picture.beside(outcome, job.output, lambda figure: draw_forces(figure, settings), (7.5, 5.0))


def for_people(rows: Rows, params: EvaluateGrasp) -> tuple[Rows, list[str]]:
    """Return all rows, and for each setting the number of trials that held their object to the end."""
    lines = []
    for row in rows:
        if "columns" in row:
            published = row.get("paper_success")
            beside = "" if published is None else f" (paper, on its own objects: {published:.2f})"
            held, trials = row["held_trials"], row["trials"]
            words = f"{row['setting']}: lifted and held to the end in {held} of {trials}{beside}"
            if held < trials:
                words += f"; force and motion are over n = {held}, without {row['lost']}"
            if row["over_holding_counted"] < held:
                words += f"; the least force that holds the object is known in {row['over_holding_counted']} of these"
            lines.append(f"{words}.")
    return rows, lines + slip_grid.resting_on(rows)


def trial_row(path: Path, header: Header) -> dict[str, Any]:
    """Return setting and outcome of one grasp."""
    planned = header["parameters"]
    plan = read_plan(planned, str(path))
    with StageFile(path, "recording") as recording:
        stored_names = [name for name in (*grasp_outcome.NEEDED, grasp_outcome.HOLDING) if recording.has(name)]
        rows = {name: recording.read(name) for name in stored_names}
        mass_g = 1e3 * json.loads(recording.read("truth/sampled_parameters"))["mass_kg"]
        nodes = slip_grid.nodes_of(recording)
        stored = "{}"
        if recording.has("control/second_probability") and recording.has("control/outcome"):
            stored = recording.read("control/outcome")
    seconds = plan.scene.time.touch_s + planned["lift_s"] + planned["balance_s"]
    newton_per_ma = plan.sensor.gripper.force_per_current_n_ma
    figures = grasp_outcome.outcome(rows, plan.sensor.mm_per_px, round(SLICES_PER_S * seconds), newton_per_ma)
    # false reactions to slip of a second finger can only be counted from its own recording: take the stored outcome
    figures |= {name: value for name, value in json.loads(stored).items() if name == "false_slip_events"}
    drop = plan.scene.drop
    if drop is not None and plan.scene.time.touch_s + planned["lift_s"] + drop.after_s < seconds:
        mass_g += drop.mass_g
    names = {"setting": describe_setting(plan, planned), "object": plan.object_name, "file": path.name}
    names |= {
        "carried_g": mass_g,
        "scene": plan.scene.name,
        "sensor": _sensor_word(plan),
        "gel": "cut" if plan.scene.gel.cut else "closed",
    }
    return {**names, **figures, slip_grid.COLUMN: nodes}


def tables(trials: Rows) -> tuple[Rows, dict[str, Any]]:
    """Return the rows of all three tables, and figures over all trials."""
    whole: Rows = []
    objects: Rows = []
    for name in dict.fromkeys(without_gain(row["setting"]) for row in trials):
        members = [row for row in trials if without_gain(row["setting"]) == name]
        columns = grouped(members, ("setting", "object"))
        rows = [
            {"setting": cell[0]["setting"], "object": cell[0]["object"], **_alike(cell), **figures(cell)}
            for cell in columns
        ]
        objects += [_with_papers(row, "paper_success", "paper_opening_after_balance_ticks") for row in rows]
        row = {"setting": name, "columns": len(columns), **_alike(members), **figures(members)}
        row["reopened_share"] = mean(one["reopened_share"] for one in rows)  # every column counts the same
        row["reopened_columns"] = sum(one["reopened_share"] is not None for one in rows)
        row |= _ends(members, rows)
        row |= {key: value for key, value in firmness(members).items() if key not in ("grasps", "kept")}
        whole.append(_with_papers(row, "paper_success", "paper_reopened_share"))
    shares: dict[str, Any] = {
        f"{name}_share": float(np.mean([row[name] for row in trials])) for name in ("lifted", "balanced")
    }
    follows = [(row["setting"], row["force_follows_weight"]) for row in whole]
    shares["force_follows_weight"] = ", ".join(f"{name} {value:.2f}" for name, value in follows if value is not None)
    return [*whole, *objects, *trials], {"grasps": len(trials), **shares}


def _ends(trials: Rows, by_object: Rows) -> dict[str, float | None]:
    """Return the ends of intervals of a setting's shares, from resampling objects: their trials are alike."""
    objects = [row["object"] for row in trials]
    weights = estimates.cluster_weights(objects)
    found: dict[str, estimates.Estimate | None] = {}
    for name, hits in (("success", [row["balanced"] for row in trials]), ("lifted", [row["lifted"] for row in trials])):
        found[name] = (
            estimates.ratio_of_clusters(np.array(hits, np.float64), np.ones(len(trials)), weights)
            if len(set(objects)) > 1 and 0 < sum(hits) < len(trials)
            else estimates.share(sum(hits), len(trials))
        )
    found["reopened_share"] = resampled(row["reopened_share"] for row in by_object)
    return {column: value for name, one in found.items() for column, value in ends(name, one).items()}


def _alike(trials: Rows) -> dict[str, Any]:
    """Return the columns that trials of a setting share; those of tables by hand may lack some."""
    return {name: trials[0][name] for name in ALIKE if name in trials[0]}


def figures(trials: Rows) -> dict[str, Any]:
    """Return success rates over all trials, and figures over those that held their object to the end.

    `held_trials` are behind these figures, except that `reopened_share` exists only if the gripper closed in the lift.
    """
    lifted = [row for row in trials if row["lifted"]]
    held_trials = [row for row in trials if row["balanced"]]
    moved = [row["moved_mm"] for row in held_trials]
    return {
        "trials": len(trials),
        "lifted_trials": len(lifted),
        "held_trials": len(held_trials),
        "reopened_trials": sum(row["reopened_share"] is not None for row in held_trials),
        "success": len(held_trials) / len(trials),
        "lifted": len(lifted) / len(trials),
        "balanced": len(held_trials) / len(lifted) if lifted else None,
        **{name: mean(row[name] for row in held_trials) for name in MEANS},
        "opening_after_balance_ticks_sd": sd([row["opening_after_balance_ticks"] for row in held_trials]),
        "force_end_n": mean(row["force_end_n"] for row in held_trials),
        "moved_lift_mm_median": quantile([row["moved_lift_mm"] for row in held_trials], 0.5),
        "moved_mm_median": quantile(moved, 0.5),
        "moved_mm_mean": mean(moved),
        "moved_mm_p90": quantile(moved, 0.9),
        "moved_below_10_mm_share": mean(value < MOVED_MM for value in moved),
        "slip_events_mean": mean(row["slip_events"] for row in trials),
    }


def _with_papers(row: dict[str, Any], *columns: str) -> dict[str, Any]:
    """Add the paper's figures for the setting, or for the object with the paper's controller; None if it has none."""
    return {**row, **{column: PAPER.value_of(column, row) for column in columns}}


def with_detectors(trials: Rows, headers: Sequence[Header]) -> Rows:
    """Return the trials with detector, tracker and threshold, which are None without a detector.

    Where grasps of a report differ in detector or threshold, these words are added to the setting.
    """
    sources: dict[str, dict[str, Any]] = {}
    rows: Rows = []
    for trial, header in zip(trials, headers, strict=True):
        planned = header["parameters"]
        key = json.dumps([header["parents"], planned.get("tracker")], sort_keys=True)
        if key not in sources:
            source = Source.of([header])
            detector, tracker = (source.detector, " + ".join(source.trackers)) if source.detectors else (None, None)
            sources[key] = {"slip_detector": detector, "tracker": tracker}
        rows.append({**trial, **sources[key], "slip_threshold": planned.get("slip_threshold")})
    detectors = {row["slip_detector"] for row in rows} - {None}
    for row in rows:
        words = [f"detector {row['slip_detector']}"] if row["slip_detector"] and len(detectors) > 1 else []
        same = {one["slip_threshold"] for one in rows if one["slip_detector"] == row["slip_detector"]}
        words += [f"threshold {row['slip_threshold']:g}"] if len(same) > 1 else []
        row["setting"] = ", ".join([row["setting"], *words])
    return rows


def _sensor_word(plan: Plan) -> str:
    """Return the sensor's name, which says so if the paper's sensor had other values than it has now."""
    papers = one_sensor(PAPERS_SENSOR)
    same = plan.sensor_name != PAPERS_SENSOR or replace(plan.sensor, summary=papers.summary) == papers
    return plan.sensor_name if same else f"{plan.sensor_name} with other values"


def describe_setting(plan: Plan, planned: dict[str, Any]) -> str:
    """Return the words for a setting: its controller and all non-default choices, without object and trial."""
    gain, latency_ms, control_hz = (planned.get(name, usual) for name, usual in USUAL.items())
    margin = planned.get("law", {}).get("margin", MARGIN) if planned["controller"] == "load-proportional" else MARGIN
    second = "" if plan.second is None or plan.second.name == plan.sensor_name else f", {plan.second.name}"
    words = (
        (planned["controller"], True),
        (f"gain {gain:g}", gain != USUAL["gain"]),
        (f"margin {margin:g}", margin != MARGIN),
        (plan.scene.name, plan.scene.name != "lift"),
        (_sensor_word(plan), _sensor_word(plan) != PAPERS_SENSOR),
        (f"two fingers{second}", plan.second is not None),
        ("closed gel", not plan.scene.gel.cut),
        (f"{latency_ms} ms late", latency_ms != USUAL["latency_ms"]),
        (f"{control_hz:g} Hz", control_hz != USUAL["control_hz"]),
    )
    return ", ".join(word for word, unusual in words if unusual)


def without_gain(setting: str) -> str:
    """Return the name of a setting without its gain."""
    return ", ".join(word for word in setting.split(", ") if not word.startswith("gain "))


def firmness(trials: Rows) -> Row:
    """Return how many grasps of one controller kept their object, and with how much excess force; None where unknown.

    Excess force is relative to the least force that holds the object, in the `over_holding_counted` grasps that kept
    it and of which this force is known.
    """
    held_trials = [row for row in trials if row["balanced"]]
    with_excess = [row for row in held_trials if row.get("over_holding_end") is not None]
    row: Row = {
        "grasps": len(trials),
        "kept": len(held_trials) / len(trials),
        "lost": ", ".join(
            f"{count} {how}" for how, count in Counter(row["failure"] for row in trials if row["failure"]).most_common()
        ),
    }
    row["over_holding_counted"] = len(with_excess)
    for name in ("end", "mean", "peak"):
        values = [one[f"over_holding_{name}"] for one in with_excess]
        row |= {
            f"over_holding_{name}_median": quantile(values, 0.5),
            f"over_holding_{name}_p95": quantile(values, 0.95),
        }
    for low, high in CLASSES_G:
        values = [one["over_holding_end"] for one in with_excess if low <= one["carried_g"] < high]
        row[f"over_holding_counted_{low:g}_{high:g}_g"] = len(values)
        row[f"over_holding_end_p95_{low:g}_{high:g}_g"] = quantile(values, 0.95)
    row["force_follows_weight"] = rank_correlation(
        [one["carried_g"] for one in with_excess], [one["force_end_n"] for one in with_excess]
    )
    row["stayed_share"] = mean(one["moved_mm"] < STAYED_MM for one in held_trials)
    row["motor_work_j_median"] = quantile([one["motor_work_j"] for one in held_trials], 0.5)
    reactions, false = (sum(one[name] for one in trials) for name in ("slip_events", "false_slip_events"))
    return {**row, "reactions_mean": reactions / len(trials), "false_share": false / reactions if reactions else None}


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float | None:
    """Return Spearman's rank correlation of two columns, ties sharing their rank; None where it is undefined."""
    if len(first) < 3 or any(np.ptp(values) == 0.0 for values in (first, second)):
        return None
    from scipy import stats  # takes half a second to load

    return float(stats.spearmanr(first, second).statistic)


def draw_forces(figure: Any, settings: Sequence[tuple[int, str, Rows]]) -> None:
    """Plot grip force at the end against weight, with the least force that holds each object.

    settings: number of the series, setting, held trials. Both axes are logarithmic, so proportionality is a slope of 1.
    """
    axes = figure.subplots()
    weights_n, holding_n = [], []
    for number, name, trials in settings:
        x_n = [row["carried_g"] * 1e-3 * GRAVITY_M_S2 for row in trials]
        weights_n += x_n
        holding_n += [row["holding_end_n"] for row in trials]
        style = {**picture.series(number), "linestyle": "none"}
        axes.plot(x_n, [row["force_end_n"] for row in trials], label=f"controller {name}", **style)
    axes.plot(weights_n, holding_n, "_", color="0.35", markersize=10, label="least force that holds the object")
    middle = float(np.median(np.array(holding_n) / np.array(weights_n)))
    ends = np.array([min(weights_n), max(weights_n)])
    axes.plot(ends, middle * ends, color="0.35", linewidth=1, label="... at the median friction")
    for axis in (axes.xaxis, axes.yaxis):
        picture.log_axis(axis)
    axes.set_xlabel("weight carried at the end [N]")
    axes.set_ylabel("grip force at the end [N]")
    picture.legend(figure, [axes])


STAGE = Stage(jobs, run, for_people=for_people)
