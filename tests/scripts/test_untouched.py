"""Nothing touches any more: after a touch that has gone, once, whatever a tracker is off by; never in a touch."""

import sys
from pathlib import Path

import numpy as np

from evetac_cli.arrays import Floats

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import untouched
from untouched import NEAR_PX, STILL_PX, TOUCHED_PX, UntouchedState

REST = np.stack(np.meshgrid(np.arange(6) * 60.0, np.arange(5) * 60.0), -1).reshape(-1, 2)
STILL = 20
TOUCH = np.exp(-((REST - [150, 120]) ** 2).sum(axis=1) / (2 * 90**2))[:, None] * [1.0, 0.4]


def play(state: UntouchedState, *parts: tuple[Floats, int]) -> list[int]:
    """In which slices nothing was found to touch any more, of places that last for so many slices each."""
    found, number = [], 0
    for place, slices in parts:
        for _ in range(slices):
            if untouched.step(state, place):
                found.append(number)
            number += 1
    return found


def drifted(px: float) -> Floats:
    """Dots at rest as a tracker has them, off by px on average and by 0.3 px in common."""
    rng = np.random.default_rng(2)
    return REST + rng.normal(size=REST.shape) * px / np.sqrt(2) + [0.3, 0.0]


def test_found_once_after_a_touch() -> None:
    """Assert that rest is found when dots have been still for long enough after a touch, and once for each."""
    state = untouched.start(REST, STILL)
    touch = REST + 8 * TOUCH
    parts = [(REST, 50), (touch, 30), (drifted(0.2), 60), (touch, 30), (drifted(0.3), 60)]
    assert play(state, *parts) == [80 + STILL, 170 + STILL]


def test_a_light_touch_from_rest_is_never_taken_for_rest() -> None:
    """Assert that what moves no dot by TOUCHED_PX and stays is not erased, however long, nor is a touch that lasts."""
    state = untouched.start(REST, STILL)
    assert TOUCH.max() * 0.9 * TOUCHED_PX > NEAR_PX
    assert play(state, (REST, 30), (REST + 0.9 * TOUCHED_PX * TOUCH, 200)) == []
    assert play(state, (REST + 4 * TOUCH, 200)) == []


def test_dots_that_move_or_are_far_are_not_at_rest() -> None:
    """Assert that nothing is found while dots creep, and where more than a fifth are off or all are far off."""
    touched = (REST + 8 * TOUCH, 30)
    creeping = [(REST + 2 * STILL_PX * (k % 2), 5) for k in range(40)]
    assert play(untouched.start(REST, STILL), touched, *creeping) == []
    off = drifted(0.1)
    off[: len(off) // 4] += 3 * NEAR_PX
    assert play(untouched.start(REST, STILL), touched, (off, 100)) == []
    assert play(untouched.start(REST, STILL), touched, (REST + [2.0, 0.0], 100)) == []


def test_wrong_lost_and_missing_dots_do_not_hinder() -> None:
    """Assert that rest is found with a dot that is 20 px off, some that are lost and move, and one that is missing."""
    rest = REST.copy()
    rest[3] = np.nan
    place = drifted(0.2)
    place[3], place[7] = np.nan, place[7] + 20
    state = untouched.start(rest, STILL)
    lost = np.zeros(len(rest), np.bool_)
    lost[10:15] = True
    found = []
    for k in range(100):
        now = rest + 8 * TOUCH if k < 30 else place + np.where(lost, 5.0 * k, 0.0)[:, None]
        found.append(untouched.step(state, now, lost))
    assert np.flatnonzero(found).tolist() == [30 + STILL]
