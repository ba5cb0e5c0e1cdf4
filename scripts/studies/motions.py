"""Simulate trials of many motions in memory: what a hand, a gripper and pushes do to an object of the paper's table.

Motion, object and seed determine a trial. Without a camera only the mechanics are simulated, at about five times real
time. Training, choosing and evaluation use different objects and motions.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Floats, Singles
from evetac_cli.devices import Rig
from evetac_cli.devices.simulated import rig
from evetac_cli.events import Events
from evetac_cli.kernels.grip.control import Control, make_law
from evetac_cli.sim import gripper
from evetac_cli.sim.camera.gel_camera import GelCamera
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2
from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.held import FallingWeight, GripperCurrent, HandJerk, HandVibration, Pushes
from evetac_cli.sim.setup.object_file import TouchedObject
from evetac_cli.sim.setup.parts import Timer, untimed
from evetac_cli.sim.setup.plan import Plan, first_plan
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.trials.grasp.loop import Timing, grasp_slices
from evetac_cli.trials.record import simulated
from evetac_cli.trials.trial import SimulatedTrial

TRAINED = (1, 3, 5, 6, 8, 9, 11, 13, 15, 16, 18)  # objects of the paper's table: weights are fitted to these,
CHOSEN_BY = (4, 7, 17)  # alarm and standard deviations to these,
JUDGED = (2, 10, 12, 14, 19, 20)  # and tables are made of these
# The random numbers of a trial depend on the index of its motion in this list: append new motions.
MOTIONS = (
    *("slip", "slip-varied", "pushes", "jerks", "lifting", "grip", "handling"),
    *("fast jerks", "data-rate", "weights", "vibration", "slip-speeds", "opening", "light touch"),
    "weak lifts",
)
JERKS_MM_S, FAST_JERKS_MM_S = (20.0, 40.0, 80.0), (60.0, 120.0)
EVETAC = "evetac"
# A grasp closes to this multiple of the force that just holds the object, with about this force per tick.
GRASP_FACTORS, N_PER_TICK = (0.9, 3.0), 0.2
WEAK_FACTORS = (0.0, 0.9)  # the same, for grasps too weak to lift the object
LIGHT_TICKS = 2  # limit of closing after first contact, in a light touch
# Fingers that open without slip: the forces to which they close and open, as multiples of the force that just holds,
# and the duration.
FIRM_FACTORS, LOOSE_FACTORS, OPENING_S = (5.0, 20.0), (2.2, 4.0), (0.04, 1.5)
LOST_MS, SLID_MS = 100, 200  # a trial ends this long after the object is lost, or slides
NOTHING = Events(np.zeros(0, np.int64), np.zeros(0, np.uint16), np.zeros(0, np.uint16), np.zeros(0, np.uint8))


class Trial(NamedTuple):
    """True dots (slices, dots, 2) and dots at rest (dots, 2) in px, and the true state of the contact in each slice."""

    dot_px: Singles
    rest_px: Floats
    mm_per_px: float
    slip_share: Singles
    slips: Flags  # gross slip
    normal_n: Singles
    shear_n: Singles  # (slices, 2)
    closing_ticks: Singles  # by how much the fingers have closed
    frame_px: tuple[int, int]

    def in_mm(self, px: Floats) -> Floats:
        """Convert positions in px from the middle of the frame to mm."""
        mm: Floats = (px - np.array(self.frame_px) / 2) * self.mm_per_px
        return mm


See = Callable[[Mapping[str, Any], Events, Mapping[str, Any]], None]


class Planned(NamedTuple):
    """The plan of a trial; beyond_ticks: how far beyond light contact a grasp closes, in scenes with a lift."""

    plan: Plan
    beyond_ticks: int = 0
    lift_s: float = 0.0
    balance_s: float = 0.0


def planned(
    motion: str,
    number: int,
    seed: int,
    sensor: str = EVETAC,
    reshaped: bool = False,
    object: TouchedObject | None = None,
) -> Planned:
    """Return the plan of a motion with an object of the paper's table, a reshaped one or another, by seed."""
    rng = np.random.default_rng([seed, number, MOTIONS.index(motion)])
    lifts = motion in ("jerks", "fast jerks", "lifting", "weights", "light touch", "weak lifts")
    name = "lift" if lifts else motion
    if motion in ("pushes", "grip", "vibration", "opening"):
        name = "handling"
    scene = scene_file.load(name)
    plan = first_plan("lift" if lifts else "handling", str(number), sensor)
    object = object or plan.object
    assert object is not None
    plan = replace(plan, object=object)
    if reshaped:
        object = another_object(object, rng)
        plan = replace(plan, object=object)
    weight_n = object.mass_g * 1e-3 * GRAVITY_M_S2
    if motion == "opening":
        drive = gripper.make_drive(plan.sensor.gripper)
        scene = _opening(scene, rng, 0.5 * weight_n / object.static_friction, drive)
    elif motion in CHANGES:
        scene = CHANGES[motion](scene, rng, weight_n)
    if sensor != EVETAC:
        scene = replace(scene, gel=replace(scene.gel, cut=bool(rng.random() < 0.5)))
    plan = replace(plan, scene=scene)
    if not lifts:
        return Planned(plan)
    if motion == "light touch":
        return Planned(plan, 1 + int(rng.integers(LIGHT_TICKS)), 4.0, 1.0)
    holds_n = 0.5 * weight_n / object.static_friction
    if motion == "weak lifts":
        return Planned(plan, max(int(float(rng.uniform(*WEAK_FACTORS)) * holds_n / N_PER_TICK), 1), 2.0, 1.0)
    beyond_ticks = 1 + math.ceil(float(rng.uniform(*GRASP_FACTORS)) * holds_n / N_PER_TICK)
    lift_s, balance_s = (4.0, 2.0) if motion == "lifting" else (3.0, 3.0)
    return Planned(plan, beyond_ticks, lift_s, balance_s)


