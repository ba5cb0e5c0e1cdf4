"""The loop of detector, controller and gripper with extreme objects, scenes, gains and delays, and wrong detectors.

The object must be held: lifted, balanced, and moved by no more than a stated distance in the gripper. The goal must
stay in the gripper's range, the current within its limit, and the holding fingers at rest. A grasp that cannot continue
must let go, with torque off, and report the reason in an error; this is as good as holding. An object dropped without
an error is not ok, even if no gripper of limited force could have held it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.devices import Rig
from evetac_cli.devices.simulated import SimulatedGripper
from evetac_cli.errors import DeviceError, EvetacError
from evetac_cli.evaluate.cost.grasp import (
    CONTROLLERS,
    FixedDetector,
    GraspResult,
    ShortGrasp,
    WrappedDetector,
    run_short_grasp,
)
from evetac_cli.evaluate.stability.cases import (
    CURRENT,
    FINITE,
    GOAL,
    HELD,
    LET_GO,
    LIFTS,
    MORE_LIFTS,
    MOVED,
    SWING,
    Tables,
    case_rows,
    in_nodes,
    merge,
    run_case,
)
from evetac_cli.events import Events
from evetac_cli.jobs import Rows
from evetac_cli.kernels.grip import paper
from evetac_cli.sim.gripper import Drive
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.sensor import SensorGripper
from evetac_cli.store.recordings import slip_grid
from evetac_cli.trials.grasp.loop import SliceDetector

BALANCE_S = 2.0
SETTLED_MS = 500  # at the end, in which the fingers must be at rest
USUAL_OBJECT = 11
DIES_AFTER_MS = 2500  # while the hand rises


@dataclass
class UnevenSlices(WrappedDetector):
    """A detector that randomly loses slices or receives them twice."""

    rng: np.random.Generator
    lost: float = 0.0  # share
    twice: float = 0.0

    def step(self, events: Events) -> float:
        """Return the slip probability after one more slice; NaN if the slice is lost."""
        sample = self.rng.random()
        if sample < self.lost:
            return float("nan")
        if sample < self.lost + self.twice:
            self.detector.step(events)
        return self.detector.step(events)


@dataclass
class DyingDetector(WrappedDetector):
    """A detector that fails in the middle of a grasp."""

    slices_left: int = DIES_AFTER_MS

    def step(self, events: Events) -> float:
        """Return the slip probability after one more slice; raise DeviceError once the detector has failed."""
        self.slices_left -= 1
        if self.slices_left < 0:
            raise DeviceError("the detector died")
        return self.detector.step(events)


@dataclass(frozen=True)
class GraspCase:
    """One extreme case: changes of the plan, the detector or the controller."""

    name: str
    change_plan: Callable[[Plan], Plan] = lambda plan: plan
    wrap_detector: Callable[[SliceDetector, np.random.Generator], SliceDetector] = lambda detector, rng: detector
    timing: tuple[tuple[str, Any], ...] = ()  # fields of ShortGrasp
    paper_only: bool = False


def _servo(factor: float, plan: Plan) -> Plan:
    gripper = SensorGripper(gain_ma_tick=Drive.gain_ma_tick * factor)
    return replace(plan, sensor=replace(plan.sensor, gripper=gripper))


def _friction(static: float, plan: Plan) -> Plan:
    assert plan.object is not None
    return replace(plan, object=replace(plan.object, static_friction=static))


def _scene(tables: Tables, plan: Plan) -> Plan:
    return merge(plan, tables)


def _always(*, slips: bool) -> Callable[[SliceDetector, np.random.Generator], SliceDetector]:
    return lambda detector, rng: FixedDetector(detector, lambda: slips)


def extreme_cases(*, full: bool) -> list[GraspCase]:
    """Return the extreme cases."""
    factors = (0.1, 0.3, 3.0, 10.0) if full else (0.1, 10.0)
    frictions = (0.1, 0.3, 1.3, 2.0) if full else (0.1, 2.0)
    scenes = LIFTS | (MORE_LIFTS if full else {})
    return [
        GraspCase("as usual"),
        *(GraspCase(f"servo gain x{factor:g}", partial(_servo, factor)) for factor in factors),
        *(GraspCase(f"law's gain x{factor:g}", timing=(("gain", factor),), paper_only=True) for factor in factors),
        *(GraspCase(f"friction {mu:g}", partial(_friction, mu)) for mu in frictions),
        GraspCase("detector never fires", wrap_detector=_always(slips=False)),
        GraspCase("detector always fires", wrap_detector=_always(slips=True)),
        GraspCase("detector dies while the hand rises", wrap_detector=lambda detector, rng: DyingDetector(detector)),
        GraspCase("one slice in five lost", wrap_detector=lambda detector, rng: UnevenSlices(detector, rng, lost=0.2)),
        GraspCase(
            "one slice in five twice", wrap_detector=lambda detector, rng: UnevenSlices(detector, rng, twice=0.2)
        ),
        GraspCase("latency 50 ms", timing=(("latency_ms", 50),)),
        GraspCase("control at 50 Hz", timing=(("control_hz", 50.0),)),
        GraspCase("2 kg, friction 0.1, gel x0.1", partial(_together, 2000.0, 0.1, 0.1)),
        GraspCase("5 g, friction 2, gel x10", partial(_together, 5.0, 2.0, 10.0)),
        *(GraspCase(name, partial(_scene, tables)) for name, tables in scenes.items()),
    ]


def _together(mass_g: float, friction: float, stiffness: float, plan: Plan) -> Plan:
    tables = {"object": {"mass_g": mass_g}, "gel": {"stiffness_factor": stiffness}}
    return merge(_friction(friction, plan), tables)


def cases(seed: int, full: bool) -> list[Callable[[], Rows]]:
    """Return every case with every controller; only the paper's controller has a gain."""
    return [
        partial(grasp_rows, case, controller, seed)
        for controller in CONTROLLERS.pick(full)
        for case in extreme_cases(full=full)
        if not (case.paper_only and controller == "load-proportional")
    ]


