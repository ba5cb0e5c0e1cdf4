"""Parts that scenes share: the pad of gel nodes, the gel of a sensor, its friction, and the stepping of slices."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.events import SLICES_PER_S
from evetac_cli.sim.gel import contact, gel
from evetac_cli.sim.gel.adaptive import Slice, Stepper
from evetac_cli.sim.gel.cell_gaps import CellGaps
from evetac_cli.sim.gel.friction import PressureLaw, varied
from evetac_cli.sim.setup.parts import GEL, Timer, untimed
from evetac_cli.sim.setup.sampling import SampledTrial
from evetac_cli.sim.setup.scene import FrictionChange, Scene, Solver
from evetac_cli.sim.setup.sensor import PAD_M, Sensor

STEP_S = 1e-3  # duration of a slice
GRAVITY_M_S2 = 9.81

FRICTION_SEED = 15485867  # with a sensor's seed: where on its gel friction is higher or lower

LOSS_AT_HZ = 100.0  # frequency of a sensor's loss_tangent


def pad(solver: Solver, sensor: Sensor, *, cut: bool) -> NDArray[np.float64]:
    """Return the gel nodes (rows, columns, 2) in m: a cut gel ends at the window, a closed one at the frame's edge."""
    columns, rows = solver.nodes(PAD_M)
    x0, y0, x1, y1 = sensor.pad_m(cut=cut)
    return contact.pad_nodes(round(columns * (x1 - x0) / PAD_M[0]), rows, (x0, x1), (y0, y1))


def material(sensor: Sensor) -> gel.GelMaterial:
    """Return the gel of a sensor: `GelMaterial` with the sensor's shear modulus, creep and loss tangent.

    The model is a spring, a dashpot tau and Maxwell arms (shares g, times t). Its loss tangent at w is
    `(w tau + sum g wt / (1 + wt^2)) / (1 + sum g wt^2 / (1 + wt^2))`. The time tau is chosen to reach the sensor's loss
    tangent. ValueError if the arms alone lose more.
    """
    creep, tangent = sensor.creep, sensor.loss_tangent
    usual = gel.GelMaterial(
        shear_modulus_pa=sensor.shear_modulus_pa,
        creep_share=() if creep is None else creep.share,
        creep_time_s=() if creep is None else creep.time_s,
    )
    if tangent is None:
        return usual
    omega = 2 * np.pi * LOSS_AT_HZ
    stored, lost_in_arms = 1.0, 0.0
    for share, time_s in usual.arms:
        turn = omega * time_s
        stored += share * turn**2 / (1 + turn**2)
        lost_in_arms += share * turn / (1 + turn**2)
    viscous_time_s = (tangent * stored - lost_in_arms) / omega
    if viscous_time_s < 0.0:
        least = lost_in_arms / stored
        raise ValueError(
            f"loss_tangent of the sensor must be at least {least:.3g}, the loss of its gel's arms, found {tangent}"
        )
    return replace(usual, viscous_time_s=viscous_time_s)


def start_gel(
    scene: Scene,
    sensor: Sensor,
    mass_kg: float,
    inertia_kg_m2: float,
    pads: int = 1,
    body_xy_m: tuple[float, float] = (0.0, 0.0),
) -> gel.GelState:
    """Return the undeformed gel of a sensor in a scene, and an object at rest on it, as from `gel.start`."""
    nodes = pad(scene.solver, sensor, cut=scene.gel.cut)
    varies = friction_factor(sensor, nodes)
    body = (mass_kg, inertia_kg_m2, pads)
    return gel.start(nodes, material(sensor), *body, body_xy_m=body_xy_m, friction_factor=varies)


def friction_of(sampled: SampledTrial) -> gel.Friction:
    """Return the friction of a trial."""
    return gel.Friction(
        sampled.static_friction, sampled.kinetic_friction, sampled.stribeck_m_s, sampled.friction_memory_m
    )


def friction_after(change: FrictionChange | None, friction: gel.Friction) -> tuple[int, gel.Friction]:
    """Return the slice in which the friction of the whole contact changes, and the friction from then on.

    It changes at once, as if the contact reached a wet patch; the slice is -1 if it never changes.
    """
    if change is None:
        return -1, friction
    static, kinetic = friction.static * change.factor, friction.kinetic * change.factor
    return round(change.at_s * SLICES_PER_S), replace(friction, static=static, kinetic=kinetic)


