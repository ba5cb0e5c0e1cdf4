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
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli import resources
from evetac_cli.arrays import Floats
from evetac_cli.commands.grasp import Grasp
from evetac_cli.devices import Rig
from evetac_cli.devices.simulated import rig
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common.rows import Extent, collect, difference, mean, run_times
from evetac_cli.evaluate.cost import EvaluateCost
from evetac_cli.events import SLICES_PER_S, Events
from evetac_cli.jobs import Progress, Row, Rows
from evetac_cli.kernels.grip import control as grip_control
from evetac_cli.kernels.grip.control import Control, SlipSignal
from evetac_cli.kernels.tracking import presets
from evetac_cli.sim import grasp_outcome
from evetac_cli.sim.setup.plan import Plan, first_plan
from evetac_cli.stages.model_files import chosen_threshold
from evetac_cli.stages.related_files import named_files
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.trial_writer import TrialBuffer
from evetac_cli.trials.grasp.loop import SliceDetector, Timing, grasp_slices
from evetac_cli.trials.grasp.online_detector import open_detector

LIFT_S = 3.5  # 50 mm are reached at 3.1 s
LOST_MM = 25.0  # an object that moved this far in the gripper is lost


@dataclass
class WrappedDetector:
    """A detector between another one and the controller; subclasses change its slices or its decisions."""

    detector: SliceDetector

    def step(self, events: Events) -> float:
        """Return the slip probability after one more slice."""
        return self.detector.step(events)

    def tell_gripper(self, position_ticks: float, goal_ticks: float) -> None:
        """Pass the gripper's state to the detector."""
        self.detector.tell_gripper(position_ticks, goal_ticks)

    @property
    def signal(self) -> SlipSignal:
        """The detector's signal for the controller."""
        return self.detector.signal


@dataclass
class TimedDetector(WrappedDetector):
    """A detector that times its slices."""

    took_us: list[float] = field(default_factory=list)

    def step(self, events: Events) -> float:
        """Return the slip probability after one more slice."""
        started = time.perf_counter()
        probability = self.detector.step(events)
        self.took_us.append(1e6 * (time.perf_counter() - started))
        return probability


@dataclass
class FixedDetector(WrappedDetector):
    """A detector whose decisions are replaced by `slips`; displacements stay.

    slips: returns whether there is slip.
    """

    slips: Callable[[], bool]
    count: int = 0

    def step(self, events: Events) -> float:
        """Return 1.0 for slip, else 0.0."""
        self.detector.step(events)
        slip = self.slips()
        self.count += slip
        return float(slip)

    @property
    def signal(self) -> SlipSignal:
        """The detector's signal, with the number of slices declared as slip."""
        return self.detector.signal._replace(slips=self.count)


def ground_truth_detector(detector: SliceDetector, devices: Rig) -> SliceDetector:
    """Return a detector that reports the true gross slip, which only the simulation has."""
    truth = devices.truth
    assert truth is not None
    return FixedDetector(detector, lambda: bool(truth()["truth/slip"]))


@dataclass(frozen=True)
class ShortGrasp:
    """A grasp to simulate: the object, the controller and its timing, and the detector."""

    object: int
    controller: str
    gain: float = 1.0
    lift_s: float = LIFT_S
    balance_s: float = 4.0
    latency_ms: int = 0
    control_hz: float = 500.0
    model: Path = resources.MODEL


@dataclass(frozen=True)
class GraspResult:
    """Result of a short grasp: outcome figures, rows of the recording, run time of the detector in each slice."""

    figures: dict[str, Any]
    rows: dict[str, NDArray[Any]]
    detector_us: NDArray[np.float64]


