"""Friction that varies over an object: a field that does not depend on the grid, and moves with the object."""

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.roughness import FINE, POINTS, Roughness, cell_means
from evetac_cli.sim.setup.scene import ObjectRoughness

LENGTH_M = 0.5e-3
SPACING_M = LENGTH_M / FINE


def rough(shape: tuple[int, int] = (9, 12), pitch_m: float = 1e-3, sd: float = 0.5, seed: int = 0) -> Roughness:
    """Return the roughness of an object on a pad of nodes at a pitch."""
    rows, columns = (pitch_m * (np.arange(count) - (count - 1) / 2) for count in shape)
    nodes = np.stack(np.meshgrid(columns, rows), axis=-1)
    state = gel.start(nodes, gel.GelMaterial(), 0.1, 1e-4)
    return Roughness(state, sd, LENGTH_M, np.random.default_rng(seed))


def field(sd: float, pitch_m: float, seed: int) -> NDArray[np.float64]:
    return cell_means(sd, LENGTH_M, (pitch_m, pitch_m), np.random.default_rng(seed))


def test_points_have_the_deviation_and_correlation_that_are_named() -> None:
    """Assert mean 1, the standard deviation, and the correlation of the logarithm at some distances, over 20 fields."""
    fields = np.stack([field(0.8, 0.0, seed) for seed in range(20)])
    assert fields.mean() == pytest.approx(1.0, abs=1e-12)
    assert fields.std() == pytest.approx(0.8, rel=0.05)
    logs = np.log(fields)
    logs -= logs.mean()
    for points in (2, 4, 8):
        product = (logs * np.roll(logs, points, axis=1)).mean() / logs.var()
        assert product == pytest.approx(np.exp(-((points / FINE) ** 2) / 2), abs=0.02)


def test_a_coarse_cell_has_the_mean_of_the_fine_cells_in_it() -> None:
    """Assert that cells of twice the pitch hold the mean of four, exactly, so forces do not depend on the grid."""
    fine, coarse = field(0.5, 1e-3, 1), field(0.5, 2e-3, 1)
    off = round(0.5e-3 / SPACING_M)
    four = [np.roll(fine, (down, right), axis=(0, 1)) for down in (-off, off) for right in (-off, off)]
    np.testing.assert_allclose(np.mean(four, axis=0), coarse, atol=1e-12)


def test_the_variance_of_a_large_cell() -> None:
    """Assert the closed form for weak roughness in cells of many lengths, of which each direction has one factor."""
    cells = [field(0.1, 4e-3, seed) for seed in range(60)]
    of_line = np.sqrt(2 * np.pi) * LENGTH_M / 4e-3 - 2 * (LENGTH_M / 4e-3) ** 2
    assert np.var(cells) == pytest.approx((0.1 * of_line) ** 2, rel=0.1)


def test_the_field_moves_and_turns_with_the_object() -> None:
    """Assert that spots stay with the object: equal factors for equal places on it, however both have moved."""
    surface = rough(shape=(10, 10))
    state = surface._state
    before = surface.factor(1e-3).copy()
    assert before.std() > 0.1
    state.pose[:2] += (0.3e-3, -0.2e-3)
    assert np.abs(surface.factor(1e-3) - before).max() > 0.05
    state.displacement_m[:] = (0.3e-3, -0.2e-3)
    np.testing.assert_allclose(surface.factor(1e-3), before, atol=1e-9)
    state.displacement_m[:], state.pose[:] = 0.0, (0.0, 0.0, np.pi / 2)
    np.testing.assert_allclose(surface.factor(1e-3), np.rot90(before, -1), atol=1e-9)


def test_a_fast_node_feels_the_mean_of_its_path() -> None:
    """Assert that a node that slides many lengths in a slice feels about the mean, and a stuck node its own spot."""
    surface = rough(shape=(30, 30))
    state = surface._state
    still = surface.factor(1e-3).std()
    state.twist[0] = 10.0
    assert surface.factor(1e-3).std() == pytest.approx(still, abs=1e-12)  # no node slips
    state.slip_m_s[:] = 10.0
    assert surface.factor(1e-3).std() < 0.5 * still


def slid(speed_m_s: float, pitch_m: float) -> NDArray[np.float64]:
    """Return the friction of each node, (ms, nodes), in half a second in which an object slides over a pad."""
    count = round(10e-3 / pitch_m)
    surface = rough((count, count), pitch_m)
    state = surface._state
    state.slip_m_s[:], state.twist[0] = speed_m_s, speed_m_s
    found = []
    for _ in range(512):
        found.append(surface.factor(1e-3).copy())
        state.pose[0] += speed_m_s * 1e-3
    return np.array(found)


def shares(signals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the shares of the power of signals of 1 kHz below 10, 10 to 50, 50 to 200 and above 200 Hz."""
    spectrum = (np.abs(np.fft.rfft(signals - signals.mean(axis=0), axis=0)) ** 2).reshape(257, -1).sum(axis=1)
    hz = np.fft.rfftfreq(512, 1e-3)
    ends = ((0, 10), (10, 50), (50, 200), (200, 501))
    return np.array([spectrum[(hz > low) & (hz <= high)].sum() for low, high in ends]) / spectrum.sum()


def test_the_band_of_sliding_rises_with_the_speed_and_not_with_the_grid() -> None:
    """Assert where a node's friction fluctuates: up to speed / (2 pi length), as the mean of four nodes half as far."""
    for speed_m_s in (0.02, 0.1):
        coarse, fine = slid(speed_m_s, 1e-3), slid(speed_m_s, 0.5e-3)
        four = fine.reshape(512, 10, 2, 10, 2).mean(axis=(2, 4))
        np.testing.assert_allclose(four, coarse, atol=0.02)
    slow, fast = (shares(slid(speed, 1e-3)) for speed in (0.005, 0.3))
    assert slow[0] > 0.95  # 2 Hz
    assert fast[0] < 0.15 and fast[1:3].sum() > 0.8  # 95 Hz


def test_the_field_of_the_usual_length_is_longer_than_a_slip() -> None:
    """Assert that the field repeats after 64 mm; a ramp ends once the object has slid 20 mm."""
    assert POINTS * ObjectRoughness().length_mm / FINE == 64
