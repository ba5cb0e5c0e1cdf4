"""Dots that moved otherwise than the others: found, others not, whatever the patch; closed form by leaving one out."""

import numpy as np
import pytest

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.touch import wrong_dots
from evetac_cli.kernels.touch.dot_motion import GelLayer, cells_about, dot_motion

DOTS = np.stack(np.meshgrid(np.linspace(-8, 8, 9), np.linspace(-6, 6, 7)), -1).reshape(-1, 2)
CELLS = cells_about(DOTS, 4.0)
MOTION = dot_motion(GelLayer(), CELLS, DOTS)
KNOWN = wrong_dots.start(MOTION, CELLS.shape)
PX = 0.0329
ALL: Flags = np.ones(len(DOTS), np.bool_)
DISC: Flags = (np.hypot(*(CELLS.middle_mm - [1, 0]).T) < 4).reshape(CELLS.shape)
NOTHING: Flags = np.zeros(CELLS.shape, np.bool_)


def moved(seed: int = 0) -> Floats:
    """Motion of dots (dots, 2) in mm under shear and pressure on a disc, with a tracker's error."""
    rng = np.random.default_rng(seed)
    bowl = np.maximum(1 - ((CELLS.middle_mm - [1, 0]) ** 2).sum(axis=1) / 16, 0.0)
    motion = np.einsum("dakc,kc->da", MOTION, np.stack([4e3 * bowl, -2e3 * bowl, 15e3 * bowl]))
    errors = rng.normal(size=DOTS.shape) * 0.08 + rng.normal(size=2) * 0.2
    there: Floats = motion + errors * PX
    return there


@pytest.mark.parametrize("patch", [DISC, NOTHING], ids=["touched", "not touched"])
@pytest.mark.parametrize("count", [0, 1, 6])
def test_wrong_dots_are_found(patch: Flags, count: int) -> None:
    """Assert that dots 3 px off are found, nearly all of them, and of the others one in a hundred is called wrong."""
    found = called = there = 0
    for seed in range(10):
        rng = np.random.default_rng([seed, 1])
        places = moved(seed) if patch.any() else rng.normal(size=DOTS.shape) * 0.08 * PX
        chosen, ways = rng.permutation(len(DOTS))[:count], rng.uniform(0, 2 * np.pi, count)
        places[chosen] += 3 * PX * np.stack([np.cos(ways), np.sin(ways)], axis=1)
        flags = wrong_dots.wrong(KNOWN, places, ALL, patch)
        found, there = found + int(flags[chosen].sum()), there + count
        called += int(flags.sum()) - int(flags[chosen].sum())
    assert found >= 0.9 * there
    assert called <= 0.01 * 10 * len(DOTS)


def test_what_is_off_is_what_the_others_do_not_expect() -> None:
    """Assert that the closed form for leaving a dot out is that of a Gaussian without it."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(12, 12))
    covariance, data = root @ root.T + np.eye(12), rng.normal(size=12)
    deviations, off = wrong_dots._off(np.linalg.inv(covariance), data)
    for dot in range(6):
        own = [2 * dot, 2 * dot + 1]
        others = [row for row in range(12) if row not in own]
        gain = covariance[np.ix_(own, others)] @ np.linalg.inv(covariance[np.ix_(others, others)])
        away = data[own] - gain @ data[others]
        left = covariance[np.ix_(own, own)] - gain @ covariance[np.ix_(others, own)]
        assert off[dot] == pytest.approx(np.hypot(*away))
        assert deviations[dot] == pytest.approx(np.sqrt(away @ np.linalg.solve(left, away)))


def test_dots_that_are_not_trusted_count_for_nothing() -> None:
    """Assert that lost dots are neither called wrong nor looked at, whatever stands in their place; few say nothing."""
    places, trusted = moved(), ALL.copy()
    places[20] += 3 * PX
    expected = wrong_dots.wrong(KNOWN, places, ALL, DISC)
    assert expected[20]
    trusted[[4, 40]] = False
    places[4], places[40] = np.nan, 1e3
    flags = wrong_dots.wrong(KNOWN, places, trusted, DISC)
    assert flags[20]
    assert not flags[[4, 40]].any()
    few: Flags = np.arange(len(DOTS)) < wrong_dots.LEAST_DOTS - 1
    assert not wrong_dots.wrong(KNOWN, places, few, DISC).any()


def test_where_many_seem_wrong_the_patch_is() -> None:
    """Assert that none is called wrong of dots that all go their own ways, nor of dots that do not move."""
    wild = np.random.default_rng(1).normal(size=DOTS.shape) * 20 * PX
    assert not wrong_dots.wrong(KNOWN, wild, ALL, NOTHING).any()
    assert not wrong_dots.wrong(KNOWN, np.zeros_like(DOTS), ALL, DISC).any()
