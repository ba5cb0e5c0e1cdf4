"""The object in the gripper: where it is, what pushes it, and what carries it besides the fingers.

The table is a plane in the gripper's frame, which sinks as the hand rises. The hand that carries the gripper follows a
planned rise; a jerk and the vibration of the robot are added to it. The planned motion is a trapezoid of speed, a
trapezoid with smooth corners (s-curve), or a trapezoid in steps. Steps are those of a robot controller that updates its
speed at 125 Hz; users report 125 Hz for Universal Robots' CB3 controllers and 500 Hz for the e-series. A vibration is a
sum of sine waves of acceleration with random phases.

The hand is controlled by speed, and its acceleration in a slice is the change of that speed. So motion and inertia
agree to the bit. A vibration that began or ended at once would be a knock, so it fades in and out over FADE_S.
"""

import math

import numpy as np

from evetac_cli.events import SLICES_PER_S
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.adaptive import Slice
from evetac_cli.sim.scenes.pads import Pads
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2, STEP_S
from evetac_cli.sim.setup.held import HandVibration
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.sampling import SampledTrial

CONTROLLER_HZ = 125.0  # update rate of the robot controller, for the profile `steps`
FADE_S = 0.05  # time over which a vibration fades in and out
GONE_M = 0.02  # an object that slid this far is lost


class ShakenHand:
    """Vibration of the robot that carries the gripper."""

    def __init__(self, vibration: HandVibration, rng: np.random.Generator) -> None:
        """Draw the random phases."""
        self.only_moving = vibration.only_moving
        self._turning = 2 * np.pi * np.array(vibration.frequency_hz, dtype=np.float64)
        self._swing_m_s = np.array(vibration.acceleration_m_s2, dtype=np.float64) / self._turning
        self._phase_rad = rng.uniform(0.0, 2 * np.pi, len(self._turning))

    def speed_m_s(self, now_s: float, fades_s: float) -> float:
        """Return the speed: for each acceleration A sin(w t + p), -A/w cos(w t + p).

        fades_s: time since the vibration began, or until it ends.
        """
        if fades_s <= 0.0:
            return 0.0
        strength = 1.0 if fades_s >= FADE_S else 0.5 - 0.5 * math.cos(math.pi * fades_s / FADE_S)
        return -strength * float((self._swing_m_s * np.cos(self._turning * now_s + self._phase_rad)).sum())


class Hand:
    """Speed of a hand along gravity, positive upwards, slice by slice."""

    def __init__(self, plan: Plan, rng: np.random.Generator) -> None:
        """Build a hand at rest; rng: source of its vibration's phases."""
        settings, time = plan.scene.hand, plan.scene.time
        self._rises_at_s = time.touch_s + time.before_rise_s
        self._height_m = settings.height_mm * 1e-3
        self._fastest_m_s = settings.speed_mm_s * 1e-3
        self._profile = settings.profile
        self._starts_for_s = self._fastest_m_s / (settings.acceleration_mm_s2 * 1e-3)
        if self._profile == "s-curve":
            self._starts_for_s *= 0.5 * math.pi  # so that the peak acceleration is the scene's acceleration_mm_s2
        self._jerk = settings.jerk
        self._vibration = None if settings.vibration is None else ShakenHand(settings.vibration, rng)
        self._never_moves = settings.is_still
        self.speed_m_s = 0.0

    def accelerate(self, slice_number: int) -> float:
        """Advance by a slice: set speed_m_s to the speed at its end, and return the acceleration in the slice."""
        if self._never_moves:
            return 0.0
        now_s, before_m_s = (slice_number + 1) * STEP_S, self.speed_m_s
        since_s = now_s - self._rises_at_s
        self.speed_m_s = self._planned_m_s(since_s)
        if self._jerk is not None:
            self.speed_m_s += self._jerk.at(now_s)
        if self._vibration is not None:
            fades_s = now_s
            if self._vibration.only_moving:
                fades_s = min(since_s, self._height_m / self._fastest_m_s + self._starts_for_s - since_s)
            self.speed_m_s += self._vibration.speed_m_s(now_s, fades_s)
        return (self.speed_m_s - before_m_s) / STEP_S

    def _planned_m_s(self, since_s: float) -> float:
        """Return the speed of the planned motion, which rises by the scene's height, a time after its start."""
        if self._height_m == 0.0:
            return 0.0
        if self._profile == "steps":
            since_s = math.floor(since_s * CONTROLLER_HZ + 1e-9) / CONTROLLER_HZ
        ramp_s, cruise_s = self._starts_for_s, self._height_m / self._fastest_m_s
        done = min(max(min(since_s, cruise_s + ramp_s - since_s) / ramp_s, 0.0), 1.0)
        if self._profile == "s-curve":
            done = 0.5 - 0.5 * math.cos(math.pi * done)
        return self._fastest_m_s * done


