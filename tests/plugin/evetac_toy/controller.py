"""A controller that closes by a fixed number of ticks at every slip, and never opens."""

from dataclasses import dataclass

from evetac_cli.kernels.grip.control import LawState, PluginLaw, SlipSignal
from evetac_cli.kernels.grip.paper import GraspPhase


@dataclass
class FirmState(LawState):
    """The state of the law: how far it has closed since light contact ended."""

    closed_ticks: float = 0.0


@dataclass(frozen=True)
class FirmLaw(PluginLaw):
    """The law and its constants, which are part of the recipe of every grasp."""

    method = 1  # add one when a change of the code makes it command other goals with the same constants
    approach_ticks: int = 2
    step_ticks: float = 1.0

    def start(self, control_hz: float) -> FirmState:
        """Return the state before the first step."""
        return FirmState(u_ff=-float(self.approach_ticks))

    def step(self, state: LawState, phase: GraspPhase, slip: bool, signal: SlipSignal, position_ticks: int) -> int:
        """Return the goal position: ahead of the fingers during contact, later ahead of where contact ended."""
        assert isinstance(state, FirmState)
        if phase is GraspPhase.CONTACT:
            state.x_ref = float(position_ticks)
            return position_ticks + self.approach_ticks
        state.closed_ticks += self.step_ticks * slip
        state.u_ff = -self.approach_ticks - state.closed_ticks
        return round(state.x_ref - state.u_ff)


@dataclass(frozen=True)
class BlindLaw(FirmLaw):
    """The same law without a slip detector: the fingers stay where contact ended."""

    needs_detector = False


FIRM, BLIND = FirmLaw(), BlindLaw()
