"""What a scene may do to a trial on its way: friction that changes at a time. Off by default."""

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
