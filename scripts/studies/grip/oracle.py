"""An oracle grip law that has the true mass, friction and force on the object at every step.

The oracle bounds what a gripper with whole ticks and a gear with friction can do. It is not a controller of `grasp`. At
each step it aims for `margin` times the force that just holds the object, including the force for its motion, and
pushes by the amount that moves the finger from the present force. A sliding object is held by less friction, so the
oracle aims higher until SETTLED_STEPS after nearly all of the contact has stopped. It has no information about the
future. ceiling.json contains its results for seeds 0 to 99 (simulated).
"""

import math
from dataclasses import dataclass
from typing import ClassVar

from evetac_cli.kernels.grip.control import LawState, PluginLaw, SlipSignal
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.sim.scenes.gripped import GraspSimulation

NAME = "oracle"
MARGIN = 1.3
LIGHT_N = 0.1  # at light contact
SHORT, LONG = 0.98, 1.04  # tolerance around the target force: the oracle closes below it, and opens above it
PAUSE_STEPS = 4  # after an opening pulse, so that the finger rests and late commands have arrived
SLIDES = 0.9  # slipping share of the contact above which the object slides
SETTLED_STEPS = 50
GAIN = 2.0  # ticks of push for each N that is missing


@dataclass
class OracleState(LawState):
    """Steps until the next opening pulse, and until a slide counts as over."""

    pause: int = 0
    slides: int = 0


@dataclass(frozen=True)
class Oracle(PluginLaw):
    """Grips with `margin` times the force that just holds the object of a simulation."""

    simulation: GraspSimulation
    margin: float = MARGIN
    method: ClassVar[int] = 1
    needs_detector: ClassVar[bool] = False

    def start(self, control_hz: float) -> OracleState:
        """Return the state before the first step."""
        return OracleState()

    def step(self, state: LawState, phase: GraspPhase, slip: bool, signal: SlipSignal, position_ticks: int) -> int:
        """Return the goal of one control step."""
        assert isinstance(state, OracleState)
        simulation = self.simulation
        drive, force_n = simulation.finger.drive, simulation.finger.state.force_n
        sampled = simulation.sampled
        slides = float(simulation.truth()["truth/slip_share"]) >= SLIDES
        state.slides = SETTLED_STEPS if slides else max(state.slides - 1, 0)
        falls = sampled.static_friction / sampled.kinetic_friction if state.slides else 1.0
        wanted_n = LIGHT_N if phase is GraspPhase.CONTACT else self.margin * falls * simulation.holding_n
        per_tick_n = drive.gain_ma_tick * drive.force_per_current_n_ma
        holds = force_n / per_tick_n  # ticks of push that balance the object's force
        band = (drive.friction_n + drive.friction_share * force_n) / per_tick_n
        state.pause -= 1
        if force_n < SHORT * wanted_n:
            ahead = holds + band + min(GAIN * (wanted_n - force_n), 10.0)
            return position_ticks + math.floor(ahead) + 1
        if force_n > LONG * wanted_n and state.pause <= 0:
            state.pause = PAUSE_STEPS
            return position_ticks + math.ceil(holds - band - min(GAIN * (force_n - wanted_n), 4.0)) - 1
        return position_ticks + round(holds)


def of_name(name: str, simulation: GraspSimulation) -> Oracle:
    """Return the oracle for a name such as oracle:1.5; ValueError if its margin is not from 1 to 10."""
    margin = float(name.partition(":")[2] or MARGIN)
    if not 1.0 <= margin <= 10.0:
        raise ValueError(f"expected a margin from 1 to 10, found {name}")
    return Oracle(simulation, margin)
