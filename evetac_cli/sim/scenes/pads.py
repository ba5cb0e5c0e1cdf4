"""The gel between the fingers and a held object: pressure, friction and motion of one pad, or of two that differ.

One pad stands for two that mirror each other. Both are simulated if the second finger differs, or has a camera. Both
press with the same force and hold the same rigid object. The second pad has its own friction and stiffness, and so its
own indentation, contact and shear. Two effects are not simulated. The object does not tip when one finger carries more
than the other, which would shift the pressure along each pad. And if the second sensor is another one, only its level
of friction and its pattern on the gel are used, and its gel ends where the first one's does.

The second sensor faces the first: it is the first sensor, rotated by half a turn about the fingers' long axis, which is
x of the image. So motion along x is the same in both images; motion along y and rotations are reversed. Both pads are
simulated in the coordinates of the first sensor.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.events import SLICES_PER_S
from evetac_cli.sim import gripper
from evetac_cli.sim.gel import contact, gel
from evetac_cli.sim.gel.adaptive import Slice, Stepper
from evetac_cli.sim.gel.cell_gaps import CellGaps
from evetac_cli.sim.gel.friction import PressureLaw
from evetac_cli.sim.gel.roughness import Roughness
from evetac_cli.sim.scenes.gel_view import GelView
from evetac_cli.sim.scenes.shared import (
    GRAVITY_M_S2,
    GelSlices,
    friction_factor,
    friction_of,
    material,
    press,
    pressure_law,
    start_gel,
)
from evetac_cli.sim.setup.held import SecondFingerSettings
from evetac_cli.sim.setup.parts import Timer
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.sampling import SampledTrial

FINGER_STIFFNESS_N_M = 1.8e3  # of the gap, from fingers, links and mounts; fitted to the paper's two bottles
CLOSING_S, CLOSING_STEPS = 0.5, 10  # time and steps in which a finger closes on a ramp's object, before the trial

Three = tuple[float, float, float]


class SecondFinger:
    """A second pad: its friction and stiffness relative to the first, its pressure, and its gel."""

    state: gel.GelState
    shares: Floats

    def __init__(self, plan: Plan) -> None:
        """Build the pad; if friction varies over the gel, this pad has its own pattern."""
        settings = plan.scene.gripper.second_finger or SecondFingerSettings()
        first = plan.sensor
        own = self._sensor = first if plan.second is None else plan.second.sensor
        self._shear_factor = settings.stiffness_factor
        self.stiffness_factor = settings.stiffness_factor * (own.normal_modulus_pa / first.normal_modulus_pa)
        self._friction = settings.friction_factor * (own.static_friction_factor / first.static_friction_factor)
        self.indentation_m = 0.0

    def start(self, first: gel.GelState) -> gel.GelState:
        """Start the gel, undeformed; it holds the object of the first pad."""
        varies = friction_factor(self._sensor, first.node_xy_m, finger=1)
        even = np.full(first.node_xy_m.shape[:2], self._friction)
        self.friction_factor: Floats = even if varies is None else even * varies
        of_sensor = material(self._sensor)
        layer = replace(of_sensor, shear_modulus_pa=of_sensor.shear_modulus_pa * self._shear_factor)
        mass_kg, _, inertia = first.inertia.tolist()
        self.state = gel.start(first.node_xy_m, layer, mass_kg, inertia, 1, friction_factor=self.friction_factor)
        return self.state

    def press(self, curve: contact.ForceCurve, closing_ticks: float, gaps: CellGaps, law: PressureLaw | None) -> None:
        """Compute each node's share of the normal force at a closing of the gripper."""
        assert curve.second_indentation_m is not None
        self.indentation_m = contact.lookup(curve.second_indentation_m, curve.step_ticks, closing_ticks)
        self.shares = press(self.state, self.indentation_m, gaps, self.friction_factor, law)


