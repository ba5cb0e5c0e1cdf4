"""evaluate cost grasp: what a grasp loses by a late detector, a slow controller, or another detector.

Each setting differs from the usual one (no added latency, 500 Hz, the package's detector) in one thing, and is made
with every controller on the same few seeded trials. `error_share_lost` is the share of trials whose object was not held
to the end, `error_mm_moved` how far objects moved in the gripper where they were (mean), `force_n` how firmly they were
held at the end. Run times are those of what feels: tracker, features and network of one slice. Beside the network
stands the simulation's own knowledge of slip (`truth`): no detector can be better informed of the present, though one
may look ahead.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli import resources
from evetac_cli.devices import Rig
from evetac_cli.jobs import Job, Outcome, Progress, silent
from evetac_cli.numerics.grasp_trials import GraspResult, Short, grasp, truthful
from evetac_cli.params import EvaluateCost, recipe_of
from evetac_cli.stages.evaluate import Rows, own_report, picture, report
from evetac_cli.stages.grasp.loop import SlipDetector
from evetac_cli.stages.related_files import named_files
from evetac_cli.store.files import StageFile

METHOD = 1


@dataclass(frozen=True)
class Extent:
    """What is tried: objects, trials of each, controllers, latencies, rates."""

    objects: tuple[int, ...] = (11, 17)
    trials: int = 1
    controllers: tuple[str, ...] = ("paper", "load-proportional")
    latencies_ms: tuple[int, ...] = (5, 10, 20, 50)
    rates_hz: tuple[float, ...] = (50.0, 100.0, 1000.0)

    def settings(self, models: list[Path]) -> list["Setting"]:
        """The usual setting and all that differ from it."""
        usual = Setting("500 Hz, no latency")
        return [
            usual,
            *(replace(usual, name=f"latency {ms} ms", latency_ms=ms) for ms in self.latencies_ms),
            *(replace(usual, name=f"control at {hz:g} Hz", control_hz=hz) for hz in self.rates_hz),
            replace(usual, name="detector truth", truth=True),
            *(replace(usual, name=f"detector {path.name.partition('.')[0]}", model=path) for path in models),
        ]


@dataclass(frozen=True)
class Setting:
    """One way to feel and control."""

    name: str
    latency_ms: int = 0
    control_hz: float = 500.0
    truth: bool = False
    model: Path | None = None


USUAL = Extent()
FULL = Extent(
    (10, 11, 12, 13, 17, 18),
    3,
    ("paper", "paper-reset", "load-proportional"),
    (2, 5, 10, 20, 30, 50),
    (50.0, 100.0, 200.0, 250.0, 1000.0),
)


def grasp_cost(seed: int, extent: Extent, models: list[Path]) -> Iterator[dict[str, Any]]:
    """Rows of every setting and controller, one after the other."""
    for controller in extent.controllers:
        for setting in extent.settings(models):
            through = truthful if setting.truth else _as_it_is
            short = Short(0, controller, balance_s=8.0, latency_ms=setting.latency_ms, control_hz=setting.control_hz)
            held = [
                grasp(replace(short, object=number), seed + trial, setting.model, through=through)
                for number in extent.objects
                for trial in range(extent.trials)
            ]
            yield {"setting": f"{controller}, {setting.name}", **_row(held)}


def _as_it_is(sense: SlipDetector, devices: Rig) -> SlipDetector:
    return sense


def jobs(params: EvaluateCost, out: Path | None) -> list[Job]:
    """One report, made from the models that are named, if any."""
    models = named_files(params.model, "model", "--model") if params.model is not None else []
    return [Job(tuple(models), own_report("grasp", "cost", out))]


def run(job: Job, params: EvaluateCost, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """A row for every setting and controller, and a picture."""
    models = list(job.inputs)
    extent = FULL if params.full else USUAL
    headers = []
    for path in (resources.MODEL, *models):
        with StageFile(path, "model") as model:
            headers.append(model.header)

    def measure() -> tuple[Rows, dict[str, Any]]:
        rows: Rows = []
        for row in grasp_cost(params.seed, extent, models):
            rows.append(row)
            progress(len(rows), rows_of(extent, models))
        return rows, {"settings": len(rows), "trials": sum(row["trials"] for row in rows)}

    chosen = recipe_of(params)
    outcome = report(job, "evaluate cost", METHOD, chosen, headers, measure, force=force, simulated_source=True)
    return picture.beside(outcome, job.output, lambda figure: _draw(figure, outcome.rows), (13.0, 6.0))


def _draw(figure: Any, rows: Rows) -> None:
    """Error, distance and force, a line of points for each controller."""
    settings = list(dict.fromkeys(row["setting"].partition(", ")[2] for row in rows))
    figure.suptitle("grasps with a late detector, a slow controller, another detector (simulated)")
    for axes, name in zip(
        figure.subplots(1, 3, sharey=True), ("error_share_lost", "error_mm_moved", "force_n"), strict=True
    ):
        for controller in dict.fromkeys(row["setting"].partition(", ")[0] for row in rows):
            mine = [row for row in rows if row["setting"].startswith(f"{controller}, ") and row[name] is not None]
            places = [settings.index(row["setting"].partition(", ")[2]) for row in mine]
            axes.plot([row[name] for row in mine], places, marker="o", linestyle="none", label=controller)
        axes.set_xlabel(name)
        picture.quiet_grid(axes)
    axes.set_yticks(range(len(settings)), settings)
    axes.invert_yaxis()
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)


def rows_of(extent: Extent, models: list[Path]) -> int:
    """How many rows there will be."""
    return len(extent.controllers) * len(extent.settings(models))


def _row(trials: list[GraspResult]) -> dict[str, Any]:
    kept = [trial.figures for trial in trials if trial.figures["balanced"]]
    feel_us = np.concatenate([trial.feel_us for trial in trials])
    return {
        "trials": len(trials),
        "error_share_lost": 1 - len(kept) / len(trials),
        "error_mm_moved": float(np.mean([row["moved_mm"] for row in kept])) if kept else None,
        "force_n": float(np.mean([row["force_end_n"] for row in kept])) if kept else None,
        "time_us_median": float(np.median(feel_us)),
        "time_us_p99": float(np.percentile(feel_us, 99)),
    }
