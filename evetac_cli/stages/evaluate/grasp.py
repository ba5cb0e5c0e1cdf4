"""evaluate grasp: the paper's table of grasps, by controller and object, and its robustness tables (section VII).

Grasps by several controllers, in several scenes, on several sensors are judged at once and stand side by side: those
that were made alike but for object and trial are one setting. The rows are three tables, told apart by their columns:
over all objects; by object; by trial. Over all objects gains are taken together, as in the paper's figure, where some
objects were held with a higher one: a column is an object with a gain. What the paper says of it stands beside.

Balance counts the trials that lifted, as in the paper; `success` is both phases. How far an object moved, how firmly it
was held and how far the gripper opened again are means (or medians) over the trials that held it to the end: an object
that fell has moved by any distance.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, silent
from evetac_cli.params import EvaluateGrasp, recipe_of
from evetac_cli.resources import table
from evetac_cli.sim import grasp_outcome
from evetac_cli.stages.evaluate import Rows, grasp_picture, picture, report, report_job
from evetac_cli.store.files import StageFile
from evetac_cli.store.provenance import Header

INPUTS = ("recording",)
OUTPUT = "report"
METHOD = 2
USUAL = {"gain": 1.0, "latency_ms": 0, "control_hz": 500.0}  # of a grasp that says nothing of it
MEANS = (
    "opening_after_lift_ticks",
    "opening_after_balance_ticks",
    "opening_after_lift_mm",
    "opening_after_balance_mm",
    "reopened_share",
)


def jobs(files: list[Path], params: EvaluateGrasp, out: Path | None) -> list[Job]:
    """One report over all grasps."""
    return report_job(files, "grasp", out)


def run(job: Job, params: EvaluateGrasp, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Rows of settings, objects and trials, and a picture of them."""
    headers = []
    for path in job.inputs:
        with StageFile(path, "recording") as recording:
            for group, what in (
                ("control", "it is no grasp"),
                ("truth/table_gap_mm", "only a simulation knows its outcome"),
            ):
                if not recording.has(group):
                    raise InputError(
                        f"the outcome cannot be told: {what}", where=str(path), expected=f"{group} in the file"
                    )
            headers.append(recording.header)

    def measure() -> tuple[Rows, dict[str, Any]]:
        trials: Rows = []
        for number, (path, header) in enumerate(zip(job.inputs, headers, strict=True)):
            trials.append(trial_row(path, header))
            progress(number + 1, len(job.inputs))
        return tables(trials)

    outcome = report(job, "evaluate grasp", METHOD, recipe_of(params), headers, measure, force=force)
    return picture.beside(
        outcome, job.output, lambda figure: grasp_picture.draw(figure, outcome.rows), grasp_picture.SIZE_IN
    )


def trial_row(path: Path, header: Header) -> dict[str, Any]:
    """What became of one grasp, and how it was made."""
    planned = header["parameters"]
    with StageFile(path, "recording") as recording:
        rows = {name: recording.read(name) for name in grasp_outcome.NEEDED}
    seconds = planned["scene"]["time"]["touch_s"] + planned["lift_s"] + planned["balance_s"]
    figures = grasp_outcome.outcome(rows, planned["sensor_row"]["mm_per_px"], round(1000 * seconds))
    return {"setting": setting_of(planned), "object": planned["object"], "file": path.name, **figures}


def setting_of(planned: dict[str, Any]) -> str:
    """What two grasps share that differ in object and trial alone, in words: the controller, and what is unusual."""
    words = [planned["controller"]]
    chosen = {name: planned.get(name, usual) for name, usual in USUAL.items()}
    if chosen["gain"] != 1.0:
        words.append(f"gain {chosen['gain']:g}")
    if planned["scene"]["name"] != "lift":
        words.append(planned["scene"]["name"])
    if planned["sensor"] != "evetac":
        words.append(planned["sensor"])
    if not planned["scene"]["gel"]["cut"]:
        words.append("closed gel")
    if chosen["latency_ms"]:
        words.append(f"{chosen['latency_ms']} ms late")
    if chosen["control_hz"] != USUAL["control_hz"]:
        words.append(f"{chosen['control_hz']:g} Hz")
    return ", ".join(words)


