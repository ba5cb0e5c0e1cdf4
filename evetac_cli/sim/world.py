"""A trial in simulation: gripper, gel, object and camera of one scene, advanced one slice at a time.

Two kinds of scene. `ramp`: the object already hangs in a gripper under current control. `lift`: it stands on a table,
the gripper starts just before touch, and a hand lifts the gripper; in its frame the table sinks. One of two mirrored
pads is simulated. The camera sees the pad at the end of each mechanical step of 1 ms.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.sim import camera, contact, gel, gripper, optics, scene

GRAVITY_M_S2 = 9.81
STEP_S = 1e-3
THETA = 0.55  # of the time step: second order but for a trace, and no ringing after a stick event
SLIP_PX = 0.5  # an object that slid further than this in gross slip slips (scenes.md: the true onset)
EPISODE_MS = 3  # gross slip is over after so many slices with a stuck node
CONTACT_N = 0.01
FINGER_STIFFNESS_N_M = 1.8e3  # of the gap, by fingers, links and mounts; fitted to the paper's two bottles
GONE_M = 0.02  # an object that slid this far is lost
PAD_M = (20e-3, 15e-3)  # the part of the gel that can touch, along x and y
APPROACH_TICKS = -4.0  # where a lift scene starts: this far before touch
TEXTURE_PX = (1024, 1024)
TEXTURE_SEED = 7919  # with the object's number: an object has the same texture in every trial


class World:
    """Everything that exists in one trial: `command` is set from outside, `step` makes a slice, `truth` tells of it."""

    def __init__(
        self,
        plan: Mapping[str, Any],
        mechanics: np.random.Generator,
        optics_rng: np.random.Generator,
        *,
        lift_s: float = 10.0,
        balance_s: float = 20.0,
    ) -> None:
        """Build what a plan names: scene, object (its number), object_row, individual_row."""
        self._scene = plan["scene"]
        self._time = self._scene["time"]
        thing, individual = plan["object_row"], plan["individual_row"]
        self.drawn = scene.draw(self._scene, thing, mechanics)
        self.lifting = self._scene["kind"] == "lift"
        self.grid_xy_px = dot_grid(individual)
        self.window_px = tuple(individual["window_px"])
        self._mm_per_px = float(individual["mm_per_px"])
        self._build_mechanics(thing, individual)
        self._build_camera(plan, individual, optics_rng)
        self.slices = 0
        self.finished = False
        self._slid_m = 0.0
        self._since_gross = 0
        self._lost_for = 0
        self._slip = False
        self._slip_fraction = 0.0
        self._table_m = 0.0
        self._hand_m_s = 0.0
        self._last_slice = self._planned_slices(lift_s, balance_s)
        self._lift_starts_s = float(self._time.get("touch_s", 0.0) + self._time.get("before_rise_s", 0.0))

    def _planned_slices(self, lift_s: float, balance_s: float) -> int:
        if self.lifting:
            return round((float(self._time["touch_s"]) + lift_s + balance_s) * 1000)
        return round(float(self._time["longest_s"]) * 1000)

    def _build_mechanics(self, thing: Mapping[str, Any], individual: Mapping[str, Any]) -> None:
        columns, rows = self._scene["gel"]["nodes"]
        cut_m = (self.window_px[0] - FRAME_PX[0] / 2) * self._mm_per_px * 1e-3
        nodes = contact.pad_nodes(columns, rows, (cut_m - PAD_M[0], cut_m), (-PAD_M[1] / 2, PAD_M[1] / 2))
        drawn = self.drawn
        width_m = float(thing.get("grasped_width_mm", thing["width_mm"])) * 1e-3
        self._gap = contact.gap_profile(nodes, thing["shape"], float(thing["width_mm"]) * 0.5e-3, drawn.tilt_rad)
        material = gel.GelMaterial(shear_modulus_pa=float(individual["shear_modulus_pa"]))
        self._curve = contact.force_curve(
            self._gap,
            contact.cell_area(nodes),
            float(individual["normal_modulus_pa"]),
            material.height_m,
            FINGER_STIFFNESS_N_M,
            gripper.metres_per_tick(width_m),
        )
        base = gripper.Drive()
        self.drive = gripper.Drive(friction_n=base.friction_n * drawn.gear_friction_factor)
        touch_ticks = float(round(gripper.ticks_at_gap(width_m)))
        if self.lifting:
            self.finger = gripper.start(self.drive, self._curve, touch_ticks, APPROACH_TICKS)
            self.command: tuple[gripper.Mode, float] = ("position", self.finger.position_ticks)
        else:
            limit_n = drawn.mass_kg * GRAVITY_M_S2 / (2 * drawn.static_friction)
            push_n = drawn.start_factor * limit_n * (1 + self.drive.friction_share) + self.drive.friction_n
            start_ma = float(np.ceil(push_n / self.drive.force_per_current_n_ma))
            self.finger = gripper.closed_with(self.drive, self._curve, touch_ticks, start_ma)
            self.command = ("current", start_ma)
        height_m = float(thing["height_mm"]) * 1e-3
        inertia = drawn.mass_kg * (height_m**2 + width_m**2) / 12
        self._gel = gel.start(nodes, material, drawn.mass_kg, inertia)
        self._friction = gel.Friction(drawn.static_friction, drawn.kinetic_friction, drawn.stribeck_m_s)
        rest_m = (self.grid_xy_px.reshape(-1, 2) - np.array(FRAME_PX) / 2) * self._mm_per_px * 1e-3
        self._at_dots = gel.interpolation(nodes, rest_m)
        self._dot_xy_px = self.grid_xy_px.reshape(-1, 2).copy()
        self._object_xy_px = np.zeros(2)

    def _build_camera(self, plan: Mapping[str, Any], individual: Mapping[str, Any], rng: np.random.Generator) -> None:
        model = camera.CameraModel(
            frame_px=tuple(individual["frame_px"]),
            threshold=individual["threshold"],
            mismatch=individual["mismatch"],
            noise_rate_hz=individual["noise_hz"],
            hot_pixels=individual["hot_pixels"],
            hot_rate_hz=tuple(individual["hot_pixel_hz"]),
            edge_sigma_px=individual["edge_sigma_px"],
            log_contrast=individual["log_contrast"],
            dot_radius_px=individual["dot_radius_px"],
        )
        texture = None
        if "texture" in self._scene:
            texture = optics.texture(
                np.random.default_rng([TEXTURE_SEED, plan["object"]]),
                TEXTURE_PX,
                self.drawn.texture_half_correlation_px,
                self.drawn.texture_log_sd,
            )
        self._rng = rng
        self._texture_at_px = rng.uniform(0, TEXTURE_PX[0], 2)
        self._camera = camera.start(model, self._dot_xy_px, None, self.window_px, texture, rng)

    def _see(self, dot_xy_px: NDArray[np.float64], object_xy_px: NDArray[np.float64], t0_us: int) -> Events:
        fade = 0.0
        if "texture" in self._scene:
            open_mm = max(-self.finger.closing_ticks, 0.0) * self._curve.metres_per_tick * 0.5e3
            fade = float(np.exp(-open_mm / self._scene["texture"]["focus_mm"]))
        events = camera.step(
            self._camera,
            self._dot_xy_px,
            dot_xy_px,
            self._texture_at_px + self._object_xy_px,
            self._texture_at_px + object_xy_px,
            fade,
            t0_us,
            self._rng,
        )
        self._dot_xy_px, self._object_xy_px = dot_xy_px, object_xy_px
        return events

    def step(self) -> Events:
        """Advance by one slice and return its events; sets `finished` with the last one."""
        self._move()
        shift_m = gel.displacement_at(self._gel, *self._at_dots)
        dot_xy_px = self.grid_xy_px.reshape(-1, 2) + shift_m * (1e3 / self._mm_per_px)
        object_xy_px = self._gel.pose[:2] * (1e3 / self._mm_per_px)
        events = self._see(dot_xy_px, object_xy_px, self.slices * SLICE_US)
        self.slices += 1
        self.finished = self.slices >= self._last_slice or self._over()
        return events

    def _move(self) -> None:
        """One mechanical step: finger, gel, object, table."""
        before_n = self.finger.force_n
        mode, command = self.command
        after_n = gripper.step(self.finger, self.drive, self._curve, mode, command, STEP_S)
        force_n = before_n + THETA * (after_n - before_n)  # where the time step looks for its balance
        nodal_n = contact.pressure(self.finger.indentation_m, self._gap, force_n)
        if self.lifting:
            info = self._move_over_table(nodal_n)
        else:
            weight_n = self.drawn.mass_kg * GRAVITY_M_S2 * self._load()
            info = gel.step(self._gel, nodal_n, (weight_n, 0.0, 0.0), self._friction, STEP_S, theta=THETA)
        self._follow_slip(info)

    def _load(self) -> float:
        """Share of the weight that hangs on the gripper: handed over smoothly after the rest."""
        done = (self.slices * STEP_S - self._time["rest_s"]) / max(self._time["load_s"], STEP_S)
        return float(0.5 - 0.5 * np.cos(np.pi * np.clip(done, 0.0, 1.0)))

    def _move_over_table(self, nodal_n: NDArray[np.float64]) -> "gel.StepInfo":
        """As above, with the table under the object: where it would sink into the table, the table carries it."""
        hand_m_s = self._hand_speed((self.slices + 1) * STEP_S - self._lift_starts_s)
        acceleration = (hand_m_s - self._hand_m_s) / STEP_S
        self._hand_m_s = hand_m_s
        self._table_m += hand_m_s * STEP_S
        before = self._gel.copy()
        weight_n = self.drawn.mass_kg * (GRAVITY_M_S2 + acceleration)
        info = gel.step(self._gel, nodal_n, (weight_n, 0.0, 0.0), self._friction, STEP_S, theta=THETA)
        if self._gel.pose[0] > self._table_m:
            self._gel.restore(before)
            twist = ((self._table_m - before.pose[0]) / STEP_S, 0.0, 0.0)
            info = gel.step(
                self._gel, nodal_n, (0.0, 0.0, 0.0), self._friction, STEP_S, theta=THETA, prescribed_twist=twist
            )
        return info

    def _hand_speed(self, since_s: float) -> float:
        """Speed of the hand: a trapezoid that rises by the scene's height."""
        hand = self._scene["hand"]
        speed, acceleration = hand["speed_mm_s"] * 1e-3, hand["acceleration_mm_s2"] * 1e-3
        ramp_s, cruise_s = speed / acceleration, hand["height_mm"] * 1e-3 / speed
        return float(speed * np.clip(min(since_s, cruise_s + ramp_s - since_s) / ramp_s, 0.0, 1.0))

    def _follow_slip(self, info: "gel.StepInfo") -> None:
        """Keep the account of slid distance: an episode of gross slip ends after a few slices with a stuck node."""
        slip_m_s = info.slip_velocity_m_s[0]
        gross = info.slip_fraction >= 1.0 and self.finger.force_n > CONTACT_N and abs(slip_m_s) > 1e-6
        if gross:
            self._slid_m += slip_m_s * STEP_S
            self._since_gross = 0
        else:
            self._since_gross += 1
            if self._since_gross > EPISODE_MS:
                self._slid_m = 0.0
        self._slip = gross and abs(self._slid_m) > SLIP_PX * self._mm_per_px * 1e-3
        self._slip_fraction = info.slip_fraction

    def _over(self) -> bool:
        """A ramp ends some time after contact is lost or the object slid away; a grasp when the object fell."""
        fallen = self._gel.pose[0] > GONE_M
        gone = self.finger.force_n <= 0.0 or fallen
        if self.lifting:
            gone = fallen and self._table_m - self._gel.pose[0] > GONE_M and self.finger.force_n <= 0.0
        self._lost_for = self._lost_for + 1 if gone else 0
        return bool(self._lost_for > self._time.get("after_lost_s", 0.15) / STEP_S)

    def truth(self) -> dict[str, Any]:
        """What only a simulation knows, at the end of the slice made last; schema paths."""
        row = {
            "truth/dot_xy_px": self._dot_xy_px.astype(np.float32),
            "truth/object_xy_px": self._object_xy_px.astype(np.float32),
            "truth/slid_px": self._slid_m * 1e3 / self._mm_per_px,
            "truth/slip": self._slip,
            "truth/slip_fraction": self._slip_fraction,
            "truth/normal_force_n": self.finger.force_n,
            "truth/closing_ticks": self.finger.closing_ticks,
        }
        if self.lifting:
            row["truth/table_gap_mm"] = (self._table_m - self._gel.pose[0]) * 1e3
        return row


def dot_grid(individual: Mapping[str, Any]) -> NDArray[np.float64]:
    """Dot centres at rest (rows, columns, 2): the grid with its jitter, without the dots that the window cut away."""
    columns, rows = individual["dot_columns_px"], individual["dot_rows_px"]
    rng = np.random.default_rng(individual["grid_seed"])
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    grid = grid + rng.normal(0.0, individual["dot_jitter_px"], grid.shape)
    return grid[:, [x < individual["window_px"][0] for x in columns]]
