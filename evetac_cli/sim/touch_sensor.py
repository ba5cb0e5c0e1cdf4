"""Touch inside another simulator: one finger's gel and camera, driven by the pose or the force of a contact.

Gel, friction and camera are those of the scenes (sim/gel, sim/camera); a rigid object replaces the scene. The axes are
those of the image, from the middle of the view: x right, y down. In a grasp from the top, x is along gravity.

- Pressing. The shape of the object links indentation and normal force (gel.contact); either may be given. The surface
  moves over the pad with its object, and may leave it.
- Along the gel. Either the object's position is given, and the gel computes the force; or the force that pushes the
  object is given.

In another simulator, a sticking contact has a force and almost no motion. A sliding contact has a motion, and its force
is only the friction that the simulator assumed. So both can be given, and the choice may change from step to step. A
force beyond friction would accelerate a free object without bound. Therefore the object is pushed against a damper,
which takes no force while the object is at rest and lets an excess of 0.1 N slide it at 10 mm/s. The damper is solved
implicitly: in a slice it is a mass of damping times 1 ms, whose speed in the slice before is braked.

Not simulated: texture in the window, the outline of the object, vibration of the hand.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events, concatenate
from evetac_cli.kernels.slip.architectures import Sensitivity
from evetac_cli.sim.camera.gel_camera import GelCamera
from evetac_cli.sim.gel import contact
from evetac_cli.sim.gel.cell_gaps import CellGaps, cell_samples, gaps_of
from evetac_cli.sim.scenes.gel_view import GelView
from evetac_cli.sim.scenes.shared import STEP_S, GelSlices, friction_of, press, pressure_law, start_gel
from evetac_cli.sim.setup import object_file, plan, sampling
from evetac_cli.sim.setup.object_file import TouchedObject
from evetac_cli.sim.setup.parts import untimed
from evetac_cli.sim.setup.scene import GelSettings, Randomised, Scene, SceneTimes, Solver, with_given
from evetac_cli.sim.setup.sensor import Sensor
from evetac_cli.text_files import require_finite

SLICE_NS = SLICE_US * 1000
PUSHER_N_S_M = 10.0  # damping of the pusher: an excess of 0.1 N slides the object at 10 mm/s
PUSHER_ARM_M = 5e-3  # lever arm at which the same damper resists rotation
SURFACE_STEP_M = 1e-6  # a surface that has moved along the gel by less presses as before
STRIBECK_MM_S = 10.0  # about the middle of the range of evetac's scenes
# Beyond these limits a number is probably in the wrong unit.
LONGEST_S, FARTHEST_M, FASTEST_M_S, FASTEST_RAD_S, MOST_N = 10.0, 0.1, 10.0, 100.0, 1000.0


class Touch(NamedTuple):
    """Result of one step of a `TouchSensor`, simulated; forces and positions are those at the end of its last slice.

    slices: the events of each millisecond that ended in this step, none to many. dot_xy_px, displacement_px:
    (dots, 2), true centres of the dots and their displacements from rest.

    normal_n: normal force of the object on the gel. shear_n: its shear force, x and y, averaged over the last slice.

    indentation_m: of the gel, from first touch. place_m, turn_rad: position and rotation of the object.

    slip: whether the object slides as one body (gross slip). slip_share: share of the normal force on slipping nodes.

    >>> import numpy as np
    >>> sensor = evetac.TouchSensor(object=8, rng=np.random.default_rng(1))
    >>> touch = sensor.step(0.01, normal_n=2.0)
    >>> len(touch.slices), touch.normal_n, touch.slip
    (10, 2.0, False)
    """

    slices: tuple[Events, ...]
    dot_xy_px: Floats
    displacement_px: Floats
    normal_n: float
    shear_n: tuple[float, float]
    indentation_m: float
    place_m: tuple[float, float]
    turn_rad: float
    slip: bool
    slip_share: float

    @property
    def events(self) -> Events:
        """Return the events of all slices together."""
        return concatenate(list(self.slices))


class _Goal(NamedTuple):
    """Target of a step: `by` is the name of the argument, `values` are the numbers at the end of the step."""

    by: str
    values: tuple[float, ...]

    def toward(self, end: "_Goal", share: float) -> tuple[float, ...]:
        """Return the numbers at a fraction `share` of the path to another goal of the same kind."""
        if share == 1.0:
            return end.values
        return tuple(a + share * (b - a) for a, b in zip(self.values, end.values, strict=True))


class _Surface(NamedTuple):
    """An object's surface at a position (x, y, rotation) over the gel, and the limit at which the gel is pressed flat.

    stiffness_n_m: stiffness of a node. deepest_m, most_n: indentation and force at which the gel is pressed flat.
    """

    place: tuple[float, ...]
    gaps: CellGaps
    stiffness_n_m: float
    deepest_m: float
    most_n: float

    def is_near(self, place: tuple[float, ...]) -> bool:
        """Return whether the surface presses as it would at another position."""
        x_m, y_m, turn = (abs(to - since) for to, since in zip(place, self.place, strict=True))
        return max(x_m, y_m, turn * PUSHER_ARM_M) <= SURFACE_STEP_M

    def force_n(self, indentation_m: float) -> float:
        """Return the normal force at an indentation."""
        return min(self.stiffness_n_m * float(self.gaps.depth_m(indentation_m).sum()), self.most_n)

    def indentation_m(self, force_n: float) -> float:
        """Return the indentation under a normal force; without force, the indentation at first touch."""
        if self.most_n == 0.0:
            return self.deepest_m
        if force_n <= 0.0:
            return self.gaps.least_m
        return self.gaps.indentation_m(force_n / self.stiffness_n_m, self.deepest_m)


class TouchSensor:
    """A simulated sensor on one finger, for use in MuJoCo, PyBullet or your own loop; see `step`.

    sensor: a name from `evetac.sensors()` or a TOML file; `randomized` samples a sensor.

    object: a number of the paper's table, a TOML file for `--object`, or a table of its keys. Required keys are
    `static_friction` and `shape`: flat, which covers the pad, or a cylinder along x or a sphere, of `width_mm`.
    Optional keys are `kinetic_share` and `tilt_deg`. Mass, height and lever are those of your own simulator.

    rng: the only source of noise and of all other random values. gel: cut or closed. solver: as in `evetac.simulate`.

    at_m: initial position of the object's middle on the gel, x and y in m from the middle of the view. InputError for
    any other value.

    A sensor can be passed as the gel of `evetac.DotTracker` and `evetac.SlipDetector`.

    >>> import numpy as np
    >>> box = {"shape": "flat", "static_friction": 0.8}
    >>> sensor = evetac.TouchSensor(object=box, rng=np.random.default_rng(0))
    >>> detector = evetac.SlipDetector(sensor)
    >>> for shear_n in (0.0, 0.5, 1.0):
    ...     touch = sensor.step(0.02, normal_n=3.0, shear_n=(shear_n, 0.0))
    ...     for events in touch.slices:
    ...         probability = detector.step(events)
    >>> bool(touch.displacement_px[:, 0].mean() > 0.5), touch.slip
    (True, False)
    """

    def __init__(
        self,
        sensor: str = "evetac",
        object: int | str | Path | Mapping[str, Any] = 8,
        *,
        rng: np.random.Generator,
        gel: str = "cut",
        solver: Mapping[str, Any] = MappingProxyType({}),
        at_m: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        if gel not in ("cut", "closed"):
            raise _refused("unknown gel", "cut or closed", gel)
        mechanics, optics = rng.spawn(2)
        _, sensor_or_ranges = plan.named_sensor(sensor)
        one = (
            sensor_or_ranges
            if isinstance(sensor_or_ranges, Sensor)
            else sampling.sample_sensor(sensor_or_ranges, mechanics)
        )
        touched = _touched(object)
        share = touched.kinetic_share
        if share is None:
            share = sum(Randomised.kinetic_share) / 2
        scene = Scene(
            name="touch",
            kind="press",
            summary="another simulator drives the object",
            time=SceneTimes(),
            gel=GelSettings(cut=gel == "cut"),
            randomise=Randomised(kinetic_share=(share, share), stribeck_mm_s=(STRIBECK_MM_S, STRIBECK_MM_S)),
            solver=with_given(Solver(), solver, "TouchSensor"),
        )
        self.sampled = sampling.sample_trial(scene, replace(touched, kinetic_share=None), one, mechanics)
        self._camera = GelCamera(one, scene=scene, texture=None, rng=optics)
        self._build(one, touched, scene, _finite("at_m", at_m, 2, FARTHEST_M))
        self.dot_xy_px: Floats = self._camera.calibrated_grid_xy_px  # at rest, (rows, columns, 2)
        self.dot_radius_px = one.dot_radius_px
        self.window_px = self._camera.window_px
        self.frame_px = one.frame_px
        self.sensitivity: Sensitivity = one.sensitivity()

    def _build(self, sensor: Sensor, touched: TouchedObject, scene: Scene, at_m: tuple[float, ...]) -> None:
        mass_kg = PUSHER_N_S_M * STEP_S
        self._gel = start_gel(scene, sensor, mass_kg, mass_kg * PUSHER_ARM_M**2, 1, (at_m[0], at_m[1]))
        self._friction_factor, self._pressure_law = self._gel.friction_factor, pressure_law(self.sampled)
        self._samples_m = cell_samples(self._gel.node_xy_m)
        self._height_m = self._gel.material.height_m
        self._shape = (touched.shape, touched.width_mm * 0.5e-3, self.sampled.tilt_rad)
        self._node_stiffness_n_m = sensor.normal_modulus_pa / self._height_m * self._gel.cell_area_m2
        self._gel_slices = GelSlices(self._gel, scene.solver)
        self._friction = friction_of(self.sampled)
        self._view = GelView(self._camera, self._gel, scene.solver.camera_substeps, untimed)
        self._now_ns = self._slices = 0
        place = (at_m[0], at_m[1], 0.0)
        height_m = self._height_of_surface(place)
        self._touch_m = float(height_m.min()) if np.isfinite(height_m).any() else 0.0
        self._surface = self._next = self._surface_over(place, height_m - self._touch_m)
        self._looks_same = touched.shape == "flat" and self.sampled.tilt_rad == 0.0  # at every position
        self._pressed_m = math.nan  # indentation for which the shares of the nodes were computed
        self._moved_to: tuple[float, ...] | None = place  # target position of the last slice
        self._normal_n = self._indentation_m = 0.0
        self._shear_n: tuple[float, float] = (0.0, 0.0)
        self._pressing, self._moving = _Goal("normal_n", (0.0,)), _Goal("place_m", place)

    def step(
        self,
        dt_s: float,
        *,
        normal_n: float | None = None,
        indentation_m: float | None = None,
        shear_n: tuple[float, float] | None = None,
        place_m: tuple[float, float] | None = None,
        turn_rad: float | None = None,
    ) -> Touch:
        """Advance by dt_s; at the end of the step the contact is as given. Return what the sensor felt.

        Give at most one of normal_n, >= 0, and indentation_m. Indentation counts from first touch at the object's
        initial position and is negative off the gel. Without either, the last one stays.

        Give at most one of shear_n and place_m. The shear force shear_n is that of the object on the gel (x, y), in
        addition to the normal force. The position place_m is that of the middle of the object's surface, with turn_rad
        (from x to y). Without either, the object stays where it is.

        Each slice of 1 ms is computed when it ends, with the given values interpolated linearly. Two steps of 5 ms
        along a line equal ten steps of 1 ms, bit for bit if the numbers are.

        InputError, before any change, if a number is out of range, the gel would be pressed flat, or there is a shear
        force without normal force.
        """
        (seconds,) = _finite("dt_s", (dt_s,), 1, LONGEST_S)
        step_ns = round(seconds * 1e9)
        if step_ns <= 0:
            raise _refused("dt_s: the step has no duration", f"above 0, up to {LONGEST_S:g} s", f"{dt_s}")
        moving = self._wanted_motion(shear_n, place_m, turn_rad, seconds)
        pressing = self._wanted_pressure(normal_n, indentation_m, moving)
        if moving.by == "shear_n" and any(moving.values) and self._force_of(pressing, moving) == 0.0:
            raise _refused("shear_n: needs a normal force, found none", "(0, 0) without normal force", shear_n)
        pressed_from = self._pressing if self._pressing.by == pressing.by else self._present(pressing.by)
        moved_from = self._moving if self._moving.by == moving.by else self._present(moving.by)
        end_ns = self._now_ns + step_ns
        slices = []
        while (self._slices + 1) * SLICE_NS <= end_ns:
            share = ((self._slices + 1) * SLICE_NS - self._now_ns) / step_ns
            pressed, moved = pressed_from.toward(pressing, share), moved_from.toward(moving, share)
            slices.append(self._make_slice(_Goal(pressing.by, pressed), _Goal(moving.by, moved)))
        self._now_ns, self._pressing, self._moving = end_ns, pressing, moving
        return self._touch(tuple(slices))

    def _present(self, by: str) -> _Goal:
        """Return the present state, expressed as a goal of a kind other than the last."""
        x_m, y_m, turn = self._gel.pose.tolist()
        present = {
            "normal_n": (self._normal_n,),
            "indentation_m": (self._indentation_m,),
            "shear_n": self._shear_n,
            "place_m": (x_m, y_m, turn),
        }
        return _Goal(by, present[by])

    def _wanted_motion(
        self,
        shear_n: tuple[float, float] | None,
        place_m: tuple[float, float] | None,
        turn_rad: float | None,
        seconds: float,
    ) -> _Goal:
        if shear_n is not None:
            if place_m is not None or turn_rad is not None:
                raise _refused("shear_n together with a position", "a force or a position", "both")
            return _Goal("shear_n", _finite("shear_n", shear_n, 2, MOST_N))
        now = self._moving if self._moving.by == "place_m" else self._present("place_m")
        x_m, y_m, turn = now.values
        if place_m is not None:
            x_m, y_m = _finite("place_m", place_m, 2, FARTHEST_M)
        if turn_rad is not None:
            (turn,) = _finite("turn_rad", (turn_rad,), 1, math.inf)
        fast_m_s = math.hypot(x_m - now.values[0], y_m - now.values[1]) / seconds
        if fast_m_s > FASTEST_M_S or abs(turn - now.values[2]) / seconds > FASTEST_RAD_S:
            expected = f"up to {FASTEST_M_S:g} m/s and {FASTEST_RAD_S:g} rad/s; at_m sets the object's initial position"
            turns = abs(turn - now.values[2]) / seconds
            raise _refused("place_m: too fast", expected, f"{fast_m_s:.4g} m/s, {turns:.4g} rad/s")
        return _Goal("place_m", (x_m, y_m, turn))

    def _wanted_pressure(self, normal_n: float | None, indentation_m: float | None, moving: _Goal) -> _Goal:
        if normal_n is not None and indentation_m is not None:
            raise _refused("normal_n together with indentation_m", "one of the two", "both")
        if normal_n is None and indentation_m is None:
            return self._pressing
        surface = self._pressed_at(self._end_of(moving))
        if normal_n is not None:
            (force,) = _finite("normal_n", (normal_n,), 1, math.inf)
            if not 0.0 <= force <= surface.most_n:
                most = f"0 to {surface.most_n:.4g} N; more would press the gel flat"
                raise _refused("normal_n: out of range", most, f"{force}")
            return _Goal("normal_n", (force,))
        (depth,) = _finite("indentation_m", (indentation_m,), 1, FARTHEST_M)
        if depth > surface.deepest_m:
            raise _refused("indentation_m: presses the gel flat", f"up to {surface.deepest_m:.4g} m", f"{depth}")
        return _Goal("indentation_m", (depth,))

    def _end_of(self, moving: _Goal) -> tuple[float, ...]:
        """Return the surface's position at the end of a step, as far as it is known before the step."""
        return moving.values if moving.by == "place_m" else self._present("place_m").values

    def _force_of(self, pressing: _Goal, moving: _Goal) -> float:
        """Return the normal force at the end of a step."""
        if pressing.by == "normal_n":
            return pressing.values[0]
        return self._pressed_at(self._end_of(moving)).force_n(pressing.values[0])

    def _height_of_surface(self, place: tuple[float, ...]) -> Floats:
        """Return the height of the surface over each cell's points at x, y, rotation; infinite outside a round one."""
        x_m, y_m, turn = place
        return contact.surface(self._samples_m, *self._shape, place=(x_m, y_m, turn), round_ends=True)

    def _pressed_at(self, place: tuple[float, ...]) -> _Surface:
        """Return the object's surface at a position; the present one if it is near enough.

        A surface that was computed for an earlier query is reused only for exactly the same position. So results do not
        depend on earlier queries.
        """
        if self._looks_same or self._surface.is_near(place):
            return self._surface
        if self._next.place == place:
            return self._next
        self._next = self._surface_over(place, self._height_of_surface(place) - self._touch_m)
        return self._next

    def _surface_over(self, place: tuple[float, ...], gap_m: Floats) -> _Surface:
        """Build a surface at a position from its gaps over each cell's points; off the pad nothing is pressed."""
        gaps, stiffness_n_m = gaps_of(gap_m), self._node_stiffness_n_m
        least_m = gaps.least_m
        if not math.isfinite(least_m):
            return _Surface(place, gaps, stiffness_n_m, FARTHEST_M, 0.0)
        deepest_m = least_m + self._height_m
        most_n = stiffness_n_m * float(gaps.depth_m(deepest_m).sum())
        return _Surface(place, gaps, stiffness_n_m, deepest_m, most_n)

    def _make_slice(self, pressed: _Goal, moved: _Goal) -> Events:
        """Compute one slice, at the end of which the contact is as given."""
        before_n = self._normal_n
        twist, push_n = None, (0.0, 0.0, 0.0)
        if moved.by == "place_m":
            last = self._moved_to if self._moved_to is not None else self._present("place_m").values
            vx, vy, turning = ((to - since) / STEP_S for to, since in zip(moved.values, last, strict=True))
            twist = (vx, vy, turning)
            self._moved_to = moved.values
        else:
            speed = self._gel.twist.tolist()
            push_n = (
                moved.values[0] - PUSHER_N_S_M * speed[0],
                moved.values[1] - PUSHER_N_S_M * speed[1],
                -PUSHER_N_S_M * PUSHER_ARM_M**2 * speed[2],
            )
            self._moved_to = None
        surface = self._pressed_at(self._end_of(moved))
        if pressed.by == "normal_n":
            self._normal_n = pressed.values[0]
            self._indentation_m = surface.indentation_m(self._normal_n)
        else:
            self._indentation_m = pressed.values[0]
            self._normal_n = surface.force_n(self._indentation_m)
        pressed_as_before = surface is self._surface and self._indentation_m == self._pressed_m
        if not pressed_as_before:
            self._surface, self._pressed_m = surface, self._indentation_m
            factor, law = self._friction_factor, self._pressure_law
            self._shares = press(self._gel, self._indentation_m, surface.gaps, factor, law)
            self._view.press(surface.gaps.depth_m(self._indentation_m))
        normal_n = (before_n, self._normal_n)
        done = self._gel_slices.advance(self._shares, normal_n, push_n, self._friction, twist, self._view.begin())
        self._view.follow(self._shares, self._normal_n, self._gel_slices.still_for)
        self._shear_n = done.friction_n[:2]
        still = self._gel_slices.still_for > 0 and pressed_as_before
        self._slices += 1
        return self._view.see(self._slices - 1, still=still)

    def _touch(self, slices: tuple[Events, ...]) -> Touch:
        slip = self._view.slip.truth()
        x_m, y_m, turn = self._gel.pose.tolist()
        dot_xy_px = self._camera.dot_xy_px.copy()
        return Touch(
            slices,
            dot_xy_px,
            dot_xy_px - self._camera.grid_xy_px.reshape(-1, 2),
            self._normal_n,
            (float(self._shear_n[0]), float(self._shear_n[1])),
            self._indentation_m,
            (x_m, y_m),
            turn,
            bool(slip["truth/slip"]),
            float(slip["truth/slip_share"]),
        )


