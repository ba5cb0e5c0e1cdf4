"""Trials of many motions without a camera: true dots and the true share that slips, for a sticking share's network.

Only the mechanics are simulated, some five simulated seconds a second; what a tracker makes of true dots is drawn. A
motion of an object and a seed is always the same trial. Objects and motions that are trained on, chosen by and judged
on differ.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags, Floats, Singles
from evetac_cli.devices import Rig
from evetac_cli.devices.simulated import rig
from evetac_cli.events import Events
from evetac_cli.kernels.grip.control import Control, make_law
from evetac_cli.kernels.touch import rest, sticking
from evetac_cli.kernels.touch.dot_modes import DotNoise
from evetac_cli.kernels.touch.sticking import StickingNetwork
from evetac_cli.kernels.touch.touch_map import BEGINS, ENDS
from evetac_cli.sim.camera.gel_camera import GelCamera
from evetac_cli.sim.parts import Timer, untimed
from evetac_cli.sim.scenes.slip_limit import GRAVITY_M_S2
from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.held import FallingWeight, GripperCurrent, HandJerk, HandVibration, Pushes
from evetac_cli.sim.setup.object_file import TouchedObject
from evetac_cli.sim.setup.plan import Plan, first_plan
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.trials.grasp.loop import Timing, grasp_slices
from evetac_cli.trials.record import simulated
from evetac_cli.trials.trial import SimulatedTrial

TRAINED = (1, 3, 5, 6, 8, 9, 11, 13, 15, 16, 18)  # objects of the paper's table: weights are fitted to these,
CHOSEN_BY = (4, 7, 17)  # alarm and deviations to these,
JUDGED = (2, 10, 12, 14, 19, 20)  # and tables are of these
# Motions, and those of them that no weight is fitted to.
MOTIONS = (
    *("slip", "slip-varied", "pushes", "jerks", "lifting", "grip", "handling"),
    *("fast jerks", "data-rate", "weights", "vibration"),
)
UNSEEN = ("fast jerks", "data-rate", "weights", "vibration")
JERKS_MM_S, FAST_JERKS_MM_S = (20.0, 40.0, 80.0), (60.0, 120.0)
# A tracker's error: standard deviations in px, of two errors that drift and come back within DRIFT_S, as in
# kernels/touch/dot_modes.py, and of one from slice to slice.
OWN_PX, COMMON_PX, SLICE_PX, DRIFT_S = 0.05, 0.2, 0.03, 1.0
KNOT_MS = 50
EVETAC = "evetac"
# A grasp closes with so many times the force that just holds the object, at about so much for each tick.
GRASP_FACTORS, N_PER_TICK = (0.9, 3.0), 0.2
LOST_MS, SLID_MS = 100, 200  # a trial ends so long after the object is out of the gripper, and after it slides so long
LOW, HIGH = 0.05, 0.95  # shares that slip: below nothing does to speak of, above all does
AFTER_MS = 50  # for so long after a slip an alarm may last
NOTHING = Events(np.zeros(0, np.int64), np.zeros(0, np.uint16), np.zeros(0, np.uint16), np.zeros(0, np.uint8))


class Trial(NamedTuple):
    """True dots (slices, dots, 2) and at rest (dots, 2) in px, and of each slice what is true of its contact."""

    dot_px: Singles
    rest_px: Floats
    mm_per_px: float
    slip_share: Singles
    slips: Flags  # gross slip
    normal_n: Singles
    shear_n: Singles  # (slices, 2)
    frame_px: tuple[int, int]

    def in_mm(self, px: Floats) -> Floats:
        """Places in px from the middle of the frame, in mm."""
        mm: Floats = (px - np.array(self.frame_px) / 2) * self.mm_per_px
        return mm


class Planned(NamedTuple):
    """A trial's plan; beyond_ticks: how far beyond light contact a grasp closes, in scenes in which one lifts."""

    plan: Plan
    beyond_ticks: int = 0
    lift_s: float = 0.0
    balance_s: float = 0.0


