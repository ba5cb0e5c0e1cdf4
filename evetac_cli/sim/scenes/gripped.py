"""Scenes with a gripper: gripper, gel, object and camera of one trial, advanced one slice at a time.

There are three kinds of scene. `ramp`: the object already hangs in a gripper under current control. `lift`: the object
is on a table, the gripper starts just before touch, and a hand lifts the gripper; in the gripper's frame the table
sinks. `hold`: the gripper starts open and closes on an object, which is then released into the grip and pushed.

One of two mirrored pads is simulated, or both if they differ or both have a camera. Gripper, hand and table move in
steps of 1 ms, gel and object in as many steps as they need (gel.adaptive). The camera sees the first pad at the end of
the slice. If the plan has a camera on the second finger, it sees the second pad.

Gravity is along +x of the image in a grasp from the top and +y in a grasp from the side. The shape of an upright object
is rotated accordingly.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.events import FRAME_PX, SLICES_PER_S, Events
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.gel_camera import GelCamera
from evetac_cli.sim.scenes.finger_drive import FingerDrive
from evetac_cli.sim.scenes.gel_view import ALONG, FACING, GelView
from evetac_cli.sim.scenes.held_object import HeldObject
from evetac_cli.sim.scenes.pads import Pads
from evetac_cli.sim.scenes.shared import friction_after
from evetac_cli.sim.setup.object_file import seed_of
from evetac_cli.sim.setup.parts import Timer, untimed
from evetac_cli.sim.setup.plan import SECOND, Plan
from evetac_cli.sim.setup.sampling import SampledTrial, sample_trial

LEAST_FRICTION = 1e-6  # below, the holding force would not be finite
TEXTURE_PX = (1024, 1024)  # size of an object's texture
TEXTURE_SEED = 7919  # with the object's number: an object has the same texture in every trial


class FingerView(GelView):
    """What the camera of one finger sees: its gel, and the object's texture in the window.

    The texture's position is random, and drawn also if it is not shown, so that the gel's events are those of a trial
    with texture. The second finger sees another side of the object.
    """

    def __init__(
        self,
        plan: Plan,
        sampled: SampledTrial,
        pads: Pads,
        rng: np.random.Generator,
        timer: Timer,
        *,
        second: bool = False,
    ) -> None:
        """Start the view at the pads' present state; rng: random stream of the camera."""
        scene, seen_by = plan.scene, plan.sensor
        state, facing = pads.first, ALONG
        if second:
            assert plan.second is not None and pads.second is not None
            seen_by, state, facing = plan.second.sensor, pads.second.state, FACING
        texture = None
        if scene.shows_texture:
            assert scene.texture is not None
            texture_rng = np.random.default_rng(
                [TEXTURE_SEED, seed_of(plan.object_name), *((SECOND,) if second else ())]
            )
            look = (sampled.texture_half_correlation_px, sampled.texture_log_sd)
            texture, self._focus_mm = optics.texture(texture_rng, TEXTURE_PX, *look), scene.texture.focus_mm
        elif scene.texture is not None and scene.gel.cut:
            rng.uniform(0, TEXTURE_PX[0], 2)
        camera = GelCamera(seen_by, scene=scene, texture=texture, rng=rng)
        super().__init__(camera, state, scene.solver.camera_substeps, timer, second=second)
        self._pads, self._shows_texture = pads, texture is not None
        self._start_m = pads.first.pose[:2].copy()
        self._window_from_middle_m = _window_from_middle_m(camera, self._start_m * facing)
        self._shear_n: tuple[float, float] = (0.0, 0.0)

    def follow_forces(self, shares: Floats, shear_n: tuple[float, float], force_n: float) -> None:
        """Follow the forces of a slice."""
        self._shear_n = shear_n
        self.follow(shares, force_n, self._pads.still_for)

    def look(self, slices: int, indentation_m: float, open_mm: float, *, still: bool) -> Events:
        """Return the events of a slice; open_mm: distance of the finger from the object, which blurs its texture."""
        if not still:
            self.indent(indentation_m, self._pads.gaps)
            if self._shows_texture:
                self.show(self._in_window_m(), float(np.exp(-open_mm / self._focus_mm)))
        return self.see(slices, still=still)

    def _moved_m(self) -> Floats:
        """Return the displacement of the object's centre of mass, in the coordinates of the camera."""
        moved_m: Floats = (self._pads.first.pose[:2] - self._start_m) * self._facing
        return moved_m

    def _in_window_m(self) -> Floats:
        """Return the object's displacement at the window; an object that is held off its middle also turns."""
        moved_m, turned = self._moved_m(), float(self._pads.first.pose[2] * self._facing[1])
        if self._window_from_middle_m is not None and turned:
            across, down = self._window_from_middle_m
            cosine, sine = math.cos(turned), math.sin(turned)
            moved_m[0] += (cosine - 1) * across - sine * down
            moved_m[1] += sine * across + (cosine - 1) * down
        return moved_m

    def truth_of(self, finger: FingerDrive) -> dict[str, Any]:
        """Return the ground truth of the finger at the end of the last slice, by schema path."""
        return {
            **self.truth(),
            "truth/object_xy_px": (self._moved_m() * 1e3 / self.camera.mm_per_px).astype(np.float32),
            "truth/normal_force_n": finger.state.force_n,
            "truth/shear_force_n": np.array(self._shear_n) * self._facing,
            "truth/closing_ticks": finger.state.closing_ticks,
        }


