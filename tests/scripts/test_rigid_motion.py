"""The model-free share that slips: dots that left the rigid motion of the others."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
from rigid_motion import rigid_slip_share

DOTS = np.stack(np.meshgrid(np.linspace(-8, 8, 9), np.linspace(-6, 6, 7)), -1).reshape(-1, 2)
UNDER = np.hypot(*DOTS.T) < 6.1  # pressed dots
HELD = np.where(UNDER, 0.2, 0.02)[:, None] * [1.0, 0.0]


def moved(shift_mm: tuple[float, float], turned_rad: float) -> np.ndarray:
    """Displacements where what is pressed has moved as one body since."""
    turned = turned_rad * np.stack([-DOTS[:, 1], DOTS[:, 0]], axis=1)
    return HELD + np.where(UNDER[:, None], np.array(shift_mm) + turned, 0.0)


@pytest.mark.parametrize(("shift_mm", "turned_rad"), [((0.0, 0.0), 0.0), ((0.1, -0.05), 0.0), ((0.02, 0.0), 0.01)])
def test_a_body_that_moves_as_one_sticks(shift_mm: tuple[float, float], turned_rad: float) -> None:
    """Assert that nothing slips of what was shifted and turned as one, whatever the dots beside it do."""
    assert rigid_slip_share(HELD, moved(shift_mm, turned_rad), DOTS) == 0.0


@pytest.mark.parametrize("count", [5, 12])
def test_dots_that_stay_behind_slip(count: int) -> None:
    """Assert that the share is that of the pressed dots which stayed behind, also where the body turned."""
    now = moved((0.05, 0.02), 0.005)
    behind = np.flatnonzero(UNDER)[np.argsort(-np.hypot(*DOTS[UNDER].T))][:count]
    now[behind] = HELD[behind]
    assert rigid_slip_share(HELD, now, DOTS) == pytest.approx(count / UNDER.sum(), abs=1.5 / UNDER.sum())


def test_without_a_contact_nothing_slips() -> None:
    """Assert 0 where fewer than four dots are pressed."""
    held = np.zeros_like(DOTS)
    held[3] = 0.2
    assert rigid_slip_share(held, 2 * held, DOTS) == 0.0
