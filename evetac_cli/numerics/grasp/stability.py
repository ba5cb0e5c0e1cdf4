"""The loop of detector, controller and gripper with extreme objects, gains and delays, and with wrong detectors.

A case is ok when the grasp ends, every number stays finite, the goal stays in the gripper's range, the current within
its limit, and the fingers do not oscillate at the end. Whether the object was held is reported and is no condition: a
controller with a limited force cannot hold 2 kg, and a detector that never fires cannot help. It is also ok when the
simulator refuses the plan in words.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import Events
from evetac_cli.kernels.grip import paper
from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.numerics.grasp.trials import CONTROLLERS, FixedDetector, GraspResult, ShortGrasp, run_short_grasp
from evetac_cli.numerics.rows import Row, case_row, run_case
from evetac_cli.sim.gripper import Drive
from evetac_cli.stages.grasp.loop import SlipDetector

Plan = dict[str, Any]
QUICK_CONTROLLERS = ("paper", "load-proportional")
BALANCE_S = 3.0
SETTLED_MS = 500  # at the end, in which the fingers should be at rest
SWING_MAX_TICKS = 4.0  # of the encoder in that time: a step of an integer goal moves the fingers by less
USUAL_OBJECT = 11


@dataclass
class UnevenSlices:
    """A detector whose slices are lost or come twice on their way to it, at random."""

    detector: SlipDetector
    rng: np.random.Generator
    lost: float = 0.0  # share
    twice: float = 0.0

    def step(self, events: Events) -> float:
        """Slip probability after one more slice; NaN where it is lost."""
        drawn = self.rng.random()
        if drawn < self.lost:
            return float("nan")
        if drawn < self.lost + self.twice:
            self.detector.step(events)
        return self.detector.step(events)

    @property
    def signal(self) -> SlipSignal:
        """The detector's signal for the controller."""
        return self.detector.signal


@dataclass(frozen=True)
class Case:
    """One extreme: how the plan, the detector or the controller is changed."""

    name: str
    change_plan: Callable[[Plan], None] = lambda plan: None
    wrap_detector: Callable[[SlipDetector, np.random.Generator], SlipDetector] = lambda detector, rng: detector
    timing: tuple[tuple[str, Any], ...] = ()  # fields of ShortGrasp
    paper_only: bool = False


def _servo(factor: float, plan: Plan) -> None:
    gain = Drive.gain_ma_tick * factor
    plan["sensor_row"] = {**plan["sensor_row"], "gripper": {"gain_ma_tick": gain}}


def _object(name: str, value: float, plan: Plan) -> None:
    plan["object_row"] = {**plan["object_row"], name: value}


def _gel(factor: float, plan: Plan) -> None:
    row = plan["sensor_row"]
    stiffer = {name: row[name] * factor for name in ("shear_modulus_pa", "normal_modulus_pa")}
    plan["sensor_row"] = {**row, **stiffer}


def extreme_cases(*, full: bool) -> list[Case]:
    """The extremes, by name."""
    factors = (0.1, 0.3, 3.0, 10.0) if full else (0.1, 10.0)
    masses = (5.0, 20.0, 1000.0, 2000.0) if full else (5.0, 2000.0)
    frictions = (0.1, 0.3, 1.3, 2.0) if full else (0.1, 2.0)
    return [
        Case("as usual"),
        *(Case(f"servo gain x{factor:g}", partial(_servo, factor)) for factor in factors),
        *(Case(f"law's gain x{factor:g}", timing=(("gain", factor),), paper_only=True) for factor in factors),
        *(Case(f"mass {mass:g} g", partial(_object, "mass_g", mass)) for mass in masses),
        *(Case(f"friction {mu:g}", partial(_object, "static_friction", mu)) for mu in frictions),
        *(Case(f"gel stiffness x{factor:g}", partial(_gel, factor)) for factor in factors),
        Case("detector never fires", wrap_detector=lambda detector, rng: FixedDetector(detector, lambda: False)),
        Case("detector always fires", wrap_detector=lambda detector, rng: FixedDetector(detector, lambda: True)),
        Case("one slice in five lost", wrap_detector=lambda detector, rng: UnevenSlices(detector, rng, lost=0.2)),
        Case("one slice in five twice", wrap_detector=lambda detector, rng: UnevenSlices(detector, rng, twice=0.2)),
        Case("latency 50 ms", timing=(("latency_ms", 50),)),
        Case("control at 50 Hz", timing=(("control_hz", 50.0),)),
        Case("2 kg, friction 0.1, gel x0.1", lambda plan: _object_and_gel(plan, 2000.0, 0.1, 0.1)),
        Case("5 g, friction 2, gel x10", lambda plan: _object_and_gel(plan, 5.0, 2.0, 10.0)),
    ]


