"""The bonded layer: its closed form against a numerical solution in depth, and the sheet against the closed form."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_bvp
from scipy.sparse.linalg import splu

from evetac_cli.kernels.gel_layer import (
    ACROSS,
    ALONG,
    SPRING,
    Squeeze,
    compliance,
    sheet_stiffness,
)

HEIGHT_M = 4e-3
Fields = NDArray[np.float64]


def grid(columns: int, rows: int, pitch_m: float) -> Fields:
    """Nodes (rows, columns, 2) about the origin."""
    x, y = (pitch_m * (np.arange(count) - (count - 1) / 2) for count in (columns, rows))
    return np.stack(np.meshgrid(x, y), axis=-1)


@pytest.mark.parametrize("poisson", [0.3, 0.48])
@pytest.mark.parametrize("wavelength_m", [4e-3, 12e-3, 60e-3])
def test_the_closed_form_solves_the_layer(wavelength_m: float, poisson: float) -> None:
    """Assert that the closed form is what a boundary value solver makes of Navier's equations in depth, to 1e-6.

    In heights and shear moduli: U along the wave and V up, a quarter of a wave apart; 0 at the back, and at the surface
    the traction U' - k V and (l + 2) V' + l k U.
    """
    k = 2 * math.pi / wavelength_m * HEIGHT_M
    lame = 2 * poisson / (1 - 2 * poisson)

    def slopes(_: Fields, y: Fields) -> Fields:
        along, up, along_1, up_1 = y
        along_2 = (lame + 2) * k**2 * along + (lame + 1) * k * up_1
        return np.stack([along_1, up_1, along_2, (k**2 * up - (lame + 1) * k * along_1) / (lame + 2)])

    for shear, pressure in ((1.0, 0.0), (0.0, 1.0)):

        def ends(low: Fields, top: Fields, shear: float = shear, pressure: float = pressure) -> Fields:
            return np.array(
                [low[0], low[1], top[2] - k * top[1] - shear, (lame + 2) * top[3] + lame * k * top[0] - pressure]
            )

        depth = np.linspace(0, 1, 40)
        solution = solve_bvp(slopes, ends, depth, np.zeros((4, 40)), tol=1e-9, max_nodes=100_000)
        assert solution.success
        along, up = solution.y[:2, -1] * HEIGHT_M
        found = compliance(np.array([k / HEIGHT_M]), HEIGHT_M, 1.0, poisson)
        if shear:
            assert found.along[0] == pytest.approx(along, rel=1e-6)
            assert -found.dip[0] == pytest.approx(up, rel=1e-6)
        else:
            assert (found.aside[0], found.down[0]) == pytest.approx((along, up), rel=1e-6)
        along, up = solution.sol(0.75)[:2] * HEIGHT_M
        below = compliance(np.array([k / HEIGHT_M]), HEIGHT_M, 1.0, poisson, HEIGHT_M / 4)
        parts = (below.along[0], -below.dip[0]) if shear else (below.aside[0], below.down[0])
        assert parts == pytest.approx((along, up), rel=1e-5, abs=1e-5 * HEIGHT_M)


def test_limits_of_the_closed_form() -> None:
    """Assert the limits of a layer that keeps its volume: a thin film for long waves, a half space for short ones."""
    long, short = 2 * math.pi / 2.0, 2 * math.pi / 0.5e-3
    found = compliance(np.array([long, short]), HEIGHT_M, 145e3)
    assert found.across == pytest.approx([HEIGHT_M / 145e3, 1 / (145e3 * short)], rel=1e-3)
    assert found.along == pytest.approx([HEIGHT_M / 145e3, 0.5 / (145e3 * short)], rel=1e-3)
    assert found.aside[0] == pytest.approx(-long * HEIGHT_M**2 / (2 * 145e3), rel=1e-3)
    assert found.down == pytest.approx([long**2 * HEIGHT_M**3 / (3 * 145e3), 0.5 / (145e3 * short)], rel=1e-3)


def test_below_the_surface() -> None:
    """Assert the motion below: none at the back, linear under an even shear, reciprocal at the surface alone."""
    waves = np.array([2 * math.pi / 2.0, 2 * math.pi / 8e-3])
    back = compliance(waves, HEIGHT_M, 145e3, depth_m=HEIGHT_M)
    assert np.abs(np.stack(back)).max() < 1e-12 * HEIGHT_M / 145e3 * 1e3
    deep, top = compliance(waves, HEIGHT_M, 145e3, depth_m=1e-3), compliance(waves, HEIGHT_M, 145e3)
    assert deep.across[0] == pytest.approx(0.75 * HEIGHT_M / 145e3, rel=1e-3)
    assert deep.across[1] == pytest.approx(
        math.sinh(waves[1] * 3e-3) / math.cosh(waves[1] * HEIGHT_M) / waves[1] / 145e3, rel=1e-12
    )
    assert top.dip == pytest.approx(-top.aside, rel=1e-9)
    assert abs(deep.dip[1] + deep.aside[1]) > 0.1 * abs(top.aside[1])


def answer_along_a_line(wavelength_m: float, along: bool) -> float:
    """Compliance over H/G of the sheet's grid to a cosine that meets its free edges, along x."""
    half_waves = 2 * max(round(40e-3 / wavelength_m), 1)
    columns = round(half_waves * wavelength_m / 2 / 0.25e-3)
    nodes = grid(columns, 3, half_waves * wavelength_m / 2 / columns)
    pattern = np.tile(np.cos(math.pi * half_waves * (np.arange(columns) + 0.5) / columns), 3)
    first = 0 if along else 3 * columns  # nothing moves the other way, as in a wave without end
    own = np.concatenate([np.arange(3 * columns), np.arange(6 * columns, 9 * columns)]) + first
    area_m2 = (nodes[0, 1, 0] - nodes[0, 0, 0]) ** 2
    pulled = np.concatenate([area_m2 / HEIGHT_M * pattern, 0 * pattern])
    moved = splu(sheet_stiffness(nodes, HEIGHT_M).tocsc()[own][:, own]).solve(pulled)[: len(pattern)]
    assert moved == pytest.approx(moved @ pattern / (pattern @ pattern) * pattern, abs=1e-9)
    return float(moved @ pattern / (pattern @ pattern))


