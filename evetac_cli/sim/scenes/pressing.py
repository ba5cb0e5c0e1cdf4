"""Scenes of kind `press`: a face is pressed on the gel and moved as planned, without gripper, free object or texture.

The scene names the face (a rectangle or a disc) and one of two motions. `waypoints` (shear): the face is pressed on
once, then moved to random positions in a disc so small that nothing slips, with pauses. `strokes` (press): the face is
drawn over the whole gel in lines and lifted off between them, so that every dot is moved.

As in gel/cell_gaps.py, each cell of the gel is sampled at points. Here the face's edge is soft over the distance of two
points, so that a moving face covers and uncovers each cell evenly.
"""

import math
from bisect import bisect_right
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.errors import SceneError
from evetac_cli.events import Events
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera.contact_edges import Outline
from evetac_cli.sim.camera.gel_camera import GelCamera
from evetac_cli.sim.gel.cell_gaps import SAMPLES
from evetac_cli.sim.scenes.gel_view import GelView
from evetac_cli.sim.scenes.shared import (
    STEP_S,
    GelSlices,
    friction_after,
    friction_of,
    start_gel,
)
from evetac_cli.sim.setup.driven import Face, FaceMotion
from evetac_cli.sim.setup.parts import Timer, untimed
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.sampling import sample_trial

LONGEST_S = 24 * 3600.0  # the limit of every recording
NO_HOLE = np.zeros(0)


class Timeline(NamedTuple):
    """Position and force of the face: entry i is reached at time_s[i], smoothly (a cosine) from the entry before."""

    time_s: Floats
    xy_m: Floats
    force_n: Floats

    def at(self, now_s: float) -> tuple[Floats, float]:
        """Return the position (x, y) in m and the normal force in N at a time."""
        after = min(bisect_right(self.time_s, now_s), len(self.time_s) - 1)
        before = max(after - 1, 0)
        span = self.time_s[after] - self.time_s[before]
        done = min(max((now_s - self.time_s[before]) / span, 0.0), 1.0) if span > 0 else 1.0
        share = 0.5 - 0.5 * np.cos(np.pi * done)
        xy = self.xy_m[before] + share * (self.xy_m[after] - self.xy_m[before])
        return xy, float(self.force_n[before] + share * (self.force_n[after] - self.force_n[before]))


