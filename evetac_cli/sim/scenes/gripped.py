"""Scenes with a gripper: gripper, gel, object and camera of one trial, advanced one slice at a time.

There are three kinds of scene. `ramp`: the object already hangs in a gripper under current control. `lift`: the object
is on a table, the gripper starts just before touch, and a hand lifts the gripper; in the gripper's frame the table
sinks. `hold`: the gripper starts open and closes on an object, which is then released into the grip and pushed.

One of two mirrored pads is simulated, or both if they differ or both have a camera. Gripper, hand and table move in
steps of 1 ms, gel and object in as many steps as they need (gel.adaptive). The camera sees the first pad at the end of
the slice. If the plan has a camera on the second finger, it sees the second pad (second_finger.py).

Gravity is along +x of the image in a grasp from the top and +y in a grasp from the side. The shape of an upright object
is rotated accordingly.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX, SLICES_PER_S, Events
from evetac_cli.sim import gripper
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.gel_camera import GelCamera
from evetac_cli.sim.gel import contact, gel
from evetac_cli.sim.gel.adaptive import Slice, Stepper
from evetac_cli.sim.parts import Timer, untimed
from evetac_cli.sim.scenes.gel_view import ALONG, FACING, SECOND_CAMERA, GelView
from evetac_cli.sim.scenes.hand import Hand
from evetac_cli.sim.scenes.second_finger import SecondFinger
from evetac_cli.sim.scenes.shared import (
    STEP_S,
    ChangingFriction,
    GelSlices,
    SolverTruth,
    built_of_gel,
    friction_factor,
    friction_of,
    material,
    pad,
    press,
    pressure_law,
)
from evetac_cli.sim.scenes.slip_limit import GRAVITY_M_S2, nodes_of_slip, slip_limit_n
from evetac_cli.sim.setup import sampling
from evetac_cli.sim.setup.held import HandSettings, SecondFingerSettings
from evetac_cli.sim.setup.object_file import TouchedObject, seed_of
from evetac_cli.sim.setup.plan import SECOND, ObjectName, Plan
from evetac_cli.sim.setup.sensor import Sensor

FINGER_STIFFNESS_N_M = 1.8e3  # of the gap, from fingers, links and mounts; fitted to the paper's two bottles
GONE_M = 0.02  # an object that slid this far is lost
CLOSING_S, CLOSING_STEPS = 0.5, 10  # time and steps in which a finger closes on a ramp's object, before the trial
LEAST_FRICTION = 1e-6  # below, the holding force would not be finite
APPROACH_TICKS = -4.0  # start of a lift scene: position relative to touch
TEXTURE_PX = (1024, 1024)  # size of an object's texture
TEXTURE_SEED = 7919  # with the object's number: an object has the same texture in every trial


class GraspSimulation:
    """One trial with a gripper: set `command` from outside; `step` advances by one slice, `truth` returns its truth."""

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
        assert plan.object is not None
        self._scene = plan.scene
        self._time = self._scene.time
        self._kind = self._scene.kind
        self._drop = self._scene.drop
        self._solver = self._scene.solver
        object, sensor = plan.object, sampling.sensor_with_gel(self._scene, plan.sensor)
        self.sampled = sampling.sample_trial(self._scene, object, sensor, mechanics, plan.object_name)
        # each part has its own stream, and draws from it only if a scene names the part
        hand_rng, self._encoder_rng, commands_rng = mechanics.spawn(3)
        self._down = 1 if self._scene.gel.sideways else 0
        texture = self._texture(plan.object_name, optics_rng)
        self._shows_texture = texture is not None
        self.gel_camera = GelCamera(sensor, scene=self._scene, texture=texture, rng=optics_rng)
        self._step_finger = timer("gripper", gripper.step)
        self._faults = sampling.gripper_faults(self._scene, sensor)
        self._second_sensor = None if plan.second is None else sampling.sensor_with_gel(self._scene, plan.second.sensor)
        self._build_mechanics(object, sensor, timer)
        self.second_view = self._build_second_view(plan, second_optics_rng, timer)
        self.second_events: Events | None = None  # of the last slice
        self._encoder_noise_ticks = self._faults.encoder_noise_ticks
        delay, jitter = (ms * 1e-3 / STEP_S for ms in (self._faults.command_delay_ms, self._faults.command_jitter_ms))
        self._commands = None
        if delay > 0.0 or jitter > 0.0:
            self._commands = gripper.DelayedCommands(self.command, delay, jitter, commands_rng)
        self.slices = 0
        self.finished = False
        self._mass_kg = self.sampled.mass_kg
        self._lost_for = 0
        self._shear_n = self._second_shear_n = (0.0, 0.0)
        self._table_m = 0.0
        self._pulls = 1.0  # gravity plus the hand's acceleration, divided by gravity
        self.slices_in_all = self._planned_slices(lift_s, balance_s)
        rises_at_s = self._time.touch_s + self._time.before_rise_s
        self._hand = Hand(self._scene.hand, rises_at_s, STEP_S, hand_rng)
        self._drops_at = round((self._time.touch_s + lift_s) * SLICES_PER_S)
        if self._drop is not None:
            self._drops_at += round(self._drop.after_s * SLICES_PER_S)
        scene, hand = self._scene, self._scene.hand
        exists = {
            **built_of_gel(self._friction_factor, self._material, scene),
            "friction over pressure": self._pressure_law is not None,
            "gripper": True,
            "free object": True,
            "table and hand": self._kind == "lift",
            "pushes": scene.push is not None,
            "falling weight": self._drop is not None,
            "gear friction": scene.gripper.friction_factor != (1.0, 1.0),
            "gear that breaks loose": self.drive.kinetic_share < 1.0,
            "backlash of the gripper": self.drive.backlash_ticks > 0.0,
            "second finger of its own": self._second is not None,
            SECOND_CAMERA: self.second_view is not None,
            "noise of the gripper's encoder": self._encoder_noise_ticks > 0.0,
            "commands that come late": self._commands is not None,
            "profile of the hand's motion": hand.profile != HandSettings.profile,
            "vibration of the hand": hand.vibration is not None,
            "jerk of the hand": hand.jerk is not None,
            "other mass of the object": scene.object is not None,
        }
        self.built = frozenset(part for part, is_there in exists.items() if is_there)

    def _planned_slices(self, lift_s: float, balance_s: float) -> int:
        if self._kind == "lift":
            return round((self._time.touch_s + lift_s + balance_s) * SLICES_PER_S)
        return round(self._time.longest_s * SLICES_PER_S)

    def _build_second_view(self, plan: Plan, rng: np.random.Generator | None, timer: Timer) -> GelView | None:
        """Build the second finger's camera, if the plan has one; its window shows another side of the object."""
        if self._second_sensor is None:
            return None
        assert rng is not None
        texture = self._texture(plan.object_name, rng, SECOND)
        scene = self._scene
        camera = GelCamera(self._second_sensor, scene=scene, texture=texture, rng=rng)
        return GelView(camera, self._pads[-1], self._solver.camera_substeps, timer, second=True)

    def _texture(self, object_name: ObjectName, rng: np.random.Generator, *side: int) -> NDArray[np.float32] | None:
        """Return the texture in the window; None if the scene has no texture, does not show it, or has no window."""
        if self._scene.texture is None or not self._scene.gel.cut:
            return None
        if not self._scene.texture.show:
            # the texture's position, drawn anyway so that the gel's events are those of a trial with texture
            rng.uniform(0, TEXTURE_PX[0], 2)
            return None
        texture_rng = np.random.default_rng([TEXTURE_SEED, seed_of(object_name), *side])
        return optics.texture(
            texture_rng, TEXTURE_PX, self.sampled.texture_half_correlation_px, self.sampled.texture_log_sd
        )

    def _build_mechanics(self, object: TouchedObject, sensor: Sensor, timer: Timer) -> None:
        nodes = pad(self._solver, sensor, cut=self._scene.gel.cut)
        sampled = self.sampled
        width_m = object.held_mm * 1e-3
        upright = nodes if self._down == 0 else np.ascontiguousarray(nodes[..., ::-1])
        radius_m = object.width_mm * 0.5e-3
        self._gaps = contact.gap_profile(upright - sampled.touch_m, object.shape, radius_m, sampled.tilt_rad)
        self._material = material(sensor)
        second = self._scene.gripper.second_finger
        if second is None and self._second_sensor is not None:
            second = SecondFingerSettings()
        self._second = None if second is None else SecondFinger(second, sensor, nodes, self._second_sensor)
        own_stiffness = sensor.gripper.finger_stiffness_n_m
        self._curve = contact.force_curve(
            self._gaps,
            contact.cell_area(nodes),
            sensor.normal_modulus_pa,
            self._material.height_m,
            FINGER_STIFFNESS_N_M if own_stiffness is None else own_stiffness,
            gripper.metres_per_tick(width_m),
            second_stiffness=None if self._second is None else self._second.stiffness_factor,
        )
        self._friction_factor = friction_factor(sensor, nodes)
        self._pressure_law = pressure_law(sampled)
        self._nodes_m = nodes
        self._slip_limit_n = self._limit_n(sampled.mass_kg)
        start_n = self._scene.gripper.start_n
        if start_n is not None and start_n < self._slip_limit_n:
            raise ValueError(
                f"gripper.start_n: {start_n:g} N cannot hold an object that slips below {self._slip_limit_n:.3g} N"
            )
        own = sensor.gripper
        self.drive = gripper.make_drive(own, sampled.gear_friction_factor, self._faults.backlash_ticks)
        touch_ticks = float(round(gripper.ticks_at_gap(width_m)))
        self.command: tuple[gripper.Mode, float]
        if self._kind == "ramp":
            self.finger = gripper.closed_with(self.drive, self._curve, touch_ticks, self.holding_ma())
            self.command = ("current", self.holding_ma())
        else:
            away = APPROACH_TICKS if self._kind == "lift" else -self._scene.gripper.open_ticks
            self.finger = gripper.start(self.drive, self._curve, touch_ticks, away)
            self.command = ("position", self.finger.position_ticks)
        height_m = object.height_mm * 1e-3
        inertia = sampled.mass_kg * (height_m**2 + width_m**2) / 12
        along, across = sampled.touch_m[0], sampled.touch_m[1] + sampled.lever_m
        middle_m = (along, across) if self._down == 0 else (across, along)
        self._gel = gel.start(
            nodes,
            self._material,
            sampled.mass_kg,
            inertia,
            2 if self._second is None else 1,
            body_xy_m=middle_m,
            friction_factor=self._friction_factor,
        )
        self._middle_m = np.array(middle_m)  # the centre of mass when the trial starts
        second_pad = None if self._second is None else self._second.pad(self._gel)
        self._pads = (self._gel,) if second_pad is None else (self._gel, second_pad)
        self._gel_slices = GelSlices(self._gel, self._solver, second_pad, timer)
        self._friction = friction_of(sampled)
        self._friction_before = self._friction.static  # a scene may change it
        if self._kind == "ramp":
            self._close(second_pad)
            self._middle_m = self._gel.pose[:2].copy()
        self._press()
        self._changing_friction = ChangingFriction(self._scene.friction_change, self._friction)
        self._steps = SolverTruth(self._gel)
        self._window_from_middle_m = _window_from_middle_m(self.gel_camera, self._middle_m)
        self.view = GelView(self.gel_camera, self._gel, self._solver.camera_substeps, timer)
        # the state before a step that may have to be repeated
        self._before = tuple(one.copy() for one in self._pads)
        self._on_table = self._kind == "lift"

    def holding_ma(self) -> float:
        """Return the current for the initial force: the scene's, or a sampled multiple of the slip limit."""
        own, limit_n = self._scene.gripper, self._slip_limit_n
        force_n = self.sampled.start_factor * limit_n + own.start_more_n if own.start_n is None else own.start_n
        return float(np.ceil(gripper.closing_push_n(self.drive, force_n) / self.drive.force_per_current_n_ma))

    def slips_at_ma(self) -> float:
        """Return the approximate current at which a ramp releases the object despite the gear friction; else NaN."""
        if self._kind != "ramp":
            return math.nan
        slides_n = gripper.opening_push_n(self.drive, self._slip_limit_n)
        starts_n = gripper.opening_push_n(self.drive, self.finger.force_n, rests=True)
        push_n = min(slides_n, starts_n)
        return push_n / self.drive.force_per_current_n_ma

    def _limit_n(self, mass_kg: float) -> float:
        """Return the normal force at which an object of this mass slides or turns; all else as in the trial."""
        return slip_limit_n(
            replace(self.sampled, mass_kg=mass_kg),
            self._curve,
            self._gaps,
            self._nodes_m,
            self._friction_factor,
            self._second,
            self._pressure_law,
        )

    def nodes_of_slip(self, grip: float = 1.0) -> float:
        """Return half the wavelength of unstable slip, in nodes; infinity if slip is stable.

        grip: normal force over the slip limit.
        """
        force_n = grip * self._slip_limit_n
        return nodes_of_slip(force_n, self._curve, self._gaps, self._gel, self._friction, self._pressure_law)

    def step(self) -> Events:
        """Advance by one slice and return its events; sets `finished` with the last one."""
        closing_ticks = self.finger.closing_ticks
        self._move()
        still = self._gel_slices.still_for > 0 and self.finger.closing_ticks == closing_ticks
        if not still:
            self.view.indent(self.finger.indentation_m, self._gaps)
            if self._shows_texture:
                self.view.show(self._seen_m(), self._contrast())
        events = self.view.see(self.slices, still=still)
        if self.second_view is not None:
            self._see_second(self.second_view, still=still)
        self.slices += 1
        self.finished = self.slices >= self.slices_in_all or self._over()
        return events

    def _see_second(self, view: GelView, *, still: bool) -> None:
        """Render the slice with the second finger's camera."""
        assert self._second is not None
        if not still:
            view.indent(self._second.indentation_m, self._gaps)
        if self._shows_texture and not still:
            middle_m = self._middle_m * FACING
            from_middle_m = _window_from_middle_m(view.camera, middle_m)
            moved_m = self._gel.pose[:2] * FACING - middle_m
            view.show(_in_window(moved_m, -float(self._gel.pose[2]), from_middle_m), self._contrast())
        self.second_events = view.see(self.slices, still=still)

    def _fallen_m(self) -> float:
        """Return the object's motion along gravity since the start, in m."""
        return float(self._gel.pose[self._down] - self._middle_m[self._down])

    def _seen_m(self) -> NDArray[np.float64]:
        """Return the object's displacement at the window; an object that is held off its middle also turns."""
        moved_m: NDArray[np.float64] = self._gel.pose[:2] - self._middle_m
        return _in_window(moved_m, float(self._gel.pose[2]), self._window_from_middle_m)

    def _contrast(self) -> float:
        """Return the contrast of the object's texture: it blurs when the object is off the pad."""
        assert self._scene.texture is not None
        open_mm = max(-self.finger.closing_ticks, 0.0) * self._curve.metres_per_tick * 0.5e3
        return float(np.exp(-open_mm / self._scene.texture.focus_mm))

    def _move(self) -> None:
        """Perform one mechanical step of finger, gel, object and table."""
        self._friction = self._changing_friction.at(self.slices)
        before_n = self.finger.force_n
        mode, command = self.command if self._commands is None else self._commands.at(self.slices, self.command)
        if self._encoder_noise_ticks > 0.0:
            self.finger.encoder_off_ticks = self._encoder_noise_ticks * float(self._encoder_rng.normal())
        after_n = self._step_finger(self.finger, self.drive, self._curve, mode, command, STEP_S)
        if self.finger.indentation_m != self._shares_at_m:
            self._press()
        shares = self._shares
        force_n = (before_n, after_n)
        if self._drop is not None and self.slices == self._drops_at:
            self._catch_weight()
        acceleration = self._hand.accelerate(self.slices)
        self._pulls = max(1.0 + acceleration / GRAVITY_M_S2, 0.0)
        if self._kind == "lift":
            done = self._move_over_table(shares, force_n, acceleration)
        elif self._kind == "hold" and (self._load() == 0.0 or self._fallen_m() > self.sampled.floor_m):
            done = self._solve(shares, force_n, 0.0, is_held=True)  # the floor, or something else, carries the object
        else:
            weight_n = self._mass_kg * (GRAVITY_M_S2 + acceleration) * self._load()
            done = self._solve(shares, force_n, weight_n + self._push())
        still_for = self._gel_slices.still_for
        self.view.follow(shares, self.finger.force_n, still_for)
        self._steps.follow(done, self._friction)
        self._shear_n = done.friction_n[:2]
        if self.second_view is not None and self._second_shares is not None:
            self._pads[-1].pose[:] = self._gel.pose
            self._second_shear_n = done.second_friction_n[:2]
            self.second_view.follow(self._second_shares, self.finger.force_n, still_for)

    def _close(self, second_pad: gel.GelState | None) -> None:
        """Let the gel follow a finger that closes to its initial position; then it rests on the free object as long.

        If the gel was squeezed at once it would creep for some 15 slices. The camera, which starts with dots at rest,
        would see them jump in the first two slices.
        """
        slow = replace(self._solver, theta=1.0)  # no oscillation while the finger closes
        stepper = Stepper(slow, CLOSING_S / CLOSING_STEPS, second_pad)
        end_ticks, end_m, end_n = self.finger.closing_ticks, self.finger.indentation_m, self.finger.force_n
        before_n = 0.0
        for step in range(2 * CLOSING_STEPS):
            self.finger.closing_ticks = end_ticks * min((step + 1) / CLOSING_STEPS, 1.0)
            self.finger.indentation_m, self.finger.force_n = (
                contact.lookup(table, self._curve.step_ticks, self.finger.closing_ticks)
                for table in (self._curve.indentation_m, self._curve.force_n)
            )
            self._press()
            force_n, nothing = (before_n, self.finger.force_n), (0.0, 0.0, 0.0)
            twist = nothing if step < CLOSING_STEPS else None
            stepper.advance(
                self._gel, self._shares, force_n, nothing, self._friction, twist, second_shares=self._second_shares
            )
            before_n = self.finger.force_n
        self.finger.closing_ticks, self.finger.indentation_m, self.finger.force_n = end_ticks, end_m, end_n

    def _press(self) -> None:
        """Compute each node's share of the normal force at the finger's present position."""
        self._shares_at_m = self.finger.indentation_m
        gaps, law = self._gaps, self._pressure_law
        self._shares = press(self._gel, self._shares_at_m, gaps, self._friction_factor, law)
        self._second_shares = None
        if self._second is not None:
            closing_ticks = self.finger.closing_ticks
            self._second_shares = self._second.press(self._pads[-1], self._curve, closing_ticks, gaps, law)

    def _solve(
        self,
        shares: NDArray[np.float64],
        force_n: tuple[float, float],
        weight_n: float,
        *,
        is_held: bool = False,
        speed: float = 0.0,
    ) -> Slice:
        """Solve a slice of the gel, with a force on the object along gravity, or with a prescribed speed (is_held)."""
        each = self.view.begin()
        second_each = None if self.second_view is None else self.second_view.begin()
        if each is not None and second_each is not None:
            each = _both(each, second_each)
        force, twist = self._along_gravity(weight_n), self._along_gravity(speed) if is_held else None
        second = self._second_shares
        return self._gel_slices.advance(shares, force_n, force, self._friction, twist, each, second_shares=second)

    def _restore(self) -> None:
        """Restore the state before the slice."""
        for state, before in zip(self._pads, self._before, strict=True):
            state.restore(before)

    def _along_gravity(self, value: float) -> tuple[float, float, float]:
        """Return a force or a velocity (x, y, rotation) that points down."""
        return (0.0, value, 0.0) if self._down else (value, 0.0, 0.0)

    def _load(self) -> float:
        """Return the share of the weight on the gripper: handed over smoothly after the rest."""
        done = (self.slices * STEP_S - self._time.rest_s) / max(self._time.load_s, STEP_S)
        if done >= 1.0:
            return 1.0
        return float(0.5 - 0.5 * np.cos(np.pi * min(max(done, 0.0), 1.0)))

    def _push(self) -> float:
        """Return the downward force of the scene's pushes on the object at this time, in N."""
        push = self._scene.push
        if push is None:
            return 0.0
        now = self.slices * STEP_S
        forces = [
            force_n * float(np.sin(np.pi * (now - at) / push.lasts_s))
            for at, force_n in zip(push.at_s, push.force_n, strict=True)
            if at <= now < at + push.lasts_s
        ]
        return float(sum(forces))

    def _catch_weight(self) -> None:
        """Let the weight land on the object inelastically; it stays there."""
        assert self._drop is not None
        weight_kg = self._drop.mass_g * 1e-3
        share = weight_kg / (self._mass_kg + weight_kg)
        speed = self._gel.twist[self._down]
        self._gel.twist[self._down] = speed + share * (self._drop.speed_m_s - speed)
        self._mass_kg += weight_kg
        self._gel.inertia[:2] = self._mass_kg
        self._slip_limit_n = self._limit_n(self._mass_kg)

    def _move_over_table(self, shares: NDArray[np.float64], force_n: tuple[float, float], acceleration: float) -> Slice:
        """Solve a slice over the table: if the object would sink into the table, the table carries it.

        At most both cases are tried, first that of the slice before. An object on the table stays there as long as the
        table has to push it up (otherwise the object would hang on the table). A hanging object keeps hanging as long
        as it does not sink into the table.
        """
        self._table_m += self._hand.speed_m_s * STEP_S
        weight_n = self._mass_kg * (GRAVITY_M_S2 + acceleration)
        speed, falling = (self._table_m - self._fallen_m()) / STEP_S, self._gel.twist[self._down]
        for state, before in zip(self._pads, self._before, strict=True):
            before.restore(state)
        if self._on_table:
            done = self._solve(shares, force_n, 0.0, is_held=True, speed=speed)
            inertial_n = self._mass_kg * (speed - falling) / (self._solver.theta * STEP_S)
            held_n = 2 * done.friction_n[self._down]
            if self._second is not None:
                held_n = done.friction_n[self._down] + done.second_friction_n[self._down]
            if weight_n - held_n - inertial_n >= 0.0:
                return done
            self._restore()
        done = self._solve(shares, force_n, weight_n)
        self._on_table = bool(self._fallen_m() > self._table_m)
        if self._on_table:
            self._restore()
            done = self._solve(shares, force_n, 0.0, is_held=True, speed=speed)
        return done

    def _over(self) -> bool:
        """Return whether the trial is over: a ramp some time after contact is lost, a grasp after the object fell."""
        if self._kind == "hold":
            return False
        fallen = self._fallen_m() > GONE_M
        gone = self.finger.force_n <= 0.0 or fallen
        if self._kind == "lift":
            gone = fallen and self._table_m - self._fallen_m() > GONE_M and self.finger.force_n <= 0.0
        self._lost_for = self._lost_for + 1 if gone else 0
        return bool(self._lost_for > self._time.after_lost_s / STEP_S)

    @property
    def carried_kg(self) -> float:
        """Return the mass of the object, with a weight that fell on it."""
        return self._mass_kg

    @property
    def holding_n(self) -> float:
        """Return the normal force that just holds the object now, as if it hung free.

        It balances the weight of the object and of a weight that fell on it, the moment of both, and the inertia from
        the hand's motion.
        """
        return self._slip_limit_n * self._pulls * self._friction_before / max(self._friction.static, LEAST_FRICTION)

    def truth(self) -> dict[str, Any]:
        """Return the ground truth at the end of the last slice, by schema path."""
        row = {**self._truth_of(self.view, self._shear_n, ALONG), **self._steps.rows()}
        if self._kind == "lift":
            row["truth/table_gap_mm"] = (self._table_m - self._fallen_m()) * 1e3
            row["truth/holding_force_n"] = self.holding_n
        return row

    def second_truth(self) -> dict[str, Any]:
        """Return the ground truth of the second finger, which must have a camera."""
        assert self.second_view is not None
        return self._truth_of(self.second_view, self._second_shear_n, FACING)

    def _truth_of(self, view: GelView, shear_n: tuple[float, float], facing: NDArray[np.float64]) -> dict[str, Any]:
        """Return the ground truth of a finger, whose camera sees coordinates of the first sensor times `facing`."""
        moved_m = (self._gel.pose[:2] - self._middle_m) * facing
        return {
            **view.truth(),
            "truth/object_xy_px": (moved_m * 1e3 / view.camera.mm_per_px).astype(np.float32),
            "truth/normal_force_n": self.finger.force_n,
            "truth/shear_force_n": np.array(shear_n) * facing,
            "truth/closing_ticks": self.finger.closing_ticks,
        }


def _window_from_middle_m(camera: GelCamera, middle_m: NDArray[np.float64]) -> tuple[float, float] | None:
    """Return the vector from the initial centre of mass to the window's middle; None without window or offset."""
    if camera.window_px is None or not middle_m.any():
        return None
    window_px = np.array(camera.window_px).reshape(2, 2).mean(axis=0) - np.array(FRAME_PX) / 2
    across_m, down_m = (window_px * camera.mm_per_px * 1e-3 - middle_m).tolist()
    return across_m, down_m


def _in_window(
    moved_m: NDArray[np.float64], turned: float, from_middle_m: tuple[float, float] | None
) -> NDArray[np.float64]:
    """Return the displacement in a window of an object that has moved and turned; moved_m is changed in place."""
    if from_middle_m is not None and turned:
        across, down = from_middle_m
        cosine, sine = math.cos(turned), math.sin(turned)
        moved_m[0] += (cosine - 1) * across - sine * down
        moved_m[1] += sine * across + (cosine - 1) * down
    return moved_m


def _both(first: Callable[..., None], second: Callable[..., None]) -> Callable[..., None]:
    """Return a function that calls two functions, one after the other."""

    def call(*arguments: Any) -> None:
        first(*arguments)
        second(*arguments)

    return call
