"""What a scene may do to a trial on its way: friction that changes at a time, a hand that jerks. Off by default."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from evetac_cli.sim.gel.gel import Friction


class ChangingFriction:
    """The friction of a trial over its slices: static and kinetic times a factor from a time on, if the scene says so.

    As on a wet patch that the whole contact comes upon at once.
    """

    def __init__(self, scene: Mapping[str, Any], friction: Friction) -> None:
        """Read the scene's table friction_change; without one, friction stays as it is."""
        change = scene.get("friction_change")
        self._before = self._after = friction
        self._changes_at = math.inf
        if change is not None:
            factor = float(change["factor"])
            self._changes_at = round(float(change["at_s"]) * 1000)
            self._after = replace(friction, static=friction.static * factor, kinetic=friction.kinetic * factor)

    def at(self, slice_number: int) -> Friction:
        """The friction in a slice."""
        return self._before if slice_number < self._changes_at else self._after


def jerk_m_s(hand: Mapping[str, Any], now_s: float) -> float:
    """What a jerk adds to the upward speed of the hand at a time: half a sine wave, 0 without a jerk."""
    if "jerk" not in hand:
        return 0.0
    jerk = hand["jerk"]
    since_s, lasts_s = now_s - float(jerk["at_s"]), float(jerk["lasts_s"])
    if not 0.0 < since_s < lasts_s:
        return 0.0
    return float(jerk["speed_mm_s"]) * 1e-3 * math.sin(math.pi * since_s / lasts_s)