def another_object(object: TouchedObject, rng: np.random.Generator) -> TouchedObject:
    """Return an object of another shape, width, weight and friction, for more variety than the table has."""
    width_mm = float(np.exp(rng.uniform(np.log(10.0), np.log(100.0))))
    mass_g = float(np.clip(object.mass_g * np.exp(rng.uniform(np.log(0.5), np.log(2.0))), 30.0, 500.0))
    shape = str(rng.choice(["flat", "cylinder", "cylinder", "sphere"]))
    friction = float(rng.uniform(0.5, 1.0))
    return replace(
        object, shape=shape, width_mm=width_mm, grasped_width_mm=None, mass_g=mass_g, static_friction=friction
    )


def _either_way(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return the scene as it is, or with the object grasped from the side."""
    return replace(scene, gel=replace(scene.gel, sideways=bool(rng.random() < 0.5)))


def _pushes(scene: Scene, rng: np.random.Generator, weight_n: float) -> Scene:
    """Return pushes up and down of one length per trial, up to somewhat more than the grip can bear."""
    lasts_s = float(np.exp(rng.uniform(np.log(0.03), np.log(0.4))))
    at_s, now_s = [], 1.8
    while now_s < 5.0:
        at_s.append(now_s)
        now_s += lasts_s + float(rng.uniform(0.1, 1.0))
    factor, more_n = float(rng.uniform(1.3, 3.0)), float(rng.uniform(0.0, 2.0))
    bears_n = (factor - 1) * weight_n + more_n
    force_n = bears_n * rng.uniform(0.05, 1.05, len(at_s)) * np.where(rng.random(len(at_s)) < 0.25, -1.0, 1.0)
    grip = replace(scene.gripper, start_factor=(factor, factor), start_more_n=more_n, ramp_s=5.5)
    push = Pushes(at_s=tuple(at_s), lasts_s=lasts_s, force_n=tuple(force_n.tolist()))
    return _either_way(replace(scene, gripper=grip, push=push), rng)


def _grip(scene: Scene, rng: np.random.Generator, weight_n: float) -> Scene:
    """Return a current that rises and falls at random, with occasional pauses."""
    at_s, ma = [0.0, 0.3, 0.8, 1.4], [0.0, 0.0, 60.0, 60.0]
    while at_s[-1] < 8.0:
        at_s.append(at_s[-1] + float(rng.uniform(0.2, 1.5)))
        ma.append(
            ma[-1]
            if rng.random() < 0.3
            else float(rng.uniform(-12.0, 20.0) if rng.random() < 0.4 else rng.uniform(5.0, 60.0))
        )
    course = GripperCurrent(at_s=tuple(at_s), ma=tuple(ma))
    grip = replace(scene.gripper, current=course)
    return _either_way(replace(scene, gripper=grip, push=None), rng)


def _opening(scene: Scene, rng: np.random.Generator, holds_n: float, drive: gripper.Drive) -> Scene:
    """Return fingers that grip firmly, and open and close without slip; holds_n: force that just holds the object."""

    def rising_ma(force_n: float) -> float:
        return gripper.closing_push_n(drive, force_n) / drive.force_per_current_n_ma

    def falling_ma(force_n: float) -> float:
        return gripper.opening_push_n(drive, force_n, rests=True) / drive.force_per_current_n_ma

    firm_ma = rising_ma(holds_n * float(rng.uniform(*FIRM_FACTORS)))
    at_s, ma = [0.0, 0.3, 1.2, 1.8], [0.0, 0.0, firm_ma, firm_ma]
    while at_s[-1] < 7.0:
        loose_ma = falling_ma(holds_n * float(rng.uniform(*LOOSE_FACTORS)))
        takes_s = float(np.exp(rng.uniform(*np.log(OPENING_S))))
        rests_s = float(rng.uniform(0.1, 0.6))
        at_s += [at_s[-1] + takes_s, at_s[-1] + takes_s + rests_s]
        ma += [loose_ma, loose_ma]
        firm_ma = rising_ma(holds_n * float(rng.uniform(*FIRM_FACTORS)))
        at_s += [at_s[-1] + 0.5, at_s[-1] + 0.5 + rests_s]
        ma += [firm_ma, firm_ma]
    grip = replace(scene.gripper, current=GripperCurrent(at_s=tuple(at_s), ma=tuple(ma)))
    return _either_way(replace(scene, gripper=grip, push=None), rng)


def _light_touch(scene: Scene, rng: np.random.Generator, weight_n: float) -> Scene:
    """Return fingers that touch an object on its table, close slightly and stay; the hand does not rise."""
    time = replace(scene.time, touch_s=1.5, before_rise_s=600.0)
    return _either_way(replace(scene, time=time), rng)


def _vibration(scene: Scene, rng: np.random.Generator, weight_n: float) -> Scene:
    """Return a robot that shakes the gripper."""
    vibration = HandVibration(
        frequency_hz=tuple(rng.uniform(8.0, 45.0, 2).tolist()),
        acceleration_m_s2=tuple(rng.uniform(0.1, 0.8, 2).tolist()),
    )
    grip = replace(scene.gripper, ramp_s=7.0)
    return _either_way(replace(scene, gripper=grip, push=None, hand=replace(scene.hand, vibration=vibration)), rng)


def _lifting(scene: Scene, rng: np.random.Generator, weight_n: float) -> Scene:
    """Return a hand that rises slowly or fast, with one of the profiles."""
    scene = replace(scene, time=replace(scene.time, touch_s=1.0, before_rise_s=0.5))
    hand = replace(
        scene.hand,
        height_mm=float(rng.uniform(10.0, 60.0)),
        speed_mm_s=float(rng.uniform(10.0, 60.0)),
        acceleration_mm_s2=float(np.exp(rng.uniform(np.log(60.0), np.log(600.0)))),
        profile=str(rng.choice(["trapezoid", "s-curve", "steps"])),
    )
    return _either_way(replace(scene, hand=hand), rng)


def _jerks(
    scene: Scene, rng: np.random.Generator, weight_n: float, speeds_mm_s: tuple[float, ...] = JERKS_MM_S
) -> Scene:
    """Return a lift and a knock against the arm."""
    scene = _lifting(scene, rng, weight_n)
    jerk = HandJerk(
        at_s=float(rng.uniform(3.0, 6.0)),
        speed_mm_s=float(rng.choice(speeds_mm_s)) * float(rng.choice([-1.0, 1.0])),
        lasts_s=float(np.exp(rng.uniform(np.log(0.03), np.log(0.2)))),
    )
    return replace(scene, hand=replace(scene.hand, jerk=jerk))


def _weights(scene: Scene, rng: np.random.Generator, weight_n: float) -> Scene:
    """Return a lift and a weight that falls on the object and stays."""
    drop = FallingWeight(mass_g=float(rng.choice([20.0, 50.0, 100.0])), after_s=1.0, speed_m_s=0.5)
    return replace(_lifting(scene, rng, weight_n), drop=drop)


CHANGES: dict[str, Callable[[Scene, np.random.Generator, float], Scene]] = {
    "pushes": _pushes,
    "grip": _grip,
    "vibration": _vibration,
    "lifting": _lifting,
    "jerks": _jerks,
    "fast jerks": lambda scene, rng, weight_n: _jerks(scene, rng, weight_n, FAST_JERKS_MM_S),
    "weights": _weights,
    "light touch": _light_touch,
    "weak lifts": _lifting,
}


def without_camera(part: str, call: Any) -> Any:
    """A replacement for the camera that has dots but no events; a `Timer`."""
    if part != "camera":
        return call
    camera: GelCamera = call.__self__

    def place(shift_m: Floats, *_: Any, **__: Any) -> Events:
        camera.dot_xy_px = camera.seen_px(shift_m)
        return NOTHING

    return place


def slices_of(
    trial: Planned, number: int, seed: int, timer: Timer
) -> tuple[Rig, Iterator[tuple[Events, dict[str, Any]]]]:
    """Return devices and slices of a planned trial; the caller closes the devices."""
    one = SimulatedTrial((), Path(), number, seed, trial.plan)
    if trial.plan.scene.kind != "lift":
        return simulated.play(one, timer)
    devices = rig(trial.plan, one.seeds(), timer, lift_s=trial.lift_s, balance_s=trial.balance_s)
    law = f"fixed:{trial.beyond_ticks}"
    timing = Timing(*(round(1000 * s) for s in (trial.plan.scene.time.touch_s, trial.lift_s, trial.balance_s)))
    return devices, grasp_slices(devices, None, Control(make_law(law), timing.control_hz, law), timing)


def played(trial: Planned, seed: int, see: See | None = None) -> Trial:
    """Simulate a trial until the object is lost or the scene ends.

    see is called with the datasets of the sensor, the camera's events of a slice, and the other values of the slice.
    Without it there is no camera.
    """
    timer = untimed if see else without_camera
    devices, slices = slices_of(trial, 0, seed, timer)
    rows: list[dict[str, Any]] = []
    lost_for = slid_for = 0
    sensor = devices.camera.sensor
    rest_px = np.asarray(sensor["sensor/dot_xy_px"], np.float64).reshape(-1, 2)
    try:
        for events, row in slices:
            if see is not None:
                see(sensor, events, row)
            rows.append(row)
            slid_for = slid_for + 1 if row["truth/slip"] else 0
            was_held = lost_for > 0 or (slid_for > 0) or (len(rows) > 1 and rows[-2]["truth/normal_force_n"] > 0.0)
            lost_for = lost_for + 1 if was_held and row["truth/normal_force_n"] == 0.0 else 0
            if lost_for > LOST_MS or slid_for > SLID_MS:
                break
    finally:
        devices.close()

    def column(name: str) -> Any:
        return np.array([row[f"truth/{name}"] for row in rows])

    frame = tuple(int(side) for side in sensor["sensor/frame_px"])
    return Trial(
        column("dot_xy_px").astype(np.float32),
        rest_px,
        trial.plan.sensor.mm_per_px,
        column("visible_slip_share").astype(np.float32),
        column("slip").astype(np.bool_),
        column("normal_force_n").astype(np.float32),
        column("shear_force_n").astype(np.float32),
        column("closing_ticks").astype(np.float32),
        (frame[0], frame[1]),
    )
