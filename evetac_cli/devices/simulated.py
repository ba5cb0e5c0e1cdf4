"""Camera, gripper and clock of a simulated scene, whose time passes as slices are read."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from evetac_cli.devices import GripperReading, Rig, SecondCamera
from evetac_cli.events import SLICE_US, Events
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource
from evetac_cli.sim.camera.gel_camera import GelCamera
from evetac_cli.sim.scenes.gripped import GraspSimulation
from evetac_cli.sim.setup.parts import Timer, untimed
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.sensor import Sensor
from evetac_cli.sim.simulation import Simulation, scene_in_words, simulation_of


class SceneCamera:
    """The camera of a simulated scene, and the clock of that scene."""

    counted: Mapping[str, int] = MappingProxyType({})
    notes: tuple[str, ...] = ()
    time: TimeSource = HOST_TIME

    def __init__(self, simulation: Simulation, scene: str, name: str, sensor: Sensor) -> None:
        self._simulation: Simulation | None = simulation
        self._scene = scene
        self._now_us = 0
        self.sensor: Mapping[str, Any] = described(name, sensor, simulation.gel_camera)

    def read(self) -> Events | None:
        """Advance the scene by 1 ms and return the camera's events; None once the scene has ended."""
        if self._simulation is None or self._simulation.finished:
            return None
        self._now_us += SLICE_US
        with scene_in_words(self._scene):
            return self._simulation.step()

    def now_us(self) -> int:
        """Return the end of the slice that was read last."""
        return self._now_us

    def host_us(self, device_us: float) -> float:
        """Return NaN: a scene's time passes as its slices are read."""
        return math.nan

    def close(self) -> None:
        """End the simulation."""
        self._simulation = None


def described(name: str, sensor: Sensor, camera: GelCamera) -> dict[str, Any]:
    """Return the datasets `sensor/...` of a simulated sensor."""
    described = {
        "sensor/frame_px": np.array(sensor.frame_px, np.int32),
        "sensor/name": name,
        "sensor/dot_xy_px": camera.calibrated_grid_xy_px,
        "sensor/dot_radius_px": np.float64(sensor.dot_radius_px),
        **{f"sensor/{key}": np.float64(value) for key, value in sensor.sensitivity().known().items()},
    }
    if camera.window_px is not None:
        described["sensor/window_px"] = np.array(camera.window_px, np.int32)
    return described


class SecondSceneCamera(SceneCamera):
    """The camera of the second finger: its events of the slice that was last read from the first finger's camera."""

    def __init__(self, simulation: GraspSimulation, name: str, sensor: Sensor) -> None:
        super().__init__(simulation, "", name, sensor)
        assert simulation.second_view is not None
        self._second = simulation
        self.sensor = described(name, sensor, simulation.second_view.camera)

    def read(self) -> Events | None:
        """Return the camera's events of the slice that the scene has made; None before the first and after the last."""
        events = None if self._simulation is None else self._second.second_events
        self._now_us += SLICE_US * (events is not None)
        return events


class SimulatedGripper:
    """The gripper of a simulated scene; like the real one, it holds a command until the next."""

    counted: Mapping[str, int] = MappingProxyType({})
    release_words = ""

    def __init__(self, simulation: GraspSimulation) -> None:
        self.simulation = simulation

    def read(self) -> GripperReading:
        """Return the motor's current, and the encoder's position, which is a whole number."""
        finger = self.simulation.finger.state
        return GripperReading(finger.current_ma, finger.position_ticks)

    def write_current(self, current_ma: int) -> None:
        """Command a current, starting with the next slice."""
        self.simulation.finger.command = ("current", current_ma)

    def write_position(self, goal_ticks: int) -> None:
        """Command a position, starting with the next slice."""
        self.simulation.finger.command = ("position", goal_ticks)

    def emergency_open(self) -> None:
        """Release: the object is not real."""
        self.close()

    def close(self) -> None:
        """Command zero current."""
        self.simulation.finger.command = ("current", 0)


def rig(plan: Plan, seeds: np.random.SeedSequence, timer: Timer = untimed, /, **durations: float) -> Rig:
    """Build the devices of a simulated trial; mechanics and optics draw from separate random streams.

    timer: measures the parts of the scene. durations: lift_s and balance_s of a scene in which an object is lifted.
    SceneError if the scene cannot be built.
    """
    simulation = simulation_of(plan, seeds, timer, **durations)
    camera = SceneCamera(simulation, plan.scene.name, plan.sensor_name, plan.sensor)
    second = None
    if plan.second is not None and isinstance(simulation, GraspSimulation):
        second = SecondCamera(SecondSceneCamera(simulation, *plan.second), simulation.second_truth)
    devices = Rig(
        camera,
        None,
        simulation.truth,
        slices=simulation.slices_in_all,
        sampled=json.dumps(asdict(simulation.sampled)),
        second=second,
    )
    if not isinstance(simulation, GraspSimulation):
        return devices
    return replace(
        devices,
        gripper=SimulatedGripper(simulation),
        holding_ma=simulation.finger.holding_ma,
        slips_at_ma=simulation.finger.slips_at_ma,
        fall_factor=simulation.sampled.fall_factor,
    )