def friction_factor(sensor: Sensor, node_xy_m: Floats, finger: int = 0) -> Floats | None:
    """Return the factor on each node's friction if the sensor sets friction.patch_spread and patch_mm, else None.

    The pattern belongs to the gel: it is drawn from the sensor's own seed and is the same in all trials and scenes. The
    second finger (1) has another pattern.
    """
    spread, patch_mm = sensor.friction.patch_spread, sensor.friction.patch_mm
    assert (spread is None) == (patch_mm is None)
    if not spread or patch_mm is None:
        return None
    rng = np.random.default_rng([sensor.seed, FRICTION_SEED, finger])
    return varied(node_xy_m, spread, patch_mm * 1e-3, rng)


def pressure_law(sampled: SampledTrial) -> PressureLaw | None:
    """Return the dependence of a trial's friction on pressure; None if friction is proportional to pressure."""
    return PressureLaw(sampled.pressure_exponent) if sampled.pressure_exponent > 0.0 else None


def press(
    state: gel.GelState, indentation_m: float, gaps: CellGaps, own_factor: Floats | None, law: PressureLaw | None
) -> Floats:
    """Return each node's share of the normal force at an indentation, and set the gel's friction factor.

    own_factor: (rows, columns), factor on the friction of each node at any pressure, from `friction_factor`.
    """
    shares = contact.pressure(indentation_m, gaps, 1.0)
    state.friction_factor = own_factor
    if law is not None:
        factor = law.factor(indentation_m, gaps, shares)
        state.friction_factor = factor if own_factor is None else factor * own_factor
    return shares


class GelSlices:
    """Advances gel and object slice by slice; skips slices in which nothing would change.

    A slice is skipped if all forces and motions are those of the slice before, and that slice left gel and object
    unchanged, bit for bit. `still_for` counts such slices.
    """

    def __init__(
        self,
        pad_state: gel.GelState,
        solver: Solver,
        second: gel.GelState | None = None,
        timer: Timer = untimed,
    ) -> None:
        """Start with a pad, and the second finger's pad if it does not mirror the first (see `Stepper`)."""
        self._gel = pad_state
        self._pads = (pad_state,) if second is None else (pad_state, second)
        self._advance = timer(GEL.name, Stepper(solver, second=second).advance)
        self._least_steps = solver.fixed_steps or 1  # steps of a slice that needs no refinement
        self._done = Slice()
        self._acting: tuple[Any, ...] = ()
        self._shares = self._second_shares = np.zeros(0)
        self._before = tuple(one.copy() for one in self._pads)
        self._rests = False
        self.still_for = 0

    def advance(
        self,
        shares: Floats,
        force_n: tuple[float, float],
        body_force_n: tuple[float, float, float],
        friction: gel.Friction,
        twist: tuple[float, float, float] | None,
        each: Callable[[gel.StepInfo, float], None] | None = None,
        second_shares: Floats | None = None,
    ) -> Slice:
        """Advance by a slice, like `Stepper.advance`; `twist` is the object's velocity if it is prescribed."""
        state = self._gel
        body = (state.pose.tolist(), state.twist.tolist(), state.inertia.tolist())
        acting = (force_n, body_force_n, friction, twist, body)
        same = acting == self._acting and (shares is self._shares or np.array_equal(shares, self._shares))
        if second_shares is not None:
            same = same and np.array_equal(second_shares, self._second_shares)
            self._second_shares = second_shares
        if same and self._rests and each is None:
            self.still_for += 1
            return self._done
        self._acting, self._shares = acting, shares
        self._done = self._advance(
            state, shares, force_n, body_force_n, friction, twist, each, second_shares=second_shares
        )
        self.still_for = 0
        self._rests = same and self._done.steps == self._least_steps and self._has_come_to_rest()
        return self._done

    def _has_come_to_rest(self) -> bool:
        """Return whether the slice left gel and object unchanged; motion below the thresholds is set to 0."""
        for state in self._pads:
            if state.twist.any() or not state.settle():
                return False
        if all(state.is_as(before) for state, before in zip(self._pads, self._before, strict=True)):
            return True
        for state, before in zip(self._pads, self._before, strict=True):
            before.restore(state)
        return False

    def truth(self, most_n: float = math.inf) -> dict[str, Any]:
        """Return the steps and error of the last slice, and whether the nodes resolve unstable slip, by schema path.

        most_n: upper limit of a slipping node's normal force, for what the nodes resolve.
        """
        done, half = self._done, math.inf
        slipping_n = min(done.slipping_force_n, most_n)
        if slipping_n > 0.0:
            _, _, friction, *_ = self._acting
            half = gel.slip_half_wavelength_nodes(self._gel, friction, slipping_n)
        return {
            "truth/mechanical_steps": done.steps,
            "truth/estimated_error_um": done.error_m * 1e6,
            "truth/slip_half_wavelength_nodes": half if math.isfinite(half) else math.nan,
        }
