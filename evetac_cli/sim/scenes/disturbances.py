"""What a scene may do to a trial on its way: friction that changes at a time. Off by default."""

import math
from dataclasses import replace

from evetac_cli.events import SLICES_PER_S
from evetac_cli.sim.gel.gel import Friction
from evetac_cli.sim.setup.scene import FrictionChange


class ChangingFriction:
    """The friction of a trial over its slices: static and kinetic times a factor from a time on, if the scene says so.

    As on a wet patch that the whole contact comes upon at once.
    """

    def __init__(self, change: FrictionChange | None, friction: Friction) -> None:
        """Without a change, friction stays as it is."""
        self._before = self._after = friction
        self._changes_at = math.inf
        if change is not None:
            factor = change.factor
            self._changes_at = round(change.at_s * SLICES_PER_S)
            self._after = replace(friction, static=friction.static * factor, kinetic=friction.kinetic * factor)

    def at(self, slice_number: int) -> Friction:
        """The friction in a slice."""
        return self._before if slice_number < self._changes_at else self._after
