"""What the grip law is told where both fingers feel: one slip signal from those of two detectors.

- Slip: the slices of both are counted together, so that the count rises where either slips. One finger that slips is
  enough to lose an object: what it no longer bears the other has to.
- Load: half of what both feel together. The object's weight hangs on both, and each carries what its gel resists, so
  that the sum is known whichever finger holds more; half of it is what one of two equal fingers feels, for which the
  constants of the law were chosen. Where one finger slips, the gel of the other takes over, and the half stays. The
  largest of both would take what a stiffer grip holds for a heavier object.
- The second sensor faces the first (sim/scenes/second_view.py): what moves down the image there, as it turns, has the
  other sign. So both are subtracted; what moves along the fingers has the same sign in both.
- What sticks: the smaller share, as that finger slips first.
- Probability: the larger one. It is for whoever watches; no law of ours reads it.

Fingers whose gels differ in stiffness feel the same load otherwise; the law is not told which is which. It compares
loads with each other, and each finger's share of them hardly changes while both stick.
"""

import math
from collections.abc import Callable

from evetac_cli.kernels.grip.control import SlipSignal


def both(first: SlipSignal, second: SlipSignal) -> SlipSignal:
    """The signal of two fingers: the second in the coordinates of its own image."""
    return SlipSignal(
        first.slips + second.slips,
        _chosen(max, first.probability, second.probability),
        0.5 * (first.mean_displacement_x_px + second.mean_displacement_x_px),
        0.5 * (first.mean_displacement_y_px - second.mean_displacement_y_px),
        0.5 * (first.turn_px - second.turn_px),
        _chosen(min, first.sticking_share, second.sticking_share),
    )


def _chosen(choose: Callable[[float, float], float], first: float, second: float) -> float:
    """The larger or smaller of two; NaN stands for not known, and says nothing where the other is."""
    if math.isnan(first):
        return second
    return first if math.isnan(second) else choose(first, second)
