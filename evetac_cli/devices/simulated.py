"""Camera, gripper and clock of a simulated world: reading a slice is what makes its time pass."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evetac_cli.devices import GripperReading, Rig
from evetac_cli.events import SLICE_US, Events
from evetac_cli.sim.scenes.gripped import GraspSimulation
from evetac_cli.sim.scenes.pressing import Pressing
from evetac_cli.sim.scenes.rubbing import Rubbing
from evetac_cli.sim.scenes.vibrating import Vibration

DRIVEN = {"press": Pressing, "rub": Rubbing, "tone": Vibration}  # kinds of scene without a gripper


class SimulatedCamera:
    """A camera that looks at a world, and the clock of that world."""

    counted: Mapping[str, int] = MappingProxyType({})

    def __init__(self, world: GraspSimulation | Pressing | Vibration, name: str, sensor_row: Mapping[str, Any]) -> None:
        self._world: GraspSimulation | Pressing | Vibration | None = world
        self._now_us = 0
        self.sensor: Mapping[str, Any] = {
            "sensor/frame_px": np.array(sensor_row["frame_px"], np.int32),
            "sensor/name": name,
            "sensor/dot_xy_px": world.gel_camera.grid_xy_px,
            "sensor/dot_radius_px": np.float64(sensor_row["dot_radius_px"]),
        }
        if world.gel_camera.window_px is not None:
            self.sensor = {**self.sensor, "sensor/window_px": np.array(world.gel_camera.window_px, np.int32)}

    def read(self) -> Events | None:
        """Advance the world by 1 ms and return what the camera saw; None once the scene has ended."""
        if self._world is None or self._world.finished:
            return None
        self._now_us += SLICE_US
        return self._world.step()

    def now_us(self) -> int:
        """End of the slice that was read last."""
        return self._now_us

    def close(self) -> None:
        """End the simulation."""
        self._world = None


class SimulatedGripper:
    """A gripper in a world; as on the real one, a command holds until the next."""

    counted: Mapping[str, int] = MappingProxyType({})

    def __init__(self, world: GraspSimulation) -> None:
        self.world = world

    def read(self) -> GripperReading:
        """Current of the motor and position of the encoder, which is a whole number."""
        finger = self.world.finger
        return GripperReading(finger.current_ma, finger.position_ticks)

    def write_current(self, current_ma: int) -> None:
        """Command a current, from the next slice on."""
        self.world.command = ("current", current_ma)

    def write_position(self, goal_ticks: int) -> None:
        """Command a position, from the next slice on."""
        self.world.command = ("position", goal_ticks)

    def close(self) -> None:
        """Command no current."""
        self.world.command = ("current", 0)


def rig(plan: Mapping[str, Any], seeds: np.random.SeedSequence, **durations: float) -> Rig:
    """Build the devices of a simulated trial; each part draws from a stream of its own."""
    mechanics, optics = (np.random.default_rng(seed) for seed in seeds.spawn(2))
    named = plan["sensor"], plan["sensor_row"]
    driven = DRIVEN.get(plan["scene"]["kind"])
    if driven is not None:
        trial = driven(plan, mechanics, optics)
        camera = SimulatedCamera(trial, *named)
        return Rig(camera, None, camera, trial.truth, drawn=trial.drawn.as_json())
    world = GraspSimulation(plan, mechanics, optics, **durations)
    camera = SimulatedCamera(world, *named)
    return Rig(camera, SimulatedGripper(world), camera, world.truth, world.holding_ma(), world.drawn.as_json())