def _window_from_middle_m(camera: GelCamera, middle_m: NDArray[np.float64]) -> tuple[float, float] | None:
    """Return the vector from the initial centre of mass to the window's middle; None without window or offset."""
    if camera.window_px is None or not middle_m.any():
        return None
    window_px = np.array(camera.window_px).reshape(2, 2).mean(axis=0) - np.array(FRAME_PX) / 2
    across_m, down_m = (window_px * camera.mm_per_px * 1e-3 - middle_m).tolist()
    return across_m, down_m


class GraspSimulation:
    """One trial with a gripper: set `finger.command`; `step` advances by one slice, `truth` returns its truth.

    finger: motor, gear and encoder of the fingers. pads: the gel and the motion of the object. held: what pushes
    the object, and what else carries it. view, second_view: what the cameras see; second_events: events of the second
    finger's camera in the last slice.
    """

    def __init__(
        self,
        plan: Plan,
        mechanics: np.random.Generator,
        optics_rng: np.random.Generator,
        *,
        lift_s: float = 10.0,
        balance_s: float = 20.0,
        timer: Timer = untimed,
        second_optics_rng: np.random.Generator | None = None,
    ) -> None:
        """Build the parts that a plan names; ValueError if values of the scene contradict each other.

        second_optics_rng: for the camera of the second finger, if the plan has one.
        """
        plan, time = plan.with_gel_of_scene(), plan.scene.time
        assert plan.object is not None
        self.sampled = sampled = sample_trial(plan.scene, plan.object, plan.sensor, mechanics, plan.object_name)
        # each part has its own stream, and draws from it only if a scene names the part
        of_hand, of_encoder, of_commands, of_surface = mechanics.spawn(4)
        self.pads = pads = Pads(plan, sampled, of_surface, timer)
        self.finger = FingerDrive(plan, sampled, pads.curve, pads.slip_limit_n, of_encoder, of_commands, timer)
        if plan.scene.kind == "ramp":
            pads.close(self.finger.state)
        pads.press(self.finger.state)
        self.held = HeldObject(plan, sampled, pads, lift_s, of_hand)
        self.view = FingerView(plan, sampled, pads, optics_rng, timer)
        self.second_view = None
        if plan.second is not None:
            assert second_optics_rng is not None
            self.second_view = FingerView(plan, sampled, pads, second_optics_rng, timer, second=True)
        pads.views = (self.view,) if self.second_view is None else (self.view, self.second_view)
        self.second_events: Events | None = None
        self._friction = pads.friction
        self._changes_at, self._changed = friction_after(plan.scene.friction_change, pads.friction)
        self._is_lifted = plan.scene.kind == "lift"
        self.slices, self.finished = 0, False
        lasts_s = time.touch_s + lift_s + balance_s if self._is_lifted else time.longest_s
        self.slices_in_all = round(lasts_s * SLICES_PER_S)

    def step(self) -> Events:
        """Advance by one slice and return its events; sets `finished` with the last one."""
        finger, pads = self.finger, self.pads
        closing_ticks = finger.state.closing_ticks
        self._move()
        still = pads.still_for > 0 and finger.state.closing_ticks == closing_ticks
        events = self.view.look(self.slices, finger.state.indentation_m, finger.open_mm, still=still)
        if self.second_view is not None and pads.second is not None:
            pressed_m = pads.second.indentation_m
            self.second_events = self.second_view.look(self.slices, pressed_m, finger.open_mm, still=still)
        self.slices += 1
        self.finished = self.slices >= self.slices_in_all or self.held.is_over(finger.state.force_n)
        return events

    def _move(self) -> None:
        """Perform one mechanical step of fingers, gel and object."""
        pads = self.pads
        if self.slices == self._changes_at:
            self._friction = self._changed
        force_n = self.finger.move(self.slices)
        pads.press(self.finger.state)
        done = self.held.advance(self.slices, force_n, self._friction)
        self.view.follow_forces(pads.shares, done.friction_n[:2], force_n[1])
        if self.second_view is not None and pads.second is not None:
            pads.second.state.pose[:] = pads.first.pose
            self.second_view.follow_forces(pads.second.shares, done.second_friction_n[:2], force_n[1])

    @property
    def gel_camera(self) -> GelCamera:
        """Return the camera of the first finger."""
        return self.view.camera

    @property
    def holding_n(self) -> float:
        """Return the normal force that just holds the object now, as if it hung free.

        It balances the weight of the object and of a weight that fell on it, the moment of both, and the inertia from
        the hand's motion.
        """
        static = max(self._friction.static, LEAST_FRICTION)
        return self.pads.slip_limit_n * self.held.pulls * self.pads.friction.static / static

    def truth(self) -> dict[str, Any]:
        """Return the ground truth at the end of the last slice, by schema path."""
        row = {**self.view.truth_of(self.finger), **self.pads.solver_truth()}
        if self._is_lifted:
            row["truth/table_gap_mm"] = (self.held.table_m - self.held.fallen_m) * 1e3
            row["truth/holding_force_n"] = self.holding_n
        return row

    def second_truth(self) -> dict[str, Any]:
        """Return the ground truth of the second finger, which must have a camera."""
        assert self.second_view is not None
        return self.second_view.truth_of(self.finger)