def planned(motion: str, number: int, seed: int, sensor: str = EVETAC, reshaped: bool = False) -> Planned:
    """What a motion is with an object of the paper's table, or a reshaped one; the same for the same seed."""
    rng = np.random.default_rng([seed, number, MOTIONS.index(motion)])
    lifts = motion in ("jerks", "fast jerks", "lifting", "weights")
    name = {"lifting": "lift", "jerks": "lift", "fast jerks": "lift", "weights": "lift"}.get(motion, motion)
    if motion in ("pushes", "grip", "vibration"):
        name = "handling"
    scene = scene_file.load(name)
    plan = first_plan("lift" if lifts else "handling", str(number), sensor)
    touched = plan.touched
    assert touched is not None
    if reshaped:
        touched = _reshaped(touched, rng)
        plan = replace(plan, touched=touched)
    weight_n = touched.mass_g * 1e-3 * GRAVITY_M_S2
    if motion in CHANGES:
        scene = CHANGES[motion](scene, rng, weight_n)
    if sensor != EVETAC:
        scene = replace(scene, gel=replace(scene.gel, cut=bool(rng.random() < 0.5)))
    plan = replace(plan, scene=scene)
    if not lifts:
        return Planned(plan)
    holds_n = 0.5 * weight_n / touched.static_friction
    beyond_ticks = 1 + math.ceil(float(rng.uniform(*GRASP_FACTORS)) * holds_n / N_PER_TICK)
    lift_s, balance_s = (4.0, 2.0) if motion == "lifting" else (3.0, 3.0)
    return Planned(plan, beyond_ticks, lift_s, balance_s)


def _reshaped(touched: TouchedObject, rng: np.random.Generator) -> TouchedObject:
    """An object of another shape, width, weight and friction, so that weights are fitted to more than a table."""
    width_mm = float(np.exp(rng.uniform(np.log(10.0), np.log(100.0))))
    mass_g = float(np.clip(touched.mass_g * np.exp(rng.uniform(np.log(0.5), np.log(2.0))), 30.0, 500.0))
    shape = str(rng.choice(["flat", "cylinder", "cylinder", "sphere"]))
    friction = float(rng.uniform(0.5, 1.0))
    return replace(
        touched, shape=shape, width_mm=width_mm, grasped_width_mm=None, mass_g=mass_g, static_friction=friction
    )


def _either_way(scene: Scene, rng: np.random.Generator) -> Scene:
    """The scene as it is, or grasped from the side."""
    return replace(scene, gel=replace(scene.gel, sideways=bool(rng.random() < 0.5)))


def _pushes(scene: Scene, rng: np.random.Generator, weight_n: float) -> Scene:
    """Pushes up and down, of one length a trial, of up to somewhat more than what the grip can bear."""
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
    """A current that rises and falls at random, and now and then stays."""
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


def _vibration(scene: Scene, rng: np.random.Generator, weight_n: float) -> Scene:
    """A robot that shakes the gripper."""
    vibration = HandVibration(
        frequency_hz=tuple(rng.uniform(8.0, 45.0, 2).tolist()),
        acceleration_m_s2=tuple(rng.uniform(0.1, 0.8, 2).tolist()),
    )
    grip = replace(scene.gripper, ramp_s=7.0)
    return _either_way(replace(scene, gripper=grip, push=None, hand=replace(scene.hand, vibration=vibration)), rng)


def _lifting(scene: Scene, rng: np.random.Generator, weight_n: float) -> Scene:
    """A hand that rises slowly or fast, with one of the profiles."""
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
    """A lift and a knock against the arm."""
    scene = _lifting(scene, rng, weight_n)
    jerk = HandJerk(
        at_s=float(rng.uniform(3.0, 6.0)),
        speed_mm_s=float(rng.choice(speeds_mm_s)) * float(rng.choice([-1.0, 1.0])),
        lasts_s=float(np.exp(rng.uniform(np.log(0.03), np.log(0.2)))),
    )
    return replace(scene, hand=replace(scene.hand, jerk=jerk))


def _weights(scene: Scene, rng: np.random.Generator, weight_n: float) -> Scene:
    """A lift and a weight that falls on the object and stays."""
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
}


def without_camera(part: str, call: Any) -> Any:
    """In place of the camera, something that says where dots are and sees nothing; a `Timer`."""
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
    """Devices and slices of a planned trial; whoever asks closes the devices."""
    one = SimulatedTrial((), Path(), number, seed, trial.plan)
    if trial.plan.scene.kind != "lift":
        return simulated.play(one, timer)
    devices = rig(trial.plan, one.seeds(), timer, lift_s=trial.lift_s, balance_s=trial.balance_s)
    law = f"fixed:{trial.beyond_ticks}"
    timing = Timing(*(round(1000 * s) for s in (trial.plan.scene.time.touch_s, trial.lift_s, trial.balance_s)))
    return devices, grasp_slices(devices, None, Control(make_law(law), timing.control_hz, law), timing)