class Pressing:
    """A trial of pressing: `step` advances by one slice, `truth` returns its ground truth."""

    follows = False  # whether the pressed area moves with the face, or stays while the face shears it
    _face: Face

    def __init__(
        self,
        plan: Plan,
        mechanics: np.random.Generator,
        optics_rng: np.random.Generator,
        outline: Outline | None = None,
        outline_at_px: Floats | None = None,
        *,
        timer: Timer = untimed,
    ) -> None:
        """Build the parts that a plan names. The camera sees the face's outline, if there is one."""
        assert plan.object is not None
        self._scene = plan.scene
        sensor = plan.with_gel_of_scene().sensor
        solver = self._scene.solver
        self.gel_camera = GelCamera(sensor, self._scene, None, optics_rng, outline, outline_at_px)
        self.sampled = sample_trial(self._scene, plan.object, sensor, mechanics)
        self._gel = start_gel(self._scene, sensor, 1.0, 1.0)  # the face is driven, so its mass has no effect
        self._stiffness_n_m3 = sensor.normal_modulus_pa / self._gel.material.height_m
        self._gel_slices = GelSlices(self._gel, solver, timer=timer)
        self._friction = friction_of(self.sampled)
        self._changes_at, self._changed = friction_after(self._scene.friction_change, self._friction)
        self.view = GelView(self.gel_camera, self._gel, solver.camera_substeps, timer)
        self._centre_m, self.timeline = self._plan_motion(mechanics)
        self._xy_m, self._hand_n = self.timeline.at(0.0)
        self._force_n = self._hand_n
        self._place(self._centre_m + (self._xy_m if self.follows else 0.0))
        self._shear_n = (0.0, 0.0)
        self.slices = 0
        self.finished = False

    def _plan_motion(self, rng: np.random.Generator) -> tuple[Floats, Timeline]:
        motion, face = self._scene.motion, self._scene.face
        assert motion is not None and face is not None
        self._face = face
        self.follows = motion.kind == "strokes"
        if motion.kind == "waypoints":
            return self._plan_waypoints(motion, rng)
        return np.zeros(2), self._plan_strokes(motion, (face.radius_mm or 0.0) * 1e-3)

    def _plan_waypoints(self, motion: FaceMotion, rng: np.random.Generator) -> tuple[Floats, Timeline]:
        """Press on with an offset, then shear to random positions that need at most the scene's shear force."""
        offset_m = rng.uniform(-1.0, 1.0, 2) * motion.offset_mm * 1e-3
        area = self._weights(offset_m).sum() * self._gel.cell_area_m2
        layer = self._gel.material
        reach_m = motion.shear_n / (layer.shear_modulus_pa * area / layer.height_m)
        entries = [(0.0, np.zeros(2), 0.0), (self._scene.time.rest_s, np.zeros(2), 0.0)]
        entries.append((entries[-1][0] + motion.press_s, np.zeros(2), motion.normal_n))
        for _ in range(motion.count):
            angle, radius = rng.uniform(0, 2 * np.pi), reach_m * np.sqrt(rng.uniform())
            place = radius * np.array([np.cos(angle), np.sin(angle)])
            arrives = entries[-1][0] + rng.uniform(*motion.move_s)
            entries += [(arrives, place, motion.normal_n), (arrives + motion.pause_s, place, motion.normal_n)]
        return offset_m, timeline(entries)

    def _plan_strokes(self, motion: FaceMotion, inset: float) -> Timeline:
        """Plan lines along x, back and forth, then along y, over the whole pad, `inset` m inside its edge."""
        low, high = self._gel.node_xy_m.min(axis=(0, 1)) + inset, self._gel.node_xy_m.max(axis=(0, 1)) - inset
        entries = [(0.0, low, 0.0), (self._scene.time.rest_s, low, 0.0)]
        for along in (0, 1):
            lines = np.linspace(low[1 - along], high[1 - along], motion.lines)
            for number, line in enumerate(lines):
                ends = (low[along], high[along]) if number % 2 == 0 else (high[along], low[along])
                first, last = (np.array([end, line])[:: 1 if along == 0 else -1] for end in ends)
                start = entries[-1][0] + motion.approach_s
                pressed = start + motion.press_s
                done = pressed + float(np.linalg.norm(last - first)) / (motion.speed_mm_s * 1e-3)
                entries += [(start, first, 0.0), (pressed, first, motion.normal_n), (done, last, motion.normal_n)]
                entries.append((done + motion.press_s, last, 0.0))
        return timeline(entries)

    def _weights(self, centre_m: Floats) -> Floats:
        """Return the share of each node's cell that the face covers, (rows, columns)."""
        radius_mm, size_mm = self._face.radius_mm, self._face.size_mm
        half_mm = np.array(size_mm) / 2 if radius_mm is None else np.full(2, radius_mm)
        return covered(self._gel.node_xy_m, centre_m, half_mm * 1e-3, is_round=radius_mm is not None)

    @property
    def slices_in_all(self) -> int:
        """Return the number of slices of the trial."""
        longest_s = float(self.timeline.time_s[-1]) + self._scene.time.after_motion_s
        return math.ceil(longest_s / STEP_S - 1e-6)

    def step(self) -> Events:
        """Advance by one slice and return its events; sets `finished` with the last one."""
        before_n = self._hand_n
        xy_m, hand_n = self.timeline.at((self.slices + 1) * STEP_S)
        (x_m, y_m), (x_before_m, y_before_m) = xy_m.tolist(), self._xy_m.tolist()
        moved = x_m != x_before_m or y_m != y_before_m
        if moved and self.follows:
            self._place(self._centre_m + xy_m)
        borne = self._borne(self._covered)
        force_n = borne * hand_n
        twist = ((x_m - x_before_m) / STEP_S, (y_m - y_before_m) / STEP_S, 0.0)
        if self.slices == self._changes_at:
            self._friction = self._changed
        ends_n = (borne * before_n, force_n)
        done = self._gel_slices.advance(self._shares, ends_n, (0.0, 0.0, 0.0), self._friction, twist, self.view.begin())
        still = self._gel_slices.still_for > 0 and hand_n == before_n
        self._hand_n = hand_n
        if not still:
            self._xy_m, self._force_n = xy_m, force_n if self._covered > 0 else 0.0
            self._shear_n = done.friction_n[:2]
            self.view.press(self._depth_m())
            self.view.show(self._xy_m, 0.0)
        self.view.follow(self._shares, self._force_n, self._gel_slices.still_for)
        events = self.view.see(self.slices, still=still, strength=self._strength())
        self.slices += 1
        self.finished = self.slices * STEP_S >= self.timeline.time_s[-1] + self._scene.time.after_motion_s
        return events

    def _place(self, centre_m: Floats) -> None:
        """Compute each node's share of the force at the face's present position."""
        self._weights_now = self._weights(centre_m)
        self._covered = self._weights_now.sum()
        self._shares = self._weights_now / self._covered if self._covered > 0 else self._weights_now

    def _borne(self, covered: float) -> float:
        """Return the share of the hand's force on the pad, if that many cells are covered: always all of it."""
        return 1.0

    def _strength(self) -> float:
        """Return the visibility of the face's outline, 0 to 1."""
        return 0.0

    def _depth_m(self) -> Floats:
        """Return the mean depth of each node's cell, (rows, columns)."""
        if self._force_n <= 0.0:
            return np.zeros_like(self._weights_now)
        area = self._weights_now.sum() * self._gel.cell_area_m2
        depth_m: Floats = self._weights_now * (self._force_n / (self._stiffness_n_m3 * area))
        return depth_m

    def truth(self) -> dict[str, Any]:
        """Return the ground truth at the end of the last slice, by schema path."""
        return {
            **self.view.truth(),
            "truth/object_xy_px": self.gel_camera.object_xy_px.astype(np.float32),
            "truth/normal_force_n": self._force_n,
            "truth/shear_force_n": self._shear_n,
            **self._gel_slices.truth(),
        }