def run_short_grasp(
    short: ShortGrasp,
    seed: int,
    change_plan: Callable[[Plan], Plan] = lambda plan: plan,
    wrap_detector: Callable[[SliceDetector, Rig], SliceDetector] = lambda detector, devices: detector,
) -> GraspResult:
    """Simulate one short grasp.

    `change_plan` modifies the default plan; `wrap_detector` inserts a wrapper between the detector and the controller.
    Raises ValueError if the plan cannot be simulated.
    """
    plan = change_plan(first_plan("lift", str(short.object)))
    touch_ms = round(SLICES_PER_S * plan.scene.time.touch_s)
    timing = Timing(
        touch_ms,
        round(SLICES_PER_S * short.lift_s),
        round(SLICES_PER_S * short.balance_s),
        short.control_hz,
        short.latency_ms,
    )
    devices = rig(plan, np.random.SeedSequence([seed, short.object]), lift_s=short.lift_s, balance_s=short.balance_s)
    control = Control(grip_control.make_law(short.controller, short.gain), short.control_hz)
    buffer = TrialBuffer()
    try:
        with StageFile(short.model, "model") as file:
            constants, threshold = presets.PRESETS[Grasp.tracker], chosen_threshold(file)
            opened = open_detector(file, devices.camera.sensor, constants, threshold)
            detector = TimedDetector(wrap_detector(opened, devices))
        for _, rows in grasp_slices(devices, detector, control, timing):
            buffer.append_rows(rows)
            if float(np.hypot(*rows["truth/object_xy_px"])) * plan.sensor.mm_per_px > LOST_MM:
                break  # it would only slide further
    finally:
        devices.close()
    arrays = buffer.row_arrays()
    figures = grasp_outcome.outcome(arrays, plan.sensor.mm_per_px, timing.end_ms)
    return GraspResult(figures, arrays, np.array(detector.took_us))


OBJECTS = Extent[tuple[int, ...]](quick=(11, 17), full=(10, 11, 12, 13, 17, 18))
TRIALS = Extent(quick=1, full=3)  # of each object
CONTROLLERS = Extent[tuple[str, ...]](
    quick=("paper", "load-proportional"), full=("paper", "paper-reset", "load-proportional")
)
LATENCIES_MS = Extent[tuple[int, ...]](quick=(5, 10, 20, 50), full=(2, 5, 10, 20, 30, 50))
RATES_HZ = Extent[tuple[float, ...]](quick=(50.0, 100.0, 1000.0), full=(50.0, 100.0, 200.0, 250.0, 1000.0))
BALANCE_S = 8.0


class GraspSetting(NamedTuple):
    """A setting: what differs in its grasps, and whether a detector that knows the truth decides."""

    name: str
    changes: dict[str, Any]
    truth: bool = False


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
    return [
        GraspSetting("500 Hz, no latency", {}),
        *(GraspSetting(f"latency {ms} ms", {"latency_ms": ms}) for ms in LATENCIES_MS.pick(full)),
        *(GraspSetting(f"control at {hz:g} Hz", {"control_hz": hz}) for hz in RATES_HZ.pick(full)),
        GraspSetting("detector truth", {}, truth=True),
        *(GraspSetting(f"detector {path.name.partition('.')[0]}", {"model": path}) for path in models),
    ]


def _rows(settings: Sequence[GraspSetting], params: EvaluateCost) -> Iterator[Row]:
    for controller in CONTROLLERS.pick(params.full):
        usual: list[GraspResult] = []
        for setting in settings:
            wrap: dict[str, Any] = {"wrap_detector": ground_truth_detector} if setting.truth else {}
            results = [
                run_short_grasp(
                    ShortGrasp(number, controller, balance_s=BALANCE_S, **setting.changes), params.seed + trial, **wrap
                )
                for number in OBJECTS.pick(params.full)
                for trial in range(params.trials or TRIALS.pick(params.full))
            ]
            usual = usual or results
            yield {"setting": f"{controller}, {setting.name}", **_figures(results, usual)}


def _figures(results: Sequence[GraspResult], usual: Sequence[GraspResult]) -> Row:
    """Return errors over the trials of a setting; distance and force over those that held their object."""
    held_figures = [result.figures for result in results if result.figures["balanced"]]
    apart = difference(_moved_mm(results), _moved_mm(usual))
    return {
        "trials": len(results),
        "error_share_lost": 1 - len(held_figures) / len(results),
        "error_mm_moved": mean(figures["moved_mm"] for figures in held_figures),
        **apart.columns("more_mm_moved", "_mm"),
        "trials_compared": apart.trials,
        "force_n": mean(figures["force_end_n"] for figures in held_figures),
        **run_times(np.concatenate([result.detector_us for result in results])),
    }


def _moved_mm(results: Sequence[GraspResult]) -> Floats:
    """Return how far each trial's object moved in the gripper, NaN if it was lost."""
    moved = (result.figures["moved_mm"] if result.figures["balanced"] else math.nan for result in results)
    return np.array(list(moved))