def _touched(source: int | str | Path | Mapping[str, Any]) -> TouchedObject:
    """Return the object: from the table, or your own; InputError if it is neither."""
    if isinstance(source, str | Path):
        return object_file.read(Path(source))[1]
    if not isinstance(source, Mapping):
        return object_file.of_number(source)
    where = "TouchSensor(object=...)"
    table = {str(key): value.item() if isinstance(value, np.generic) else value for key, value in source.items()}
    require_finite(table, where)
    is_round = table.get("shape") in ("cylinder", "sphere")
    touched = object_file.of_keys(table, where, ("width_mm",) if is_round else ())
    return replace(touched, tilt_deg=touched.tilt_deg or (0.0, 0.0))


def _finite(name: str, values: Any, count: int, most: float) -> tuple[float, ...]:
    """Return `count` finite numbers of at most this size; InputError for anything else."""
    try:
        numbers = tuple(float(number) for number in values)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != count or not all(math.isfinite(number) and abs(number) <= most for number in numbers):
        size = "finite" if math.isinf(most) else f"within {most:g}"
        one = values[0] if count == 1 else values
        raise _refused(f"{name}: invalid value", f"{count} number{'s' * (count > 1)}, {size}", one)
    return numbers


def _refused(message: str, expected: str, found: Any) -> InputError:
    return InputError(message, where="TouchSensor", expected=expected, found=str(found)[:100])
