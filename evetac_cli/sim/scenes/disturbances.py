"""Disturbances during a trial: friction that changes at a given time. Off by default."""

import math
from dataclasses import replace

from evetac_cli.events import SLICES_PER_S
from evetac_cli.sim.gel.gel import Friction
from evetac_cli.sim.setup.scene import FrictionChange


class ChangingFriction:
    """The friction of a trial over time: static and kinetic friction change by a factor at a given time, if at all.

    The whole contact changes at once, as if it reached a wet patch.
    """

    def __init__(self, change: FrictionChange | None, friction: Friction) -> None:
        """Start with the trial's friction; without a change, it stays constant."""
        self._before = self._after = friction
        self._changes_at = math.inf
        if change is not None:
            factor = change.factor
            self._changes_at = round(change.at_s * SLICES_PER_S)
            self._after = replace(friction, static=friction.static * factor, kinetic=friction.kinetic * factor)

    def at(self, slice_number: int) -> Friction:
        """Return the friction in a slice."""
        return self._before if slice_number < self._changes_at else self._after
