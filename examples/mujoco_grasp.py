"""Lift objects by feel in MuJoCo with evetac's touch sensor, slip detector and grip laws.

    python examples/mujoco_grasp.py --trials 20 --json grasps.json
    python examples/mujoco_grasp.py --trials 1 --controllers paper --film grasp.gif

MuJoCo moves the hand, the fingers and the object, and computes the contact force. Each millisecond, the force of the
object on one pad goes to `evetac.TouchSensor`, and the sensor's events go to the slip detector. Every second
millisecond, a grip law sets the goal of the gripper. The fingers are driven like evetac's simulated gripper: 2 N for
each tick between goal and encoder, against dry friction.

All results are simulated. Needs the extra `robot`; --film also needs `plot`.
"""

import argparse
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import evetac_cli as evetac
from evetac_cli import resources
from evetac_cli.kernels.grip.control import Control, SlipSignal, make_law, uses_detector
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.kernels.tracking import presets
from evetac_cli.sim.gripper import Drive, gap_m, ticks_at_gap
from evetac_cli.store.files import StageFile
from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector

SLIP_THRESHOLD = 0.3  # the default of `evetac grasp`
FINGER_N_M = 3.6e3  # per finger: 1.8 N/mm of the gap, as in evetac's simulated gripper
AWAY_TICKS = 4  # distance of the fingers from the object at the start
WIDEST_M = gap_m(0.0)
TOUCH_MS, LIFT_MS, HOLD_MS = 1000, 3000, 1000
RISE_M, RISE_M_S, RISES_AT_MS = 0.1, 0.05, 300
LIFTED_M = 0.05

SCENE = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="10" noslip_iterations="3"/>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1"/>
    <body name="hand" pos="0 0 {grip_z}">
      <joint name="rise" type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0.2" mass="2" diaginertia="0.01 0.01 0.01"/>
      {fingers}
    </body>
    <body name="object" pos="0 0 {half_height}">
      <freejoint/>
      <geom name="object" type="{shape}" size="{size}" mass="{mass}" friction="{friction} 0.005 0.0001" priority="1"
            condim="4" solref="0.005 1"/>
    </body>
  </worldbody>
  <equality><joint joint1="right" joint2="left" solref="0.004 1"/></equality>
  <actuator>
    <position name="rise" joint="rise" kp="50000" dampratio="1"/>
    <motor name="left" joint="left"/>
    <motor name="right" joint="right"/>
  </actuator>