def grasp_rows(case: GraspCase, controller: str, seed: int) -> Rows:
    """Run one grasp of a case and return the rows of its outcome or abort."""
    rng = np.random.default_rng([seed, 1])
    short = replace(ShortGrasp(USUAL_OBJECT, controller, balance_s=BALANCE_S), **dict(case.timing))
    used: list[Rig] = []

    def wrap(detector: SliceDetector, devices: Rig) -> SliceDetector:
        used.append(devices)
        return case.wrap_detector(detector, rng)

    def run() -> Rows:
        try:
            result = run_short_grasp(short, seed, change_plan=case.change_plan, wrap_detector=wrap)
        except EvetacError as error:
            if not used:  # refused before the grasp began
                raise
            return let_go(case.name, controller, error, used[0])
        return check(case.name, controller, result)

    return run_case(case.name, run, controller=controller)


def let_go(name: str, controller: str, error: EvetacError, devices: Rig) -> Rows:
    """Return the row of a grasp that aborted with an error: whether its gripper was left without current."""
    gripper = devices.gripper
    assert isinstance(gripper, SimulatedGripper)
    mode, command = gripper.simulation.finger.command
    left_ma = abs(command) if mode == "current" else float("inf")  # in position mode it keeps pressing
    words = str(error).splitlines()[0]
    return case_rows(name, f"let go: {words}", [(LET_GO, float(left_ma))], controller=controller)


def check(name: str, controller: str, result: GraspResult) -> Rows:
    """Return the rows of a grasp that ended regularly."""
    rows, figures = result.rows, result.figures
    # The nodes that resolve slip are left out: they are NaN without slip.
    truth = [rows[path] for path in rows if path.startswith("truth/") and path != slip_grid.NODES]
    numbers = [*truth, rows["gripper/current_ma"]]
    not_finite = sum(int((~np.isfinite(column)).sum()) for column in numbers)
    goals = rows["control/goal_ticks"]
    beyond = max(paper.PAPER.first_tick - int(goals.min()), int(goals.max()) - paper.PAPER.last_tick, 0)
    measured = [
        (HELD, float(2 - figures["lifted"] - figures["balanced"])),
        (MOVED, float(figures["moved_mm"])),
        (CURRENT, float(np.abs(rows["gripper/current_ma"]).max())),
        (GOAL, float(beyond)),
        (FINITE, float(not_finite)),
    ]
    if figures["balanced"]:  # only if held: fingers that lost their object move
        late = rows["gripper/t_us"] >= rows["gripper/t_us"][-1] - 1000 * SETTLED_MS
        swing_ticks = _swing(rows["gripper/t_us"][late], rows["gripper/position_ticks"][late])
        measured.append((SWING, swing_ticks))
    ending = "held" if figures["balanced"] else "lost in balance" if figures["lifted"] else "not lifted"
    outcome = f"{ending}, with at most {rows['truth/normal_force_n'].max():.3g} N"
    outcome += in_nodes(slip_grid.fewest_nodes(rows[slip_grid.NODES]))
    return case_rows(name, outcome, measured, controller=controller)


def _swing(t_us: NDArray[np.int64], position_ticks: NDArray[np.int32]) -> float:
    """Return the oscillation of the fingers around a straight line, in ticks: they may be opening slowly."""
    seconds = (t_us - t_us[0]) * 1e-6
    line = np.polynomial.Polynomial.fit(seconds, position_ticks, 1)
    return round(float(np.ptp(position_ticks - line(seconds))), 2)
