"""The plant that a virtual servo moves.

It is either the simulation's own drive, with or without an obstacle between the fingers, or the gripper of a world that
another process steps, connected through a small block of shared memory.

A servo has goals and an encoder. Whether a finger, an object or a whole world is behind the encoder does not concern
it. All of this is simulated.
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

if TYPE_CHECKING:  # numba is slow to import, and a servo on shared memory does not need it
    from evetac_cli.sim.gel.contact import ForceCurve
    from evetac_cli.sim.gripper import Drive, DriveState

# mA per tick from the goal per unit of Position P Gain: 5 mA per tick at the paper's 50 (sim/gripper.py)
GAIN_MA_TICK = 0.1
STEP_S = 1e-3
LONGEST_CATCH_UP_S = 2.0  # a servo that slept longer has been at rest since
OBSTACLE_REACH_TICKS = 200


class Goals(NamedTuple):
    """The present goal registers of a servo; torque is also False if a fault or the watchdog stopped it."""

    torque: bool = False
    mode: int = 0  # value of Operating Mode: 0 current, 5 position
    goal_current_ma: int = 0
    current_limit_ma: int = 0
    goal_ticks: int = 0
    p_gain: int = 0

    @property
    def limit_ma(self) -> float:
        """The largest current: Current Limit, or in position mode Goal Current if that is lower; 0 without torque."""
        if not self.torque:
            return 0.0
        most = min(self.current_limit_ma, abs(self.goal_current_ma)) if self.mode else self.current_limit_ma
        return float(most)

    @property
    def gain_ma_tick(self) -> float:
        """Current per tick that the goal is ahead, in position mode."""
        return GAIN_MA_TICK * self.p_gain

    def command(self) -> tuple[Literal["position", "current"], float]:
        """Return the command to the simulated drive: ("position", ticks), or ("current", mA) within the limit."""
        if not self.torque:
            return "current", 0.0
        if self.mode:
            return "position", float(self.goal_ticks)
        return "current", min(max(float(self.goal_current_ma), -self.limit_ma), self.limit_ma)


class ServoMotion(NamedTuple):
    """Measurements of a servo: current (mA), position (ticks), speed (ticks/s)."""

    current_ma: float = 0.0
    position_ticks: int = 0
    velocity_ticks_s: float = 0.0


class Plant(Protocol):
    """The plant that a servo moves: it takes goals and returns measurements."""

    def advance(self, goals: Goals, now_s: float) -> ServoMotion:
        """Move under these goals until now (seconds of a clock that never goes back).

        Return the measurements at that time.
        """


@dataclass(frozen=True)
class Obstacle:
    """An object between the fingers: first touched at `at_ticks`, pushes back with `stiffness_n_tick` per finger."""

    at_ticks: float = 437.0
    stiffness_n_tick: float = 0.27  # stiffness of fingers, links and mounts (sim/scenes/gripped.py)


class OwnDynamics:
    """The simulation's drive of a finger, alone except for an optional obstacle."""

    def __init__(self, obstacle: Obstacle | None = None, position_ticks: float = 400.0) -> None:
        from evetac_cli.sim.gripper import Drive, start, step

        self._drive: Drive = Drive()
        touch_ticks = obstacle.at_ticks if obstacle else self._drive.open_ticks
        self._curve = _curve(obstacle, self._drive)
        self._state: DriveState = start(self._drive, self._curve, touch_ticks, position_ticks - touch_ticks)
        # At rest without current nothing moves, but the first step compiles, which must not happen in real time.
        step(self._state, self._drive, self._curve, "current", 0.0, STEP_S)
        self._now_s = math.nan
        self._goals: Goals | None = None

    def advance(self, goals: Goals, now_s: float) -> ServoMotion:
        """Advance in steps of 1 ms until now; a remainder is kept for the next call."""
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

    The servo passes its goals (`advance`) and the world reads them (`goals`). The world publishes the gripper's motion
    (`show`) and the servo reads it. The process that creates the block without a path owns it; others attach to its
    path until the owner closes it. Pickling gives an attached copy. `time` is the time of that world.

    On Linux the block is a file without a name, reached through its owner's folder in /proc. It disappears with the
    last process that has it open, however those processes end.
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
        """For the servo: pass on its goals; return the motion that the world published last."""
        if goals != self._passed_on:
            self._goals.write(*goals)
            self._passed_on = goals
        shown = self._motion.read()
        if shown is None:
            return ServoMotion()
        current_ma, position_ticks, velocity = shown[1]
        return ServoMotion(current_ma, int(position_ticks), velocity)

    def goals(self) -> Goals:
        """For the world: return the servo's goals; without torque as long as there is no servo."""
        row = self._goals.read()
        if row is None:
            return Goals()
        torque, *rest = row[1]
        return Goals(bool(torque), *(int(value) for value in rest))

    def show(self, motion: ServoMotion) -> None:
        """For the world: publish the gripper's motion."""
        self._motion.write(*motion)

    def close(self) -> None:
        """Release the memory, and end it if it was created here; a second call does nothing."""
        if not self._memory.closed:
            self._memory.close()
            os.close(self._handle)
            if self._owner:
                self.remove()

    def remove(self) -> None:
        """Remove the block's file name, if it has one; the block lasts as long as a process has it open."""
        if sys.platform != "linux":
            self.path.unlink(missing_ok=True)