def played(trial: Planned, seed: int, see: Callable[[Floats, Events], None] | None = None) -> Trial:
    """A trial until the object is lost or the scene ends.

    see: gets the dots at rest (dots, 2) in px, and what a camera sees in each slice; without it there is no camera.
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
                see(rest_px, events)
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
        (frame[0], frame[1]),
    )


def tracked_px(trial: Trial, rng: np.random.Generator) -> Floats:
    """The dots as a tracker has them: with an error of each dot and one that all share, both of which drift."""
    slices, dots = trial.dot_px.shape[:2]
    knots = slices // KNOT_MS + 2
    keeps = math.exp(-KNOT_MS * 1e-3 / DRIFT_S)
    drift = rng.normal(size=(knots, dots, 2)) * OWN_PX
    common = rng.normal(size=(knots, 1, 2)) * COMMON_PX
    both = drift + common
    both[0] = 0.0  # a tracker starts on dots at rest
    for knot in range(1, knots):
        both[knot] = keeps * both[knot - 1] + math.sqrt(1 - keeps**2) * both[knot]
    at = np.arange(slices) / KNOT_MS
    before = at.astype(int)
    part = (at - before)[:, None, None]
    error = (1 - part) * both[before] + part * both[before + 1]
    seen: Floats = trial.dot_px + error + rng.normal(size=error.shape) * SLICE_PX
    return seen


def kept(folder: Path, motion: str, number: int, seed: int, sensor: str = EVETAC, reshaped: bool = False) -> Trial:
    """A trial from its file in a folder, where it is made first if it is not there."""
    name = (motion.replace(" ", "-"), number, seed, sensor.replace(":", "_"), *["reshaped"] * reshaped)
    path = folder / f"{'-'.join(map(str, name))}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        made = played(planned(motion, number, seed, sensor, reshaped), seed)
        part = path.with_suffix(".part.npz")
        np.savez(part, **made._asdict())
        part.rename(path)
        return made
    with np.load(path, allow_pickle=False) as held:
        values = {name: held[name] for name in Trial._fields}
    frame = values.pop("frame_px").tolist()
    return Trial(**{**values, "mm_per_px": float(values["mm_per_px"])}, frame_px=(frame[0], frame[1]))


def recent_largest(values: Singles, slices: int) -> Singles:
    """The largest of each slice and so many before it."""
    padded = np.concatenate([np.zeros(slices, values.dtype), values])
    largest: Singles = np.lib.stride_tricks.sliding_window_view(padded, slices + 1).max(axis=1)
    return largest


def touched(dot_mm: Floats, rest_mm: Floats) -> Flags:
    """In which slices something touches, by the rule of a touch map."""
    moved = dot_mm - rest_mm
    apart = moved - moved.mean(axis=1, keepdims=True)
    over_own = np.sqrt(np.mean(apart**2, axis=(1, 2))) / DotNoise().own_mm
    touches = np.zeros(len(dot_mm), np.bool_)
    now = False
    for number, value in enumerate(over_own.tolist()):
        now = value > (ENDS if now else BEGINS)
        touches[number] = now
    return touches


class Looks(NamedTuple):
    """What a network is given and tells at each look of a trial while something touches.

    slices: of the looks; inputs: (looks, INPUTS); told: the share that slips, with its sd; begun: how probably slip has
    begun; fields_mm: displacements of dots at the reference and now (looks, 2, dots, 2).
    """

    slices: NDArray[np.int64]
    inputs: Singles
    told: Singles
    begun: Singles
    sd: Singles
    direction_rad: Singles
    alarm: Flags
    fields_mm: Singles


def looks_of(trial: Trial, rng: np.random.Generator, network: StickingNetwork, missing: float = 0.0) -> Looks:
    """What a network tells of a trial as a tracker sees it, of whose dots a share is missing throughout."""
    return looks_at(trial, tracked_px(trial, rng), rng.random(len(trial.rest_px)) < missing, network)


def looks_at(trial: Trial, dot_px: Floats, lost: Flags, network: StickingNetwork) -> Looks:
    """What a network tells of tracked dots (slices, dots, 2), of which some (dots,) are lost throughout."""
    dot_mm, rest_mm = trial.in_mm(dot_px), trial.in_mm(trial.rest_px)
    state = sticking.start(rest_mm, network)
    touches = touched(dot_mm[:, ~lost], rest_mm[~lost])
    kept: list[tuple[Any, ...]] = []
    for number, at_mm in enumerate(dot_mm):
        reading = sticking.step(state, at_mm, lost, bool(touches[number]))
        if touches[number] and state.rest.slices % rest.BLOCK_MS == 0:
            fields = np.stack([state.reference_mm - rest_mm, state.rest.block_mm - rest_mm])
            told = 1.0 - reading.sticking_share
            kept.append((number, state.inputs.copy(), told, state.has_begun, *reading[1:3], reading.alarm, fields))
    columns = list(zip(*kept, strict=True)) or [()] * len(Looks._fields)
    shapes = ((-1,), (-1, sticking.INPUTS), (-1,), (-1,), (-1,), (-1,), (-1,), (-1, 2, *rest_mm.shape))
    kinds = (np.int64, *[np.float32] * 5, np.bool_, np.float32)
    made = (np.array(c, k).reshape(s) for c, k, s in zip(columns, kinds, shapes, strict=True))
    return Looks(*made)