def _object_and_gel(plan: Plan, mass_g: float, friction: float, gel: float) -> None:
    _object("mass_g", mass_g, plan)
    _object("static_friction", friction, plan)
    _gel(gel, plan)


def cases(seed: int, full: bool) -> list[Callable[[], Row]]:
    """Every case with every controller; only the paper's law has a gain."""
    controllers = CONTROLLERS if full else QUICK_CONTROLLERS
    return [
        partial(grasp_row, case, controller, seed)
        for controller in controllers
        for case in extreme_cases(full=full)
        if not (case.paper_only and controller == "load-proportional")
    ]


def grasp_row(case: Case, controller: str, seed: int) -> Row:
    """Grasp once under a case."""
    rng = np.random.default_rng([seed, 1])
    short = replace(ShortGrasp(USUAL_OBJECT, controller, balance_s=BALANCE_S), **dict(case.timing))
    name = f"{controller}: {case.name}"

    def run() -> Row:
        result = run_short_grasp(
            short,
            seed,
            change_plan=case.change_plan,
            wrap_detector=lambda detector, devices: case.wrap_detector(detector, rng),
        )
        return check(name, result)

    return run_case(name, run)


def check(name: str, result: GraspResult) -> Row:
    """The row of a grasp that ended: whether it is ok, and how it ended."""
    rows, figures = result.rows, result.figures
    numbers = [rows[path] for path in rows if path.startswith("truth/") or path in ("gripper/current_ma",)]
    finite = all(bool(np.isfinite(column).all()) for column in numbers)
    current_ma = float(np.abs(rows["gripper/current_ma"]).max())
    goals = rows["control/goal_ticks"]
    in_range = bool(goals.min() >= paper.PAPER.first_tick and goals.max() <= paper.PAPER.last_tick)
    late = rows["gripper/t_us"] >= rows["gripper/t_us"][-1] - 1000 * SETTLED_MS
    swing_ticks = _swing(rows["gripper/t_us"][late], rows["gripper/position_ticks"][late])
    calm = swing_ticks <= SWING_MAX_TICKS or not figures["balanced"]  # fingers that lost their object close or open
    ok = finite and in_range and current_ma <= Drive.current_limit_ma and calm
    ending = "held" if figures["balanced"] else "lost in balance" if figures["lifted"] else "not lifted"
    return case_row(
        name,
        ok,
        ending if finite else "not finite",
        force_max_n=float(rows["truth/normal_force_n"].max()),
        current_max_ma=current_ma,
        swing_ticks=swing_ticks,
        moved_mm=figures["moved_mm"] if figures["balanced"] else None,
    )


def _swing(t_us: NDArray[np.int64], position_ticks: NDArray[np.int32]) -> float:
    """How far the fingers oscillate about a straight line, in ticks: they may be opening slowly."""
    seconds = (t_us - t_us[0]) * 1e-6
    line = np.polynomial.Polynomial.fit(seconds, position_ticks, 1)
    return round(float(np.ptp(position_ticks - line(seconds))), 2)