class HeldObject:
    """The object between the pads: its motion, under pushes and a falling weight, and what carries it besides them.

    That is a table, the floor, or something that hands it over to the fingers. pulls: gravity plus the hand's
    acceleration, divided by gravity. table_m: how far the table has sunk.
    """

    def __init__(self, plan: Plan, sampled: SampledTrial, pads: Pads, lift_s: float, rng: np.random.Generator) -> None:
        """Start with the object where the pads hold it, and a hand at rest; rng: random stream of the hand."""
        self._kind, self._theta, self._floor_m = plan.scene.kind, plan.scene.solver.theta, sampled.floor_m
        self._time, self._pushes, self._drop = plan.scene.time, plan.scene.push, plan.scene.drop
        after_s = 0.0 if self._drop is None else self._drop.after_s
        self._drops_at = round((self._time.touch_s + lift_s) * SLICES_PER_S) + round(after_s * SLICES_PER_S)
        self._pads, self._hand = pads, Hand(plan, rng)
        self._starts_at_m = float(pads.first.pose[pads.down])
        self.pulls, self.table_m = 1.0, 0.0
        self._on_table = plan.scene.kind == "lift"
        self._lost_for = 0

    @property
    def fallen_m(self) -> float:
        """Return the object's motion along gravity since the start."""
        return float(self._pads.first.pose[self._pads.down] - self._starts_at_m)

    def advance(self, slice_number: int, force_n: tuple[float, float], friction: gel.Friction) -> Slice:
        """Solve a slice of the pads for an object that hangs between them, or that something else carries.

        force_n: normal force at the start and the end of the slice.
        """
        if self._drop is not None and slice_number == self._drops_at:
            self._pads.catch(self._drop.mass_g * 1e-3, self._drop.speed_m_s)
        acceleration = self._hand.accelerate(slice_number)
        self.pulls = max(1.0 + acceleration / GRAVITY_M_S2, 0.0)
        weight_n = self._pads.carried_kg * (GRAVITY_M_S2 + acceleration)
        if self._kind == "lift":
            return self._advance_over_table(force_n, friction, weight_n)
        load = self.load(slice_number)
        if self._kind == "hold" and (load == 0.0 or self.fallen_m > self._floor_m):
            return self._pads.advance(force_n, friction, 0.0, 0.0)
        push_n = 0.0 if self._pushes is None else self._pushes.at(slice_number * STEP_S)
        return self._pads.advance(force_n, friction, weight_n * load + push_n)

    def load(self, slice_number: int) -> float:
        """Return the share of the weight on the gripper: handed over smoothly after the rest."""
        done = (slice_number * STEP_S - self._time.rest_s) / max(self._time.load_s, STEP_S)
        if done >= 1.0:
            return 1.0
        return float(0.5 - 0.5 * np.cos(np.pi * min(max(done, 0.0), 1.0)))

    def _advance_over_table(self, force_n: tuple[float, float], friction: gel.Friction, weight_n: float) -> Slice:
        """Solve a slice over the table: if the object would sink into the table, the table carries it.

        At most both cases are tried, first that of the slice before. An object on the table stays there as long as the
        table has to push it up (otherwise the object would hang on the table). A hanging object keeps hanging as long
        as it does not sink into the table.
        """
        pads = self._pads
        self.table_m += self._hand.speed_m_s * STEP_S
        speed, falling = (self.table_m - self.fallen_m) / STEP_S, pads.first.twist[pads.down]
        pads.remember()
        if self._on_table:
            done = pads.advance(force_n, friction, 0.0, speed)
            inertial_n = pads.carried_kg * (speed - falling) / (self._theta * STEP_S)
            held_n = 2 * done.friction_n[pads.down]
            if pads.second is not None:
                held_n = done.friction_n[pads.down] + done.second_friction_n[pads.down]
            if weight_n - held_n - inertial_n >= 0.0:
                return done
            pads.rewind()
        done = pads.advance(force_n, friction, weight_n)
        self._on_table = self.fallen_m > self.table_m
        if self._on_table:
            pads.rewind()
            done = pads.advance(force_n, friction, 0.0, speed)
        return done

    def is_over(self, force_n: float) -> bool:
        """Return whether the trial is over: a ramp some time after contact is lost, a grasp after the object fell."""
        if self._kind == "hold":
            return False
        gone = force_n <= 0.0
        if self._kind == "lift":
            gone = gone and (fallen_m := self.fallen_m) > GONE_M and self.table_m - fallen_m > GONE_M
        else:
            gone = gone or self.fallen_m > GONE_M
        self._lost_for = self._lost_for + 1 if gone else 0
        return self._lost_for > self._time.after_lost_s / STEP_S
