"""What a virtual servo moves: the simulation's own drive with or without something between the fingers, or the gripper
of a world that another process steps, met in a small block of shared memory.

Why so: a servo knows its goals and sees its encoder; whether there is a finger, an object or a whole world behind the
encoder is not its business. All of it is simulated.
"""

import math
import mmap
import os
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol

from evetac_cli.realtime.shared_row import SharedRow
from evetac_cli.realtime.shared_time import SharedTime

if TYPE_CHECKING:  # numba is heavy, and a servo on shared memory does without it
    from evetac_cli.sim.gel.contact import ForceCurve
    from evetac_cli.sim.gripper import Drive, DriveState

GAIN_MA_TICK = 0.1  # current per tick off the goal and unit of Position P Gain: 5 mA at the paper's 50 (sim/gripper.py)
STEP_S = 1e-3
LONGEST_CATCH_UP_S = 2.0  # a servo that slept longer has been at rest since
OBSTACLE_REACH_TICKS = 200


class Goals(NamedTuple):
    """What moves a servo: registers as they are now; torque is off too where a fault or the watchdog stopped it."""

    torque: bool = False
    mode: int = 0  # of Operating Mode: 0 current, 5 position
    goal_current_ma: int = 0
    current_limit_ma: int = 0
    goal_ticks: int = 0
    p_gain: int = 0

    @property
    def limit_ma(self) -> float:
        """The largest current: Current Limit, in position mode Goal Current if that is less; 0 without torque."""
        if not self.torque:
            return 0.0
        most = min(self.current_limit_ma, abs(self.goal_current_ma)) if self.mode else self.current_limit_ma
        return float(most)

    @property
    def gain_ma_tick(self) -> float:
        """Current for each tick that the goal is ahead, in position mode."""
        return GAIN_MA_TICK * self.p_gain

    def command(self) -> tuple[Literal["position", "current"], float]:
        """As the simulated drive takes it: ("position", ticks) or ("current", mA), the current within the limit."""
        if not self.torque:
            return "current", 0.0
        if self.mode:
            return "position", float(self.goal_ticks)
        return "current", min(max(float(self.goal_current_ma), -self.limit_ma), self.limit_ma)


class ServoMotion(NamedTuple):
    """What a servo measures: current (mA), position (ticks), speed (ticks/s)."""

    current_ma: float = 0.0
    position_ticks: int = 0
    velocity_ticks_s: float = 0.0


class Plant(Protocol):
    """What a servo moves: it is given goals and returns what is measured."""

    def advance(self, goals: Goals, now_s: float) -> ServoMotion:
        """Move under these goals until now (seconds of a clock that never goes back); what is measured then."""


@dataclass(frozen=True)
class Obstacle:
    """Something between the fingers: first touched at `at_ticks`, pushing back with `stiffness_n_tick` per finger."""

    at_ticks: float = 437.0
    stiffness_n_tick: float = 0.27  # of fingers, links and mounts (sim/scenes/gripped.py)


class OwnDynamics:
    """The simulation's drive of a finger, alone in the world but for an obstacle."""

    def __init__(self, obstacle: Obstacle | None = None, position_ticks: float = 400.0) -> None:
        from evetac_cli.sim.gripper import Drive, start, step

        self._drive: Drive = Drive()
        touch_ticks = obstacle.at_ticks if obstacle else self._drive.open_ticks
        self._curve = _curve(obstacle, self._drive)
        self._state: DriveState = start(self._drive, self._curve, touch_ticks, position_ticks - touch_ticks)
        # at rest without current nothing moves; but the first step compiles, which must not take from real time
        step(self._state, self._drive, self._curve, "current", 0.0, STEP_S)
        self._now_s = math.nan
        self._goals: Goals | None = None

    def advance(self, goals: Goals, now_s: float) -> ServoMotion:
        """Steps of 1 ms until now; time not yet a whole step is kept for the next call."""
        from evetac_cli.sim.gripper import step

        if math.isnan(self._now_s):
            self._now_s = now_s
        steps = math.floor((now_s - self._now_s) / STEP_S)
        if goals != self._goals:
            self._drive = replace(self._drive, gain_ma_tick=goals.gain_ma_tick, current_limit_ma=goals.limit_ma)
            self._goals = goals
        mode, value = goals.command()
        for _ in range(min(steps, round(LONGEST_CATCH_UP_S / STEP_S))):
            step(self._state, self._drive, self._curve, mode, value, STEP_S)
        self._now_s += steps * STEP_S
        velocity = self._state.speed_m_s / (self._curve.metres_per_tick / 2)
        return ServoMotion(self._state.current_ma, self._state.position_ticks, velocity)


