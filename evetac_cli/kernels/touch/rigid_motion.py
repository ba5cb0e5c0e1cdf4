"""Share of a contact that slips without a network: dots that left the rigid motion of those that stick.

What sticks to an object moves with it, as one body. In the dots that are pressed, a translation and a rotation are
fitted to what most of them did since the reference, and those that did otherwise have slipped. It is what touch maps'
network is held against (scripts/judge_sticking.py).

Which dots are pressed is taken from the reference: those that are displaced there by more than PRESSED of the farthest.
"""

import numpy as np

from evetac_cli.arrays import Flags, Floats

# A dot that is farther from the rigid motion has slipped. Both are the best of 0.1 to 0.8 px, and of 0.3 and 0.5, on
# objects 4, 7 and 17, seeds 2000 and 2001.
LEFT_MM = 0.8 * 0.0329
PRESSED = 0.5
ROUNDS = 8  # of fits, each without the dots that the one before left behind
LEAST_DOTS = 4


def rigid_slip_share(reference_mm: Floats, now_mm: Floats, at_mm: Floats) -> float:
    """Share of the pressed dots that slip, by displacements (dots, 2) at the reference and now of dots at at_mm.

    0 where fewer than 4 dots are pressed.
    """
    away = np.linalg.norm(reference_mm, axis=1)
    pressed: Flags = away > PRESSED * away.max()
    if pressed.sum() < LEAST_DOTS:
        return 0.0
    change, at = (now_mm - reference_mm)[pressed], at_mm[pressed]
    at = at - at.mean(axis=0)
    turned = np.stack([-at[:, 1], at[:, 0]], axis=1)
    middle = np.median(change, axis=0)
    off = np.linalg.norm(change - middle, axis=1)
    for _ in range(ROUNDS):
        # what has not slipped is at least a third of the dots, those nearest to the motion so far
        near = off <= max(LEFT_MM, float(np.quantile(off, 1 / 3)))
        shift = change[near].mean(axis=0)
        arm = turned[near] - turned[near].mean(axis=0)
        square = float((arm**2).sum())
        spin = float((arm * (change[near] - shift)).sum()) / square if square > 0.0 else 0.0
        rigid = shift + spin * (turned - turned[near].mean(axis=0))
        off = np.linalg.norm(change - rigid, axis=1)
    return float(np.mean(off > LEFT_MM))