@pytest.mark.parametrize("wavelength_mm", [8, 10, 12, 16, 20, 25, 35, 50, 100])
def test_the_sheet_answers_waves_as_the_layer_does(wavelength_mm: int) -> None:
    """Assert that from two heights on a wave along or across is answered within 2 % of the exact layer."""
    exact = compliance(np.array([2 * math.pi / (wavelength_mm * 1e-3)]), HEIGHT_M)
    along, across = (answer_along_a_line(wavelength_mm * 1e-3, along=along) for along in (True, False))
    assert along == pytest.approx(exact.along[0] / HEIGHT_M, rel=0.02)
    assert across == pytest.approx(exact.across[0] / HEIGHT_M, rel=0.02)


def test_waves_across_the_grid_are_answered_alike() -> None:
    """Assert that stretch acts on waves in any direction as along the grid, to the second order of the pitch."""
    errors = []
    for pitch_m in (1e-3, 0.5e-3):
        nodes = grid(41, 41, pitch_m)
        middle = 20 * 41 + 20
        stiffness = sheet_stiffness(nodes, HEIGHT_M).tocsr()
        worst = 0.0
        for angle in (0.3, math.pi / 4, 1.2):
            way = np.array([math.cos(angle), math.sin(angle)])
            k = 2 * math.pi / 16e-3
            wave = np.cos(k * nodes @ way).ravel()
            for stretched, direction in ((ALONG, way), (ACROSS, np.array([-way[1], way[0]]))):
                sheet = 1 / (1 + stretched * (k * HEIGHT_M) ** 2 / SPRING)
                moved = np.concatenate([wave * direction[0], wave * direction[1]])
                force = stiffness @ np.concatenate([moved, sheet * moved]) * HEIGHT_M / pitch_m**2
                of_surface, of_sheet = force[[middle, 41**2 + middle]], force[[2 * 41**2 + middle, 3 * 41**2 + middle]]
                assert of_surface @ direction == pytest.approx(1 + SPRING * (1 - sheet), rel=1e-9)
                worst = max(worst, float(np.abs(of_sheet).max()))
        errors.append(worst)
    assert errors[1] < 0.02 and errors[1] < errors[0] / 3.5


