"""The part `grasp`: losses of a grasp due to a late detector, a slow controller, or another detector.

Each setting differs in one respect from the default (no added latency, 500 Hz, the pretrained detector). It is run with
every controller on the same few seeded trials. `error_share_lost` is the share of trials whose object was not held to
the end. `error_mm_moved` is the mean motion of held objects in the gripper, and `force_n` their grip force at the end.
`more_mm_moved` is the paired difference from the default on the same trials if both held, with its interval (see
rows).

Run times are those of the detector: tracker, features and network of one slice. `detector truth` uses the simulation's
true slip instead of the network. No detector can know more about the present, though it may predict.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli import resources
from evetac_cli.arrays import Floats
from evetac_cli.devices import Rig
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.common.rows import Extent, collect, difference, finite_or_none, mean, run_times
from evetac_cli.evaluate.cost import EvaluateCost
from evetac_cli.evaluate.cost.short_grasps import GraspResult, ShortGrasp, ground_truth_detector, run_short_grasp
from evetac_cli.jobs import Progress, Row, Rows
from evetac_cli.stages.related_files import named_files
from evetac_cli.trials.grasp.loop import SliceDetector

OBJECTS = Extent[tuple[int, ...]](quick=(11, 17), full=(10, 11, 12, 13, 17, 18))
TRIALS = Extent(quick=1, full=3)  # of each object
CONTROLLERS = Extent[tuple[str, ...]](
    quick=("paper", "load-proportional"), full=("paper", "paper-reset", "load-proportional")
)
LATENCIES_MS = Extent[tuple[int, ...]](quick=(5, 10, 20, 50), full=(2, 5, 10, 20, 30, 50))
RATES_HZ = Extent[tuple[float, ...]](quick=(50.0, 100.0, 1000.0), full=(50.0, 100.0, 200.0, 250.0, 1000.0))
BALANCE_S = 8.0
TITLES = {
    "error_share_lost": "share of objects lost",
    "error_mm_moved": "object moved in the gripper, mean [mm]",
    "force_n": "grip force at the end, mean [N]",
}


@dataclass(frozen=True)
class GraspSetting:
    """Detector and controller timing of a setting."""

    name: str
    latency_ms: int = 0
    control_hz: float = 500.0
    truth: bool = False
    model: Path | None = None


def inputs(files: list[Path], model: Path | None) -> tuple[Path, ...]:
    """Return the pretrained model, then those given by `--model`: a file, a folder or a glob."""
    if files:
        raise InputError("takes no files", where="evaluate cost grasp", expected="detectors to compare by --model")
    model_files = [] if model is None else named_files(model, "model", "--model")
    return tuple(dict.fromkeys((resources.MODEL, *model_files)))


def measure(params: EvaluateCost, inputs: Sequence[Path], progress: Progress) -> Rows:
    """Return rows of every setting with every controller."""
    selected_settings = settings(params.full, inputs[1:])
    total = len(CONTROLLERS.pick(params.full)) * len(selected_settings)
    return collect(_rows(selected_settings, params), total, progress)


def summary(rows: Rows) -> dict[str, Any]:
    """Return the numbers of settings and trials."""
    return {"settings": len(rows), "trials": sum(row["trials"] for row in rows)}


def settings(full: bool, models: Sequence[Path]) -> list[GraspSetting]:
    """Return the default setting and all that differ from it."""
    usual = GraspSetting("500 Hz, no latency")
    return [
        usual,
        *(replace(usual, name=f"latency {ms} ms", latency_ms=ms) for ms in LATENCIES_MS.pick(full)),
        *(replace(usual, name=f"control at {hz:g} Hz", control_hz=hz) for hz in RATES_HZ.pick(full)),
        replace(usual, name="detector truth", truth=True),
        *(replace(usual, name=f"detector {path.name.partition('.')[0]}", model=path) for path in models),
    ]


def _rows(settings: Sequence[GraspSetting], params: EvaluateCost) -> Iterator[Row]:
    for controller in CONTROLLERS.pick(params.full):
        usual: list[GraspResult] = []
        for setting in settings:
            short = ShortGrasp(
                0, controller, balance_s=BALANCE_S, latency_ms=setting.latency_ms, control_hz=setting.control_hz
            )
            wrap_detector = ground_truth_detector if setting.truth else _unchanged
            results = [
                run_short_grasp(
                    replace(short, object=number), params.seed + trial, setting.model, wrap_detector=wrap_detector
                )
                for number in OBJECTS.pick(params.full)
                for trial in range(params.trials or TRIALS.pick(params.full))
            ]
            usual = usual or results
            yield {"setting": f"{controller}, {setting.name}", **_figures(results, usual)}


def _unchanged(detector: SliceDetector, devices: Rig) -> SliceDetector:
    return detector


def _figures(results: Sequence[GraspResult], usual: Sequence[GraspResult]) -> Row:
    """Return errors over the trials of a setting; distance and force over those that held their object."""
    held_figures = [result.figures for result in results if result.figures["balanced"]]
    apart = difference(_moved_mm(results), _moved_mm(usual))
    return {
        "trials": len(results),
        "error_share_lost": 1 - len(held_figures) / len(results),
        "error_mm_moved": mean(figures["moved_mm"] for figures in held_figures),
        "more_mm_moved": finite_or_none(apart.mean),
        "interval_low_mm": finite_or_none(apart.low),
        "interval_high_mm": finite_or_none(apart.high),
        "trials_compared": apart.trials,
        "force_n": mean(figures["force_end_n"] for figures in held_figures),
        **run_times(np.concatenate([result.detector_us for result in results])),
    }


def _moved_mm(results: Sequence[GraspResult]) -> Floats:
    """Return how far each trial's object moved in the gripper, NaN if it was lost."""
    moved = (result.figures["moved_mm"] if result.figures["balanced"] else math.nan for result in results)
    return np.array(list(moved))


def draw(figure: Any, rows: Rows, errors: Sequence[str]) -> None:
    """Plot errors and force of every setting, a colour per controller."""
    settings = list(dict.fromkeys(row["setting"].partition(", ")[2] for row in rows))
    controllers = list(dict.fromkeys(row["setting"].partition(", ")[0] for row in rows))
    panels = picture.panels(figure, len(TITLES), len(TITLES), sharey=True)
    for axes, (name, title) in zip(panels, TITLES.items(), strict=True):
        for number, controller in enumerate(controllers):
            controller_rows = [
                row for row in rows if row["setting"].startswith(f"{controller}, ") and row[name] is not None
            ]
            apart = 0.5 * ((number + 0.5) / len(controllers) - 0.5)
            heights = [settings.index(row["setting"].partition(", ")[2]) + apart for row in controller_rows]
            if name == "error_share_lost":
                for row, height in zip(controller_rows, heights, strict=True):
                    reach = picture.wilson(row[name], row["trials"])
                    label = "95 % interval by the number of trials (Wilson)"
                    axes.errorbar(row[name], height, xerr=reach, label=label, **picture.INTERVAL)
            style = {**picture.series(number), "markersize": 7, "linestyle": "none"}
            axes.plot([row[name] for row in controller_rows], heights, label=f"controller {controller}", **style)
        axes.set_xlabel(title)
    picture.share_axis(panels[0].xaxis)
    panels[0].set_yticks(range(len(settings)), settings)
    panels[0].set_ylim(len(settings) - 0.5, -0.5)
    picture.legend(figure, panels)