</mujoco>
"""
FINGER = """
      <body name="{side}" pos="{x} 0 0">
        <joint name="{side}" type="slide" axis="{closes} 0 0" damping="{damping}" frictionloss="{friction}"/>
        <inertial pos="0 0 0.1" mass="{mass}" diaginertia="0.001 0.001 0.001"/>
        <body name="{side} pad">
          <joint name="{side} bends" type="slide" axis="{closes} 0 0" stiffness="{stiffness}" damping="20"/>
          <geom name="{side} pad" type="box" size="0.002 0.0075 0.01" mass="0.05"/>
        </body>
      </body>"""


@dataclass(frozen=True)
class Thing:
    """An object to lift."""

    shape: str
    width_m: float
    height_m: float
    mass_kg: float
    friction: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Thing":
        """Return an object of random shape, size, mass and friction."""
        shape = str(rng.choice(["box", "cylinder"]))
        width_m, height_m = rng.uniform(0.03, 0.06), rng.uniform(0.08, 0.12)
        return cls(shape, width_m, height_m, rng.uniform(0.05, 0.4), rng.uniform(0.5, 1.0))

    @property
    def object(self) -> dict[str, Any]:
        """Describe the object as `TouchSensor` expects it."""
        shape = "flat" if self.shape == "box" else "cylinder"
        return {"shape": shape, "width_mm": self.width_m * 1e3, "static_friction": self.friction}


class Gripper:
    """The MuJoCo model of a hand, two fingers and an object."""

    def __init__(self, thing: Thing, drive: Drive) -> None:
        self.drive = drive
        self.touch_ticks = ticks_at_gap(thing.width_m)
        self._open_m = gap_m(self.touch_ticks - AWAY_TICKS)
        half = thing.width_m / 2
        size = f"{half} 0.02 {thing.height_m / 2}" if thing.shape == "box" else f"{half} {thing.height_m / 2}"
        fingers = "".join(
            FINGER.format(
                side=side,
                x=-closes * (self._open_m / 2 + 0.002),
                closes=closes,
                damping=drive.damping_n_s_m,
                friction=drive.friction_n,
                mass=drive.mass_kg,
                stiffness=FINGER_N_M,
            )
            for side, closes in (("left", 1), ("right", -1))
        )
        placed = {"grip_z": 0.5 * thing.height_m, "half_height": thing.height_m / 2}
        shaped = {"shape": thing.shape, "size": size, "mass": thing.mass_kg, "friction": thing.friction}
        self.model = mujoco.MjModel.from_xml_string(SCENE.format(fingers=fingers, **placed, **shaped))
        self.data = mujoco.MjData(self.model)
        self._pad = self.model.geom("right pad").id
        self._object = self.model.geom("object").id
        self._bottom_m = thing.height_m / 2

    @property
    def position_ticks(self) -> int:
        """Return the encoder reading."""
        closed_m = self.data.joint("left").qpos[0] + self.data.joint("right").qpos[0]
        return math.floor(ticks_at_gap(min(max(self._open_m - closed_m, 0.0), WIDEST_M)))

    @property
    def lifted_m(self) -> float:
        """Return the height of the object's bottom above the table."""
        return float(self.data.body("object").xpos[2]) - self._bottom_m

    def step(self, goal_ticks: int, height_m: float) -> tuple[float, tuple[float, float]]:
        """Simulate 1 ms; return the object's force on the right pad, in N: normal, and shear along the image's x and y.

        The finger looks along -X of the world. The image's x axis points down, its y axis along -Y.
        """
        drive = self.drive
        current_ma = drive.gain_ma_tick * (goal_ticks - self.position_ticks)
        limited_ma = min(max(current_ma, -drive.current_limit_ma), drive.current_limit_ma)
        self.data.ctrl[:] = height_m, *[drive.force_per_current_n_ma * limited_ma] * 2
        mujoco.mj_step(self.model, self.data)
        on_pad, wrench = np.zeros(3), np.zeros(6)
        for number in range(self.data.ncon):
            contact = self.data.contact[number]
            if set(contact.geom.tolist()) == {self._pad, self._object}:
                mujoco.mj_contactForce(self.model, self.data, number, wrench)
                force = contact.frame.reshape(3, 3).T @ wrench[:3]  # the force on the second geom of the contact
                on_pad += force if contact.geom[1] == self._pad else -force
        return max(float(on_pad[0]), 0.0), (-float(on_pad[2]), -float(on_pad[1]))


def hand_height_m(now_ms: int) -> float:
    """Return the height that the hand should have: at rest, then rising at a constant speed."""
    return min(max((now_ms - TOUCH_MS - RISES_AT_MS) * 1e-3 * RISE_M_S, 0.0), RISE_M)


def phase_at(now_ms: int) -> GraspPhase:
    """Return the phase of the grasp that is passed to the grip law."""
    if now_ms < TOUCH_MS:
        return GraspPhase.CONTACT
    return GraspPhase.LIFT if now_ms < TOUCH_MS + LIFT_MS else GraspPhase.BALANCE


def detector_for(sensor: evetac.TouchSensor) -> OnlineSlipDetector:
    """Return the pretrained slip detector for a sensor."""
    constants = presets.PRESETS["stable"].for_dots(sensor.dot_radius_px)
    with StageFile(resources.MODEL, "model") as model:
        gel = sensor.dot_xy_px, sensor.window_px, constants, sensor.sensitivity
        detector = OnlineSlipDetector.start(model, *gel)
    detector.threshold = SLIP_THRESHOLD
    return detector


def grasp(seed: int, controller: str, film: "Film | None" = None) -> dict[str, Any]:
    """Run one trial and return its results."""
    rng = np.random.default_rng(seed)
    thing = Thing.drawn(rng)
    gripper = Gripper(thing, Drive())
    sensor = evetac.TouchSensor(object=thing.object, rng=rng)
    control = Control(make_law(controller))
    detector = detector_for(sensor) if uses_detector(control.law) else None
    goal, normal_n, began = gripper.position_ticks, 0.0, time.process_time()
    steps = TOUCH_MS + LIFT_MS + HOLD_MS
    for now_ms in range(steps):
        normal_n, shear_n = gripper.step(goal, hand_height_m(now_ms))
        touch = sensor.step(1e-3, normal_n=normal_n, shear_n=shear_n if normal_n > 0.0 else (0.0, 0.0))
        signal = SlipSignal()
        if detector is not None:
            detector.step(touch.slices[0])
            signal = detector.signal
        if now_ms % 2 == 0:
            goal = control.step(phase_at(now_ms), signal, gripper.position_ticks)
        if film is not None:
            film.see(now_ms, gripper, thing, touch, normal_n, signal.probability)
    return {
        "seed": seed,
        "controller": controller,
        "shape": thing.shape,
        "mass_g": thing.mass_kg * 1e3,
        "friction": thing.friction,
        "lifted": gripper.lifted_m > LIFTED_M,
        "grip_n": normal_n,
        "steps_per_cpu_s": steps / (time.process_time() - began),
        "simulated": True,
    }


