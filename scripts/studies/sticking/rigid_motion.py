"""Share of a contact that slips, without a network: dots that left the rigid motion of those that stick.

The part of the gel that sticks to an object moves with it as one body. A translation and a rotation are fitted to the
motion of most pressed dots since the reference; dots that deviate from it have slipped. The network of the touch maps
is compared with this method (judge.py).

Pressed dots are those displaced at the reference by more than PRESSED of the largest displacement.
"""

import numpy as np

from evetac_cli.arrays import Flags, Floats

# LEFT_MM: a dot farther than this from the rigid motion has slipped. LEFT_MM is the best of 0.1 to 0.8 px and PRESSED
# the best of 0.3 and 0.5, on objects 4, 7 and 17, seeds 2000 and 2001.
LEFT_MM = 0.8 * 0.0329
PRESSED = 0.5
ROUNDS = 8  # of fits; each leaves out the dots that deviate from the previous one
LEAST_DOTS = 4  # pressed dots: fewer do not determine slip


def rigid_slip_share(reference_mm: Floats, now_mm: Floats, at_mm: Floats) -> float:
    """Return the share of pressed dots that slip, from displacements (dots, 2) at the reference and now.

    at_mm: positions of the dots, (dots, 2). 0 if fewer than 4 dots are pressed.
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
        # at least a third of the dots is taken to stick: those nearest to the present motion
        near = off <= max(LEFT_MM, float(np.quantile(off, 1 / 3)))
        shift = change[near].mean(axis=0)
        arm = turned[near] - turned[near].mean(axis=0)
        square = float((arm**2).sum())
        spin = float((arm * (change[near] - shift)).sum()) / square if square > 0.0 else 0.0
        rigid = shift + spin * (turned - turned[near].mean(axis=0))
        off = np.linalg.norm(change - rigid, axis=1)
    return float(np.mean(off > LEFT_MM))