def tables(trials: Rows) -> tuple[Rows, dict[str, Any]]:
    """The rows of all three tables, and figures over all trials."""
    whole: Rows = []
    objects: Rows = []
    for name in dict.fromkeys(without_gain(row["setting"]) for row in trials):
        members = [row for row in trials if without_gain(row["setting"]) == name]
        columns: dict[tuple[str, int], Rows] = {}
        for row in members:
            columns.setdefault((row["setting"], row["object"]), []).append(row)
        rows = [{"setting": setting, "object": number, **figures(cell)} for (setting, number), cell in columns.items()]
        objects += [{**row, **_paper_object(row["setting"], row["object"])} for row in rows]
        row = {"setting": name, "columns": len(columns), **figures(members)}
        row["reopened_share"] = _mean([each["reopened_share"] for each in rows])  # every column counts the same
        whole.append({**row, **_paper_setting(name, len(columns))})
    shares = {f"{name}_share": float(np.mean([row[name] for row in trials])) for name in ("lifted", "balanced")}
    return [*whole, *objects, *trials], {"grasps": len(trials), **shares}


def without_gain(setting: str) -> str:
    """The setting whatever the gain."""
    return ", ".join(word for word in setting.split(", ") if not word.startswith("gain "))


def figures(trials: Rows) -> dict[str, Any]:
    """Shares of success over trials, and figures over those that held their object to the end."""
    lifted = [row for row in trials if row["lifted"]]
    held = [row for row in trials if row["balanced"]]
    moved = [row["moved_mm"] for row in held]
    return {
        "trials": len(trials),
        "success": len(held) / len(trials),
        "lifted": len(lifted) / len(trials),
        "balanced": len(held) / len(lifted) if lifted else None,
        **{name: _mean([row[name] for row in held]) for name in MEANS},
        "opening_after_balance_ticks_sd": _sd([row["opening_after_balance_ticks"] for row in held]),
        "force_end_n": _mean([row["force_end_n"] for row in held]),
        "moved_lift_mm_median": _quantile([row["moved_lift_mm"] for row in held], 0.5),
        "moved_mm_median": _quantile(moved, 0.5),
        "moved_mm_mean": _mean(moved),
        "moved_mm_p90": _quantile(moved, 0.9),
        "moved_below_10_mm": _mean([value < table("paper")["grasp"]["moved_mm"] for value in moved]),
        "slip_events": _mean([row["slip_events"] for row in trials]),
    }


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _sd(values: Sequence[float]) -> float | None:
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def _quantile(values: Sequence[float], share: float) -> float | None:
    return float(np.quantile(values, share)) if values else None


def _paper_object(setting: str, number: int) -> dict[str, Any]:
    """What the paper says of an object, of its own controller in its usual scene."""
    grasp = table("paper")["grasp"]
    said = {}
    if setting in ("paper", "paper-reset"):
        said = grasp["objects"].get(str(number), {})
    elif setting in ("paper, gain 2", "paper-reset, gain 2"):
        said = grasp["objects_higher_gain"].get(str(number), {})
    success = said["lifted"] * said["balanced"] if said else None
    return {"paper_success": success, "paper_opening_after_balance_ticks": said.get("opening_after_balance_ticks")}


def _paper_setting(setting: str, columns: int) -> dict[str, Any]:
    """What the paper says of a setting as a whole: all its columns, or a test of robustness."""
    grasp = table("paper")["grasp"]
    words = setting.split(", ")
    said: dict[str, float | None] = {"paper_success": None, "paper_reopened_share": None}
    if words == ["none"]:
        return {**said, "paper_success": grasp["lifted_by_contact_alone"]}
    if words[0] not in ("paper", "paper-reset"):
        return said
    if words[1:] == [] and columns > 1:
        return {"paper_success": grasp["success"], "paper_reopened_share": grasp["reopened_share"]}
    tested = [grasp["robustness"][word] for word in words if word in grasp["robustness"]]
    if "second" in words or "closed gel" in words:
        tested = [grasp["robustness"]["other_sensor"]]
    return {**said, "paper_success": tested[0]} if tested else said