class Film:
    """Draws the gripper from the side and the events of one finger, as a GIF."""

    EVERY_MS, SIZE, SCALE = 80, (480, 240), 900.0  # pixels per metre

    def __init__(self) -> None:
        from PIL import Image

        self._image = Image
        self._frames: list[Any] = []
        self._events: list[evetac.Events] = []

    def see(
        self, now_ms: int, gripper: Gripper, thing: Thing, touch: evetac.Touch, normal_n: float, probability: float
    ) -> None:
        """Add one millisecond; draw a frame when one is due."""
        self._events += touch.slices
        if (now_ms + 1) % self.EVERY_MS:
            return
        from PIL import ImageDraw

        picture = self._image.new("RGB", self.SIZE, "white")
        draw = ImageDraw.Draw(picture)

        def box(middle: Any, half: tuple[float, float], colour: str) -> None:
            x, z = 120 + middle[0] * self.SCALE, 225 - middle[2] * self.SCALE
            reach = half[0] * self.SCALE, half[1] * self.SCALE
            draw.rectangle((x - reach[0], z - reach[1], x + reach[0], z + reach[1]), fill=colour)

        draw.rectangle((0, 225, 240, 240), fill="#998877")
        data = gripper.data
        box(data.body("object").xpos, (thing.width_m / 2, thing.height_m / 2), "#4477aa")
        for side in ("left", "right"):
            at = data.geom(f"{side} pad").xpos
            box(at + np.array([0.005 if side == "right" else -0.005, 0.0, 0.03]), (0.003, 0.04), "#555555")
            box(at, (0.002, 0.01), "#ee6677")
        seen = np.full((480, 640), 128, np.uint8)
        for events in self._events:
            seen[events.y, events.x] = 255 * events.p
        self._events = []
        blocks = seen[:, :639].reshape(160, 3, 213, 3)  # keep the pixel of each block that differs most from grey
        small = np.where(blocks.max(axis=(1, 3)) > 128, blocks.max(axis=(1, 3)), blocks.min(axis=(1, 3)))
        picture.paste(self._image.fromarray(small).convert("RGB"), (256, 60))
        for x, y in touch.dot_xy_px / 3 + np.array([256, 60]):
            draw.ellipse((x - 5, y - 5, x + 5, y + 5), outline="#225588")
        said = [f"{(now_ms + 1) * 1e-3:4.2f} s, simulated", f"grip {normal_n:4.1f} N"]
        said += [] if math.isnan(probability) else [f"slip {probability:4.2f}"]
        for line, text in enumerate(said):
            draw.text((250, 4 + 14 * line), text, fill="black")
        self._frames.append(picture.convert("P", palette=self._image.Palette.ADAPTIVE, colors=16))

    def write(self, path: Path) -> None:
        """Write all frames."""
        first, *rest = self._frames
        first.save(path, save_all=True, append_images=rest, duration=self.EVERY_MS, loop=0, optimize=True)


def main() -> None:
    """Run trials with each controller and print how many objects were lifted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seed", type=int, default=22_000, help="seed of the first trial; each trial adds one")
    parser.add_argument("--controllers", nargs="+", default=["load-proportional", "paper", "none"])
    parser.add_argument("--json", type=Path, help="file for all trials")
    parser.add_argument("--film", type=Path, help="GIF of the first trial with the first controller")
    chosen = parser.parse_args()
    rows = []
    for controller in chosen.controllers:
        film = Film() if chosen.film and controller == chosen.controllers[0] else None
        for number in range(chosen.trials):
            row = grasp(chosen.seed + number, controller, film if number == 0 else None)
            rows.append(row)
        if film is not None:
            film.write(chosen.film)
        of_one = [row for row in rows if row["controller"] == controller]
        lifted = sum(row["lifted"] for row in of_one)
        grips = [row["grip_n"] for row in of_one if row["lifted"]]
        speed = np.median([row["steps_per_cpu_s"] for row in of_one])
        print(
            f"simulated, {controller}: lifted {lifted} of {len(of_one)},"
            f" grip at the end {np.median(grips) if grips else math.nan:.1f} N (median),"
            f" {speed:,.0f} steps of 1 ms per CPU second"
        )
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
