"""The hand that holds the gripper: its planned rise, a jerk, and the vibration of the robot.

The planned motion is a trapezoid of speed, a trapezoid with smooth corners (s-curve), or a trapezoid in steps. Steps
are those of a robot controller that updates its speed at 125 Hz; users report 125 Hz for Universal Robots' CB3
controllers and 500 Hz for the e-series. A vibration is a sum of sine waves of acceleration with random phases.

The hand is controlled by speed, and its acceleration in a slice is the change of that speed. So motion and inertia
agree to the bit. A vibration that began or ended at once would be a knock, so it fades in and out over FADE_S.
"""

import math

import numpy as np

from evetac_cli.sim.setup.held import HandJerk, HandSettings

CONTROLLER_HZ = 125.0  # update rate of the robot controller, for the profile `steps`
FADE_S = 0.05  # time over which a vibration fades in and out


class Hand:
    """Speed of a hand along gravity, positive upwards, slice by slice."""

    def __init__(self, settings: HandSettings, rises_at_s: float, slice_s: float, phases: np.random.Generator) -> None:
        """Build a hand at rest; phases: source of the vibration's random phases."""
        self._rises_at_s, self._slice_s = rises_at_s, slice_s
        self._height_m = settings.height_mm * 1e-3
        self._fastest_m_s = settings.speed_mm_s * 1e-3
        self._profile = settings.profile
        self._starts_for_s = self._fastest_m_s / (settings.acceleration_mm_s2 * 1e-3)
        if self._profile == "s-curve":
            self._starts_for_s *= 0.5 * math.pi  # so that the peak acceleration is the scene's acceleration_mm_s2
        self._jerk = settings.jerk
        self._vibration = settings.vibration
        self._turning = self._swing_m_s = self._phase_rad = np.zeros(0)
        if self._vibration is not None:
            self._turning = 2 * np.pi * np.array(self._vibration.frequency_hz, dtype=np.float64)
            self._swing_m_s = np.array(self._vibration.acceleration_m_s2, dtype=np.float64) / self._turning
            self._phase_rad = phases.uniform(0.0, 2 * np.pi, len(self._turning))
        self._never_moves = settings.is_still
        self.speed_m_s = 0.0

    def accelerate(self, slice_number: int) -> float:
        """Advance by a slice: set speed_m_s to the speed at its end, and return the acceleration in the slice."""
        if self._never_moves:
            return 0.0
        now_s, before_m_s = (slice_number + 1) * self._slice_s, self.speed_m_s
        self.speed_m_s = self._planned_m_s(now_s - self._rises_at_s)
        if self._jerk is not None:
            self.speed_m_s += jerk_m_s(self._jerk, now_s)
        if self._vibration is not None:
            self.speed_m_s += self._vibrates_m_s(now_s)
        return (self.speed_m_s - before_m_s) / self._slice_s

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

    def _vibrates_m_s(self, now_s: float) -> float:
        """Return the vibration's speed: for each acceleration A sin(w t + p), -A/w cos(w t + p)."""
        fades = now_s
        if self._vibration is not None and self._vibration.only_moving:
            since_s = now_s - self._rises_at_s
            fades = min(since_s, self._height_m / self._fastest_m_s + self._starts_for_s - since_s)
        if fades <= 0.0:
            return 0.0
        strength = 1.0 if fades >= FADE_S else 0.5 - 0.5 * math.cos(math.pi * fades / FADE_S)
        return -strength * float((self._swing_m_s * np.cos(self._turning * now_s + self._phase_rad)).sum())


def jerk_m_s(jerk: HandJerk, now_s: float) -> float:
    """Return the speed that a jerk adds to the hand's upward speed at a time: half a sine wave."""
    since_s, lasts_s = now_s - jerk.at_s, jerk.lasts_s
    if not 0.0 < since_s < lasts_s:
        return 0.0
    return jerk.speed_mm_s * 1e-3 * math.sin(math.pi * since_s / lasts_s)
