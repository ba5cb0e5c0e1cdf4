"""Combine the slip signals of two detectors, one per finger, into the single signal that a grip law reads.

- Slip: the slip counts of both detectors are added, so the sum rises when either finger slips. One slipping finger is
  enough to lose an object, because the other finger must then carry its share.
- Load: the mean of both fingers. The object's weight is split between the two gels according to their stiffness, so
  only the sum is independent of the split. Half of the sum is the load on each of two equal fingers, for which the
  constants of the law were chosen. If one finger slips, the gel of the other takes over and the mean stays the same.
  The maximum of both would mistake a stiffer grip for a heavier object.
- Signs: the second sensor faces the first (sim/scenes/second_view.py), so downward motion and rotation have the
  opposite sign in its image. Both are therefore subtracted. Motion along the fingers has the same sign in both images.
- Sticking share: the smaller one, because that finger slips first.
- Probability: the larger one. It is for display only; evetac's laws do not read it.

Fingers with gels of different stiffness feel different loads, and the law does not know which finger is the stiffer
one. This does no harm: the law only compares loads with each other, and each finger's share of the load hardly changes
while both stick.
"""

import math
from collections.abc import Callable

from evetac_cli.kernels.grip.control import SlipSignal


def both(first: SlipSignal, second: SlipSignal) -> SlipSignal:
    """Return one signal for two fingers; each argument uses the coordinates of its own sensor's image."""
    return SlipSignal(
        first.slips + second.slips,
        _extreme(max, first.probability, second.probability),
        0.5 * (first.mean_displacement_x_px + second.mean_displacement_x_px),
        0.5 * (first.mean_displacement_y_px - second.mean_displacement_y_px),
        0.5 * (first.turn_px - second.turn_px),
        _extreme(min, first.sticking_share, second.sticking_share),
    )


def _extreme(choose: Callable[[float, float], float], first: float, second: float) -> float:
    """Return the larger or smaller of two values, as `choose` decides; if one is NaN (unknown), the other."""
    if math.isnan(first):
        return second
    return first if math.isnan(second) else choose(first, second)
