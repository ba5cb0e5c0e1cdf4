"""evaluate stability grasp: the loop of detector, controller and gripper where it is stiff, light, heavy, or lied to.

A case is ok when the grasp ends, every number stays finite, the goal stays in the gripper's range, the current within
its limit, and the fingers do not swing at the end. Whether the object was held is said and is no condition: 2 kg are
more than a law with a limited push can hold, and a detector that never fires is no detector. Refusals of a plan in
words are ok; they come from the simulator.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.devices import Rig
from evetac_cli.errors import EvetacError
from evetac_cli.events import Events
from evetac_cli.kernels.grip import paper
from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.numerics.grasp_trials import CONTROLLERS, GraspResult, Says, Short, grasp
from evetac_cli.numerics.stability_rows import Row, Rows
from evetac_cli.sim.gripper import Drive
from evetac_cli.stages.grasp.loop import SlipDetector

Plan = dict[str, Any]
ROWS = Rows(("force_most_n", "current_most_ma", "swing_ticks", "moved_mm"))
USUAL_CONTROLLERS = ("paper", "load-proportional")
BALANCE_S = 3.0
SETTLED_MS = 500  # at the end, in which fingers are looked at
MOST_SWING_TICKS = 4.0  # of the encoder in that time: a step of an integer goal moves the fingers by less
USUAL_OBJECT = 11


@dataclass
class Uneven:
    """Slices that are lost or come twice on their way to the detector, at random."""

    sense: SlipDetector
    rng: np.random.Generator
    lost: float = 0.0  # share
    twice: float = 0.0

    def step(self, events: Events) -> float:
        """The last probability, where the slice is lost."""
        drawn = self.rng.random()
        if drawn < self.lost:
            return float("nan")
        if drawn < self.lost + self.twice:
            self.sense.step(events)
        return self.sense.step(events)

    @property
    def signal(self) -> SlipSignal:
        """What came through."""
        return self.sense.signal


@dataclass(frozen=True)
class Case:
    """One extreme: how the plan, the detector or the controller is changed."""

    name: str
    change: Callable[[Plan], None] = lambda plan: None
    through: Callable[[SlipDetector, Rig, np.random.Generator], SlipDetector] = lambda sense, devices, rng: sense
    timing: tuple[tuple[str, Any], ...] = ()  # fields of Short
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


def cases(*, full: bool) -> list[Case]:
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
        Case("detector never fires", through=lambda sense, devices, rng: Says(sense, lambda: False)),
        Case("detector always fires", through=lambda sense, devices, rng: Says(sense, lambda: True)),
        Case("one slice in five lost", through=lambda sense, devices, rng: Uneven(sense, rng, lost=0.2)),
        Case("one slice in five twice", through=lambda sense, devices, rng: Uneven(sense, rng, twice=0.2)),
        Case("latency 50 ms", timing=(("latency_ms", 50),)),
        Case("control at 50 Hz", timing=(("control_hz", 50.0),)),
        Case("2 kg, friction 0.1, gel x0.1", lambda plan: _worst(plan, 2000.0, 0.1, 0.1)),
        Case("5 g, friction 2, gel x10", lambda plan: _worst(plan, 5.0, 2.0, 10.0)),
    ]


def _worst(plan: Plan, mass_g: float, friction: float, gel: float) -> None:
    _object("mass_g", mass_g, plan)
    _object("static_friction", friction, plan)
    _gel(gel, plan)


def suite(seed: int, *, full: bool = False) -> list[Callable[[], Row]]:
    """Every case with every controller, each a function that makes its row."""
    controllers = CONTROLLERS if full else USUAL_CONTROLLERS
    return [
        partial(case_row, case, controller, seed)
        for controller in controllers
        for case in cases(full=full)
        if not (case.paper_only and controller == "load-proportional")
    ]


def case_row(case: Case, controller: str, seed: int) -> Row:
    """Grasp once under a case."""
    rng = np.random.default_rng([seed, 1])
    short = replace(Short(USUAL_OBJECT, controller, balance_s=BALANCE_S), **dict(case.timing))
    name = f"{controller}: {case.name}"
    try:
        held = grasp(short, seed, change=case.change, through=lambda sense, devices: case.through(sense, devices, rng))
    except (ValueError, EvetacError) as error:
        return ROWS.row(name, True, f"refused: {error}")
    return judged(name, held)


def judged(name: str, held: GraspResult) -> Row:
    """The row of a grasp that ended: ok or not, and what came of it."""
    rows, figures = held.rows, held.figures
    numbers = [rows[path] for path in rows if path.startswith("truth/") or path in ("gripper/current_ma",)]
    finite = all(bool(np.isfinite(column).all()) for column in numbers)
    current_ma = float(np.abs(rows["gripper/current_ma"]).max())
    goals = rows["control/goal_ticks"]
    in_range = bool(goals.min() >= paper.PAPER.first_tick and goals.max() <= paper.PAPER.last_tick)
    late = rows["gripper/t_us"] >= rows["gripper/t_us"][-1] - 1000 * SETTLED_MS
    swing_ticks = _swing(rows["gripper/t_us"][late], rows["gripper/position_ticks"][late])
    calm = swing_ticks <= MOST_SWING_TICKS or not figures["balanced"]  # fingers that lost their object close or open
    ok = finite and in_range and current_ma <= Drive.current_limit_ma and calm
    fate = "held" if figures["balanced"] else "lost in balance" if figures["lifted"] else "not lifted"
    more = {
        "force_most_n": float(rows["truth/normal_force_n"].max()),
        "current_most_ma": current_ma,
        "swing_ticks": swing_ticks,
        "moved_mm": figures["moved_mm"] if figures["balanced"] else None,
    }
    return ROWS.row(name, ok, fate if finite else "not finite", **more)


def _swing(t_us: NDArray[np.int64], position_ticks: NDArray[np.int32]) -> float:
    """How far fingers go to and fro, in ticks: about a straight line, as they may be opening slowly."""
    seconds = (t_us - t_us[0]) * 1e-6
    line = np.polynomial.Polynomial.fit(seconds, position_ticks, 1)
    return round(float(np.ptp(position_ticks - line(seconds))), 2)
