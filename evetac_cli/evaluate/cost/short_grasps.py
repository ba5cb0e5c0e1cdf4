"""Short simulated grasps in memory, and wrappers of the detector between network and controller.

The hand rises as in the scene, but the lift ends soon after 50 mm, and the balance after a few seconds.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli import resources
from evetac_cli.commands.grasp import Grasp
from evetac_cli.devices import Rig
from evetac_cli.devices.simulated import rig
from evetac_cli.events import SLICES_PER_S, Events
from evetac_cli.kernels.grip import control as grip_control
from evetac_cli.kernels.grip.control import Control, SlipSignal
from evetac_cli.kernels.tracking import presets
from evetac_cli.sim import grasp_outcome
from evetac_cli.sim.setup.plan import Plan, first_plan
from evetac_cli.stages.model_files import chosen_threshold
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.trial_writer import TrialBuffer
from evetac_cli.trials.grasp.loop import SliceDetector, Timing, grasp_slices
from evetac_cli.trials.grasp.online_detector import open_detector

LIFT_S = 3.5  # 50 mm are reached at 3.1 s
LOST_MM = 25.0  # an object that moved this far in the gripper is lost
CONTROLLERS = ("paper", "paper-reset", "load-proportional")


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
    """A grasp to simulate: the object, the controller and its timing."""

    object: int
    controller: str
    gain: float = 1.0
    lift_s: float = LIFT_S
    balance_s: float = 4.0
    latency_ms: int = 0
    control_hz: float = 500.0


@dataclass(frozen=True)
class GraspResult:
    """Result of a short grasp: outcome figures, rows of the recording, run time of the detector in each slice."""

    figures: dict[str, Any]
    rows: dict[str, NDArray[Any]]
    detector_us: NDArray[np.float64]


def run_short_grasp(
    short: ShortGrasp,
    seed: int,
    model: Path | None = None,
    change_plan: Callable[[Plan], Plan] = lambda plan: plan,
    wrap_detector: Callable[[SliceDetector, Rig], SliceDetector] = lambda detector, devices: detector,
) -> GraspResult:
    """Simulate one short grasp.

    model: detector, default the pretrained one; `change_plan` modifies the default plan; `wrap_detector` inserts a
    wrapper between the detector and the controller. Raises ValueError if the plan cannot be simulated.
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
        with StageFile(model or resources.MODEL, "model") as file:
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