@pytest.mark.parametrize("wavelength_mm", [8, 12, 16, 25, 50, 100])
def test_pressure_squeezes_as_in_the_layer(wavelength_mm: int) -> None:
    """Assert that pressure pushes the surface by what it moves the exact layer aside, times the stiffness along.

    Within 5 % of what it does at most, which is at waves of some 19 mm.
    """
    nodes = grid(400, 4, 0.25e-3)
    k = 2 * math.pi / (wavelength_mm * 1e-3)
    exact = compliance(np.array([k, 2 * math.pi / 19e-3]), HEIGHT_M)
    expected, most = -exact.aside / exact.along
    tall = grid(400, 200, 0.25e-3)
    aside = Squeeze(tall, HEIGHT_M).of(np.cos(k * tall[..., 0]))
    found = aside[100, 150:250, 0] @ np.sin(k * nodes[0, 150:250, 0]) / (np.sin(k * nodes[0, 150:250, 0]) ** 2).sum()
    assert found == pytest.approx(expected, abs=0.05 * most)
    assert np.abs(aside[100, 150:250, 1]).max() < 1e-6


SHAPES = {
    "square of 14 mm": lambda x, y: np.maximum(np.abs(x), np.abs(y)) < 7e-3,
    "disc of 10 mm radius": lambda x, y: np.hypot(x, y) < 10e-3,
    "strip of 6 by 16 mm": lambda x, y: (np.abs(x) < 3e-3) & (np.abs(y) < 8e-3),
    "disc of 5 mm radius": lambda x, y: np.hypot(x, y) < 5e-3,
    "strip of 1.5 by 12 mm": lambda x, y: (np.abs(x) < 0.75e-3) & (np.abs(y) < 6e-3),
}


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "most"), [(shape, 0.25 if "1.5" in shape else 0.05) for shape in SHAPES])
def test_shear_and_pressure_on_shapes(shape: str, most: float) -> None:
    """Assert that a uniform shear or pressure on a shape moves the view within 5 % of what it does to the exact layer.

    A strip narrower than half a height, whose waves are too short for the sheet, within 25 %. Exact by a Fourier sum
    over a box of 64 mm; the motion is compared over 20 x 15 mm, its rms over that of the exact.
    """
    count, pitch_m = 128, 0.5e-3
    nodes = grid(count, count, pitch_m)
    x, y = nodes[..., 0], nodes[..., 1]
    inside = SHAPES[shape](x, y).astype(float)
    waves = 2 * math.pi * np.fft.fftfreq(count, pitch_m)
    kx, ky = np.meshgrid(waves, waves)
    k = np.hypot(kx, ky)
    k[0, 0] = 1.0
    exact = compliance(k.ravel(), HEIGHT_M)
    along, across, aside = (part.reshape(k.shape) for part in (exact.along, exact.across, exact.aside))
    along[0, 0] = across[0, 0] = HEIGHT_M
    aside[0, 0] = 0.0
    towards = np.stack([kx / k, ky / k])
    hat = np.fft.fft2(inside)
    solve = splu(sheet_stiffness(nodes, HEIGHT_M).tocsc()).solve
    view = (np.abs(x) < 10e-3) & (np.abs(y) < 7.5e-3)
    nodes_n = count**2

    def compare(exact_hat: Fields, pulled: Fields) -> None:
        expected = np.fft.ifft2(exact_hat).real[:, view]
        found = solve(np.concatenate([pulled.ravel(), np.zeros(2 * nodes_n)]))[: 2 * nodes_n].reshape(2, count, count)
        off = found[:, view] - expected
        assert math.sqrt((off**2).sum() / (expected**2).sum()) < most

    split = towards[0] * towards * (along - across) + np.stack([across, 0 * across])
    compare(split * hat, np.stack([inside * pitch_m**2, 0 * inside]))
    pushed = Squeeze(nodes, HEIGHT_M).of(inside * pitch_m**2)
    compare(1j * aside * towards * hat, np.moveaxis(pushed, 2, 0))