def _curve(obstacle: Obstacle | None, drive: "Drive") -> "ForceCurve":
    import numpy as np

    from evetac_cli.sim.gel.contact import ForceCurve
    from evetac_cli.sim.gripper import gap_m, metres_per_tick

    at_ticks = obstacle.at_ticks if obstacle else (drive.open_ticks + drive.closed_ticks) / 2
    metres = metres_per_tick(max(gap_m(at_ticks), 0.0))
    if obstacle is None:
        return ForceCurve(drive.closed_ticks, metres, np.zeros(2), np.zeros(2))
    force_n = obstacle.stiffness_n_tick * np.arange(OBSTACLE_REACH_TICKS + 1.0)
    return ForceCurve(1.0, metres, force_n, np.zeros_like(force_n))


class SharedPlant:
    """The gripper of a world that another process steps, in a block of shared memory.

    The servo passes its goals (`advance`) and the world reads them (`goals`); the world shows how its gripper moved
    (`show`) and the servo reads that. Whoever makes it without a path owns the block; others attach to its path, as
    long as the owner has not closed it. It may be pickled: the copy is attached. `time` is the time of that world.

    Why so: on Linux the block is a file without a name, which its owner's folder in /proc leads to. It is gone with the
    last process that has it open, whatever ended them.
    """

    _GOALS_AT, _MOTION_AT, _TIME_AT = 0, 128, 256
    _SIZE = _TIME_AT + SharedTime.SIZE

    def __init__(self, path: Path | str | None = None) -> None:
        self._owner = path is None
        if path is not None:
            self._handle = os.open(path, os.O_RDWR)
        elif sys.platform == "linux":
            self._handle = os.memfd_create("evetac-plant")
            path = f"/proc/{os.getpid()}/fd/{self._handle}"
        else:
            self._handle, path = tempfile.mkstemp(prefix="evetac-plant-")
        if self._owner:
            os.ftruncate(self._handle, self._SIZE)
        self.path = Path(path)
        self._memory = mmap.mmap(self._handle, self._SIZE)
        self._goals = SharedRow(self._memory, self._GOALS_AT, "6q")
        self._motion = SharedRow(self._memory, self._MOTION_AT, "dqd")
        self.time = SharedTime(self.path, self._TIME_AT)
        self._passed_on: Goals | None = None

    def __reduce__(self) -> tuple[type["SharedPlant"], tuple[Path]]:
        return SharedPlant, (self.path,)

    def advance(self, goals: Goals, now_s: float) -> ServoMotion:
        """For the servo: pass on its goals; what the world showed last."""
        if goals != self._passed_on:
            self._goals.write(*goals)
            self._passed_on = goals
        shown = self._motion.read()
        if shown is None:
            return ServoMotion()
        current_ma, position_ticks, velocity = shown[1]
        return ServoMotion(current_ma, int(position_ticks), velocity)

    def goals(self) -> Goals:
        """For the world: the servo's goals; without torque as long as there is no servo."""
        row = self._goals.read()
        if row is None:
            return Goals()
        torque, *rest = row[1]
        return Goals(bool(torque), *(int(value) for value in rest))

    def show(self, motion: ServoMotion) -> None:
        """For the world: how the gripper moved."""
        self._motion.write(*motion)

    def close(self) -> None:
        """Let go of the memory, and end it if it was made here; a second call does nothing."""
        if not self._memory.closed:
            self._memory.close()
            os.close(self._handle)
            if self._owner:
                self.remove()

    def remove(self) -> None:
        """Take its name away, where it has one; it lasts as long as some process has it open."""
        if sys.platform != "linux":
            self.path.unlink(missing_ok=True)