def timeline(entries: list[tuple[float, Floats, float]]) -> Timeline:
    """Return the timeline through (time in s, position in m, force in N); SceneError if it is longer than a day."""
    time_s, xy_m, force_n = zip(*entries, strict=True)
    if not time_s[-1] <= LONGEST_S:
        expected = f"at most {LONGEST_S:g} s"
        raise SceneError("the motion is too long", where="--scene", expected=expected, found=f"{time_s[-1]:.4g} s")
    return Timeline(np.array(time_s), np.array(xy_m), np.array(force_n))


def covered(node_xy_m: Floats, centre_m: Floats, half_m: Floats, *, is_round: bool, hole_m: Floats = NO_HOLE) -> Floats:
    """Return the share of each cell of a grid of nodes, (rows, columns), that a face about centre_m covers, 0 to 1.

    half_m (2,): half sides of a rectangle, or half axes of an ellipse, along x and y; hole_m: half axes of its hole.
    """
    shares: Floats = _covered(node_xy_m, centre_m, half_m, hole_m, is_round)
    return shares


@njit(cache=True)
def _covered(nodes: Floats, centre: Floats, half: Floats, hole: Floats, is_round: bool) -> Floats:
    rows, columns, _ = nodes.shape
    pitch_x = nodes[0, 1, 0] - nodes[0, 0, 0]
    pitch_y = nodes[1, 0, 1] - nodes[0, 0, 1]
    soft = math.sqrt(pitch_x * pitch_y) / SAMPLES
    reach = 0.5 * math.hypot(pitch_x, pitch_y) + soft
    shares = np.empty((rows, columns))
    for row in range(rows):
        for column in range(columns):
            x = nodes[row, column, 0] - centre[0]
            y = nodes[row, column, 1] - centre[1]
            inside = _inside(x, y, half, hole, is_round)
            if abs(inside) >= reach:
                shares[row, column] = 1.0 if inside > 0.0 else 0.0
                continue
            total = 0.0
            for i in range(SAMPLES):
                for j in range(SAMPLES):
                    at_x = x + ((i + 0.5) / SAMPLES - 0.5) * pitch_x
                    at_y = y + ((j + 0.5) / SAMPLES - 0.5) * pitch_y
                    total += min(max(_inside(at_x, at_y, half, hole, is_round) / soft + 0.5, 0.0), 1.0)
            shares[row, column] = total / (SAMPLES * SAMPLES)
    return shares


@njit(cache=True, _nrt=False)
def _inside(x: float, y: float, half: Floats, hole: Floats, is_round: bool) -> float:
    """Return how far a point, relative to the face's centre, is inside the face and outside its hole; else negative."""
    if not is_round:
        return float(min(half[0] - abs(x), half[1] - abs(y)))
    inside = _inside_ellipse(x, y, half)
    return float(min(inside, -_inside_ellipse(x, y, hole))) if len(hole) else float(inside)


@njit(cache=True, _nrt=False)
def _inside_ellipse(x: float, y: float, half: Floats) -> float:
    """Return how far a point is inside an ellipse of half axes (2,), to first order at its edge."""
    if half[0] == half[1]:
        return float(half[0] - math.hypot(x, y))
    scaled = math.sqrt((x / half[0]) * (x / half[0]) + (y / half[1]) * (y / half[1]))
    if scaled == 0.0:
        return float(min(half[0], half[1]))
    steep_x = x / (half[0] * half[0])
    steep_y = y / (half[1] * half[1])
    return scaled * (1.0 - scaled) / max(math.sqrt(steep_x * steep_x + steep_y * steep_y), 1e-9)
