"""The gripper of a scene: one finger's drive under the commands that it is given, and the imperfections it may have."""

import math
from collections import deque

import numpy as np

from evetac_cli.sim import gripper
from evetac_cli.sim.gel.contact import ForceCurve
from evetac_cli.sim.gripper import Mode
from evetac_cli.sim.scenes.shared import STEP_S
from evetac_cli.sim.setup.parts import GRIPPER, Timer
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.sampling import SampledTrial

APPROACH_TICKS = -4.0  # start of a lift scene: position relative to touch

Command = tuple[Mode, float]


class LateCommands:
    """Transmission of commands to the motor: each takes effect after a delay, and no command overtakes another.

    A command arrives after the delay and a random part of the jitter.
    """

    def __init__(self, delay_ms: float, jitter_ms: float, command: Command, rng: np.random.Generator) -> None:
        """Start with a command in effect."""
        self._delay, self._jitter = delay_ms * 1e-3 / STEP_S, jitter_ms * 1e-3 / STEP_S
        self._rng = rng
        self._on_the_way: deque[tuple[float, Command]] = deque()
        self._in_effect = self._last_command = command

    def at(self, slice_number: int, command: Command) -> Command:
        """Return the command in effect in a slice, in which `command` was given; a repeated command is not new."""
        if command != self._last_command:
            self._last_command = command
            arrives = slice_number + self._delay + self._jitter * self._rng.uniform()
            if self._on_the_way:
                arrives = max(arrives, self._on_the_way[-1][0])
            self._on_the_way.append((arrives, command))
        while self._on_the_way and self._on_the_way[0][0] <= slice_number:
            self._in_effect = self._on_the_way.popleft()[1]
        return self._in_effect


class FingerDrive:
    """A finger and its motor; set `command` from outside, `move` performs a slice.

    state: the finger's position, current and force. drive: the constants of motor and gear. curve: force and
    indentation over the closing. holding_ma: the current of the initial force. slips_at_ma: the approximate current at
    which a ramp releases the object despite the gear friction; else NaN.
    """

    def __init__(
        self,
        plan: Plan,
        sampled: SampledTrial,
        curve: ForceCurve,
        slip_limit_n: float,
        of_encoder: np.random.Generator,
        of_commands: np.random.Generator,
        timer: Timer,
    ) -> None:
        """Place the finger: closed on the object of a ramp, else open. The streams are those of two imperfections.

        slip_limit_n: normal force below which the object slides. ValueError if the scene starts with less.
        """
        own, object = plan.scene.gripper, plan.object
        assert object is not None
        if own.start_n is not None and own.start_n < slip_limit_n:
            raise ValueError(
                f"gripper.start_n: {own.start_n:g} N cannot hold an object that slips below {slip_limit_n:.3g} N"
            )
        self.curve = curve
        backlash_ticks = plan.of_gripper("backlash_ticks")
        self.drive = drive = gripper.make_drive(plan.sensor.gripper, sampled.gear_friction_factor, backlash_ticks)
        start_n = sampled.start_factor * slip_limit_n + own.start_more_n if own.start_n is None else own.start_n
        self.holding_ma = float(np.ceil(gripper.closing_push_n(drive, start_n) / drive.force_per_current_n_ma))
        self.slips_at_ma = math.nan
        touch_ticks = float(round(gripper.ticks_at_gap(object.held_mm * 1e-3)))
        self.command: Command
        if plan.scene.kind == "ramp":
            self.state = gripper.closed_with(drive, curve, touch_ticks, self.holding_ma)
            self.command = ("current", self.holding_ma)
            slides_n = gripper.opening_push_n(drive, slip_limit_n)
            starts_n = gripper.opening_push_n(drive, self.state.force_n, rests=True)
            self.slips_at_ma = min(slides_n, starts_n) / drive.force_per_current_n_ma
        else:
            away = APPROACH_TICKS if plan.scene.kind == "lift" else -own.open_ticks
            self.state = gripper.start(drive, curve, touch_ticks, away)
            self.command = ("position", self.state.position_ticks)
        self._step = timer(GRIPPER.name, gripper.step)
        self._noise_ticks, self._of_encoder = plan.of_gripper("encoder_noise_ticks"), of_encoder
        delay_ms, jitter_ms = plan.of_gripper("command_delay_ms"), plan.of_gripper("command_jitter_ms")
        late = delay_ms or jitter_ms
        self._late = LateCommands(delay_ms, jitter_ms, self.command, of_commands) if late else None

    def move(self, slice_number: int) -> tuple[float, float]:
        """Move for a slice; return the normal force before and after."""
        before_n = self.state.force_n
        mode, command = self.command if self._late is None else self._late.at(slice_number, self.command)
        if self._noise_ticks:
            self.state.encoder_off_ticks = self._noise_ticks * float(self._of_encoder.normal())
        return before_n, self._step(self.state, self.drive, self.curve, mode, command, STEP_S)

    @property
    def open_mm(self) -> float:
        """Return the distance of the finger from the object; 0 in contact."""
        return max(-self.state.closing_ticks, 0.0) * self.curve.metres_per_tick * 0.5e3