class Pads:
    """Both pads and the object that they hold; `press` and then `advance` perform a slice.

    first: the gel of the first finger, with pose and motion of the object; second: the other pad if it differs. gaps:
    between object and undeformed gel. friction: that of the trial. curve: force and indentation over the closing of the
    gripper. views: followed through the steps of a slice.
    """

    def __init__(self, plan: Plan, sampled: SampledTrial, of_surface: np.random.Generator, timer: Timer) -> None:
        """Place the object between undeformed pads, without pressure; of_surface: random stream of its roughness."""
        scene, object, sensor = plan.scene, plan.object, plan.sensor
        assert object is not None
        self._sampled, self._solver, self.friction = sampled, scene.solver, friction_of(sampled)
        self.down = 1 if scene.gel.sideways else 0
        width_m, height_m = object.held_mm * 1e-3, object.height_mm * 1e-3
        mass_kg, (along, across) = sampled.mass_kg, sampled.touch_m
        middle_m = (across + sampled.lever_m, along) if self.down else (along, across + sampled.lever_m)
        self.second = SecondFinger(plan) if plan.fingers_differ else None
        pads = 2 if self.second is None else 1
        self.first = start_gel(scene, sensor, mass_kg, mass_kg * (height_m**2 + width_m**2) / 12, pads, middle_m)
        self.friction_factor, self.law = self.first.friction_factor, pressure_law(sampled)
        nodes, layer = self.first.node_xy_m, self.first.material
        upright = np.ascontiguousarray(nodes[..., ::-1]) if self.down else nodes
        radius_m = object.width_mm * 0.5e-3
        self.gaps = contact.gap_profile(upright - sampled.touch_m, object.shape, radius_m, sampled.tilt_rad)
        own_stiffness = sensor.gripper.finger_stiffness_n_m
        self.curve = contact.force_curve(
            self.gaps,
            sensor.normal_modulus_pa / layer.height_m * self.first.cell_area_m2,
            layer.height_m,
            FINGER_STIFFNESS_N_M if own_stiffness is None else own_stiffness,
            gripper.metres_per_tick(width_m),
            second_stiffness=None if self.second is None else self.second.stiffness_factor,
        )
        second_pad = None if self.second is None else self.second.start(self.first)
        self._states = (self.first,) if second_pad is None else (self.first, second_pad)
        self._roughness: tuple[Roughness, ...] = ()
        if (rough := scene.roughness) is not None:
            values = (rough.friction_sd, rough.length_mm * 1e-3)
            self._roughness = tuple(Roughness(state, *values, of_surface) for state in self._states)
        self._smooth: list[Floats | None] = []  # friction factors of the states without roughness
        self.slip_limit_n = self._limit_n(mass_kg)
        self._slices = GelSlices(self.first, self._solver, second_pad, timer)
        self._before = tuple(state.copy() for state in self._states)  # a slice may have to be repeated
        self._force_n = 0.0  # the largest of the last slice
        self._pressed_m = math.nan  # indentation for which the shares of the nodes were computed
        self.views: tuple[GelView, ...] = ()

    @property
    def still_for(self) -> int:
        """Return the number of slices in which nothing has changed."""
        return self._slices.still_for

    def solver_truth(self) -> dict[str, Any]:
        """Return the resolution of the last slice, by schema path.

        A pattern of slip that the nodes resolve spans several spots of a rough object, so their mean friction counts.
        """
        slips = self.first.slip_m_s > 0.0
        if not self._roughness or not slips.any():
            return self._slices.truth()
        smooth = self._smooth[0]
        shares = self.shares if smooth is None else self.shares * smooth
        return self._slices.truth(self._force_n * float(shares[slips].max()))

    def press(self, finger: gripper.DriveState) -> None:
        """Compute each node's share of the normal force at a finger's position."""
        if finger.indentation_m != self._pressed_m:
            self._pressed_m = finger.indentation_m
            self.shares = press(self.first, self._pressed_m, self.gaps, self.friction_factor, self.law)
            if self.second is not None:
                self.second.press(self.curve, finger.closing_ticks, self.gaps, self.law)
            self._smooth = [state.friction_factor for state in self._states]

    def _roughen(self, lasts_s: float) -> None:
        """Set the friction of the nodes to that of the spots of the object on which they are, or slide."""
        for state, smooth, roughness in zip(self._states, self._smooth, self._roughness, strict=False):
            spots = roughness.factor(lasts_s)
            state.friction_factor = spots if smooth is None else smooth * spots

    def advance(
        self,
        force_n: tuple[float, float],
        friction: gel.Friction,
        weight_n: float,
        speed_m_s: float | None = None,
    ) -> Slice:
        """Solve a slice of the gel under a force on the object along gravity, or for an object that moves at a speed.

        force_n: normal force at start and end of the slice.
        """
        self._roughen(1 / SLICES_PER_S)
        self._force_n = max(force_n)
        callbacks = [each for view in self.views if (each := view.begin()) is not None]
        each = _all(callbacks) if len(callbacks) > 1 else callbacks[0] if callbacks else None
        twist = None if speed_m_s is None else self._along_gravity(speed_m_s)
        second_shares = None if self.second is None else self.second.shares
        body_n = self._along_gravity(weight_n)
        return self._slices.advance(self.shares, force_n, body_n, friction, twist, each, second_shares=second_shares)

    def remember(self) -> None:
        """Keep the present state, to which `rewind` returns."""
        for state, before in zip(self._states, self._before, strict=True):
            before.restore(state)

    def rewind(self) -> None:
        """Return to the state at the last `remember`."""
        for state, before in zip(self._states, self._before, strict=True):
            state.restore(before)

    def close(self, finger: gripper.DriveState) -> None:
        """Let the gel follow a finger that closes to its initial position; then it rests on the free object as long.

        If the gel was squeezed at once it would creep for some 15 slices. The camera, which starts with dots at rest,
        would see them jump in the first two slices.
        """
        slow = replace(self._solver, theta=1.0)  # no oscillation while the finger closes
        stepper = Stepper(slow, CLOSING_S / CLOSING_STEPS, *self._states[1:])
        end_ticks, end_m, end_n = finger.closing_ticks, finger.indentation_m, finger.force_n
        before_n = 0.0
        for step in range(2 * CLOSING_STEPS):
            finger.closing_ticks = end_ticks * min((step + 1) / CLOSING_STEPS, 1.0)
            finger.indentation_m, finger.force_n = (
                contact.lookup(table, self.curve.step_ticks, finger.closing_ticks)
                for table in (self.curve.indentation_m, self.curve.force_n)
            )
            self.press(finger)
            self._roughen(CLOSING_S / CLOSING_STEPS)
            second_shares = None if self.second is None else self.second.shares
            force_n, nothing = (before_n, finger.force_n), (0.0, 0.0, 0.0)
            twist = nothing if step < CLOSING_STEPS else None
            stepper.advance(
                self.first, self.shares, force_n, nothing, self.friction, twist, second_shares=second_shares
            )
            before_n = finger.force_n
        finger.closing_ticks, finger.indentation_m, finger.force_n = end_ticks, end_m, end_n

    @property
    def carried_kg(self) -> float:
        """Return the mass of the object, with a weight that fell on it."""
        return float(self.first.inertia[0])

    def catch(self, weight_kg: float, speed_m_s: float) -> None:
        """Let a weight land on the object inelastically, at a speed along gravity; it stays there."""
        carried_kg = self.carried_kg + weight_kg
        speed = self.first.twist[self.down]
        self.first.twist[self.down] = speed + weight_kg / carried_kg * (speed_m_s - speed)
        self.first.inertia[:2] = carried_kg
        self.slip_limit_n = self._limit_n(carried_kg)

    def nodes_of_slip(self, grip: float) -> float:
        """Return half the wavelength of unstable slip at the highest pressure, in nodes; infinity if slip is stable.

        grip: normal force over the slip limit. The friction is that before the scene changes it. A recording contains
        the wavelength for nodes that slipped, under the friction at that time (truth/slip_half_wavelength_nodes).
        """
        force_n = grip * self.slip_limit_n
        most_n = force_n * float(self._gripping(force_n, self.curve.indentation_m).max())
        return gel.slip_half_wavelength_nodes(self.first, self.friction, most_n)

    def _limit_n(self, mass_kg: float) -> float:
        """Return the normal force at which an object of this mass slides or, if it hangs off-centre, turns.

        The forces and moments that friction can resist together form an ellipse (Howe and Cutkosky, Int. J. Robotics
        Research 15, 1996). The contact area is that under the force without the moment, which is smaller, and at least
        one node: a square resists a moment of 0.38 of its side. If friction varies over gel or object, or differs on
        the second finger, the friction within this contact counts.
        """
        limit_n = mass_kg * GRAVITY_M_S2 / (2 * self._sampled.static_friction)
        if self.friction_factor is not None or self.second is not None or self._roughness:
            limit_n /= self._mean_friction(limit_n)
        if self._sampled.lever_m == 0.0:
            return limit_n
        nodes = self.first.node_xy_m
        arm_m = contact.turning_arm(nodes, self._gripping(limit_n, self.curve.indentation_m))
        arm_m = max(arm_m, 0.38 * math.sqrt(contact.cell_area(nodes)))
        return limit_n * math.hypot(1.0, self._sampled.lever_m / arm_m)

    def _mean_friction(self, force_n: float) -> float:
        """Return the mean friction of both pads relative to the trial's, weighted by each node's holding force."""
        pads = [(self.friction_factor, self.curve.indentation_m)]
        if self.second is not None and self.curve.second_indentation_m is not None:
            pads.append((self.second.friction_factor, self.curve.second_indentation_m))
        means = []
        for place, (factor, table_m) in enumerate(pads):
            shares = self._gripping(force_n, table_m)
            if self._roughness:
                shares = shares * self._roughness[place].factor(0.0)
            means.append(float((shares if factor is None else shares * factor).sum()) or 1.0)
        return float(np.mean(means)) or 1.0

    def _gripping(self, force_n: float, table_m: Floats) -> Floats:
        """Return each node's share of the friction limit of a contact under a force, for uniform friction of the gel.

        table_m: the pad's indentation over the closing.
        """
        indentation_m = float(np.interp(force_n, self.curve.force_n, table_m))
        shares = contact.pressure(indentation_m, self.gaps, 1.0)
        return shares if self.law is None else shares * self.law.factor(indentation_m, self.gaps, shares)

    def _along_gravity(self, value: float) -> Three:
        """Return a force or a velocity (x, y, rotation) that points down."""
        return (0.0, value, 0.0) if self.down else (value, 0.0, 0.0)


def _all(callbacks: list[Callable[..., None]]) -> Callable[..., None]:
    """Return a function that calls others, one after the other."""

    def call(*arguments: Any) -> None:
        for each in callbacks:
            each(*arguments)

    return call
