"""Stiffness and creep of a gel under a held object, against closed forms and a numerical solution."""

from typing import Any

import numpy as np
import pytest

from evetac_cli.kernels.gel_layer import ACROSS, SPRING, sheet_stiffness
from evetac_cli.kernels.identify import held_gel
from evetac_cli.sim.gel import contact

HEIGHT_M = 4e-3


def layer(one: held_gel.Pad) -> Any:
    return sheet_stiffness(one.node_xy_m, one.height_m)


def pad(columns: int = 36, rows: int = 81) -> held_gel.Pad:
    return held_gel.Pad(contact.pad_nodes(columns, rows, (-10e-3, 10e-3), (-12e-3, 12e-3)), HEIGHT_M)


def test_a_strip_in_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert force and displacement of a long strip moved along itself, in closed form for the sheet inside the gel.

    All waves are across the motion. Under the strip the sheet follows it but near the border, where it differs by a
    share that falls over `under`; beside it sheet and surface fall over `beside`. The exact layer's force for each m of
    length is G (2 a / H + 4 ln 2 / pi) (a conformal map), from which the sheet is 5 % off.
    """
    monkeypatch.setattr(held_gel, "EDGE_M", 1e-6)
    wide = pad()
    y = wide.node_xy_m[:, 0, 1]
    half_m = 10.5 * (y[1] - y[0])  # between two rows
    moved, force_m = held_gel.shape(wide, layer(wide), np.array([half_m, half_m, 0.0]))
    under_m = HEIGHT_M * np.sqrt(ACROSS / SPRING)
    beside_m = under_m * np.sqrt(1 + SPRING)
    border = 1 / (1 + under_m / beside_m / np.tanh(half_m / under_m))  # the sheet's displacement there
    at_surface = border * SPRING / (1 + SPRING)
    length_m = 20e-3
    assert force_m == pytest.approx(length_m / HEIGHT_M * 2 * (half_m + at_surface * beside_m), rel=0.02)
    assert force_m == pytest.approx(length_m * (2 * half_m / HEIGHT_M + 4 * np.log(2) / np.pi), rel=0.05)
    beside = y > half_m
    expected = at_surface * np.exp(-(y[beside] - half_m) / beside_m)
    np.testing.assert_allclose(moved[beside], expected[:, None] * np.ones(36), atol=0.02)
    assert moved[np.abs(y) < half_m].min() > 0.95


@pytest.mark.parametrize("strip_mm", [(5.0, 2.0, 1.0), (2.0, 4.0, -1.0)])
def test_held_again(strip_mm: tuple[float, float, float]) -> None:
    """Assert that displacement and stiffness come back from what dots show of a strip, with noise of 2 %."""
    one = held_gel.Pad(contact.pad_nodes(36, 27, (-10e-3, 10e-3), (-7.5e-3, 7.5e-3)), HEIGHT_M)
    strip = np.array(strip_mm) * 1e-3
    moved, force_m = held_gel.shape(one, layer(one), strip)
    rows, columns = np.meshgrid(np.arange(2, 26, 4), np.arange(2, 35, 4), indexing="ij")
    dots = one.node_xy_m[rows, columns].reshape(-1, 2)
    shown = moved[rows, columns].reshape(-1) * 0.3e-3
    shown += 0.02 * 0.3e-3 * np.random.default_rng(0).normal(size=len(shown))
    fitted = held_gel.fit(one, dots, shown)
    assert fitted.displacement_m * fitted.stiffness_m == pytest.approx(0.3e-3 * force_m, rel=0.05)
    assert fitted.misfit < 0.05


def test_nothing_is_held() -> None:
    """Assert that too few dots, and dots that do not move along the weight, are refused."""
    one = pad(12, 9)
    dots = np.random.default_rng(0).uniform(-7e-3, 7e-3, (40, 2))
    with pytest.raises(ValueError, match="do not move"):
        held_gel.fit(one, dots, -np.ones(40) * 1e-4)
    with pytest.raises(ValueError, match="at least 12 dots"):
        held_gel.fit(one, dots, np.full(40, np.nan))


def test_response_solves_the_arms() -> None:
    """Assert the response to a force that comes on at once against a solution in small steps."""
    shares, times = np.array([0.08, 0.05]), np.array([0.4, 3.0])
    share, time = np.append(shares, 0.15), np.append(times, 0.01)
    step_s = 2e-4
    lagging = np.full(3, 1 / (1 + share.sum()))
    path = []
    for _ in range(5000):
        fast = (share * lagging / time).sum() / (1 + share.sum())
        lagging = lagging + step_s * (fast - lagging / time)
        path.append(1 - share @ lagging)
    at = np.array([0.1, 0.5, 0.99])
    expected = np.array(path)[np.round(at / step_s).astype(int) - 1]
    assert held_gel.response(at, 0.0, shares, times) == pytest.approx(expected, abs=2e-4)
    assert held_gel.response(np.array([100.0]), 0.1, shares, times)[0] == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("shares", [(0.0, 0.0), (0.08, 0.0), (0.02, 0.09)])
def test_creep_again(shares: tuple[float, float]) -> None:
    """Assert that shares come back from the displacement that they make, with noise."""
    time_s = np.geomspace(0.03, 15, 40)
    shown = 0.25e-3 * held_gel.response(time_s, 0.1, np.array(shares), np.array([0.3, 4.0]))
    shown *= 1 + 0.001 * np.random.default_rng(1).normal(size=len(shown))
    fitted = held_gel.creep(time_s, shown, 0.1)
    assert sum(fitted.share) == pytest.approx(sum(shares), abs=0.01)
    assert fitted.final == pytest.approx(0.25e-3, rel=0.02)
    with pytest.raises(ValueError, match="nothing moves"):
        held_gel.creep(time_s, -shown, 0.1)
