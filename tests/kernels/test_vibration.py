"""Spectra of events: exact lines, chances of finding one, false alarms, what folds and what beats at twice the tone."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import special, stats

from evetac_cli.kernels import vibration
from evetac_cli.kernels.vibration import CELL_PX, add_events, cell_grid, find, locate, strongest_of_counts
from tests.quick import few

RATE_HZ = 1000
BINS = 1000


def trains(
    rng: np.random.Generator,
    *,
    tone_hz: float = 0.0,
    depth: float = 0.0,
    cells: int = 64,
    events: float = 400.0,
    bins: int = BINS,
    rate_hz: float = RATE_HZ,
) -> NDArray[np.int16]:
    """Poisson trains: `events` a cell; polarity follows a sine of random phase a cell and this depth, times do not."""
    time_s = (np.arange(bins) + 0.5) / rate_hz
    turn = 2 * np.pi * tone_hz * time_s + rng.uniform(0, 2 * np.pi, (cells, 1))
    lean = depth * np.sin(turn)
    mean = events / bins / 2
    return (rng.poisson(mean * (1 + lean)) - rng.poisson(mean * (1 - lean))).astype(np.int16)


def tone_of(tally: NDArray[np.int16], rate_hz: float = RATE_HZ, **how: Any) -> vibration.SpectralLine | None:
    """The tone between 25 Hz and half the rate."""
    return find(vibration.spectrum(tally, rate_hz), 25.0, rate_hz / 2, **how).tone


@given(seed=st.integers(0, 10_000), rate_hz=st.integers(100, 20_000))
@settings(max_examples=30, deadline=None)
def test_events_are_added_where_and_when_they_were(seed: int, rate_hz: int) -> None:
    """Assert that every event counts once, with its sign, in its cell and bin, and those outside not at all."""
    rng = np.random.default_rng(seed)
    across, down = cell_grid((100, 50))
    t_us = np.sort(rng.integers(0, 30_000, 500))
    x_px, y_px = (rng.integers(0, most, 500).astype(np.uint16) for most in (across * CELL_PX, down * CELL_PX))
    brighter = rng.integers(0, 2, 500).astype(np.uint8)
    bins = 20 * rate_hz // 1000
    tally = np.zeros((across * down, bins), np.int16)
    add_events(tally, t_us, x_px, y_px, brighter, 5000, rate_hz, across)
    place = np.array([(t - 5000) * rate_hz // 1_000_000 for t in t_us.tolist()])
    inside = (place >= 0) & (place < bins)
    wanted = np.zeros_like(tally)
    cell = y_px // CELL_PX * across + x_px // CELL_PX
    np.add.at(wanted, (cell[inside], place[inside]), 2 * brighter[inside].astype(np.int16) - 1)
    assert (tally == wanted).all()


@given(place=st.floats(20.0, 40.0), height=st.floats(1e-3, 1e6))
def test_a_sine_is_located_exactly(place: float, height: float) -> None:
    """Assert that the place of a noiseless sine comes out exactly, wherever between two bins it lies."""
    power = height * np.square(_hann_line(np.arange(64) - place))
    found_hz, _ = locate(power, int(np.argmax(power)), 64.0, 0.5)
    assert found_hz == pytest.approx(place * 0.5, abs=1e-6)


def _hann_line(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Amplitude of a Hann window's spectrum at a distance in bins."""
    return 0.5 * np.sinc(distance) + 0.25 * (np.sinc(distance - 1) + np.sinc(distance + 1))


def test_power_of_a_line() -> None:
    """Assert that power over noise is that of Poisson trains: depth^2 events / 6 a cell, with a Hann window.

    It is a little less, as noise counts as the larger of what is measured and what events at random times have.
    """
    rng = np.random.default_rng(0)
    depth, events, cells = 0.5, 400.0, 64
    at = 200 * BINS // RATE_HZ
    powers = [vibration.spectrum(trains(rng, tone_hz=200.0, depth=depth), RATE_HZ).power[at] / cells for _ in range(40)]
    wanted = 1 + depth**2 * events / 6
    assert 0.87 * wanted < np.mean(powers) < 1.01 * wanted


def test_frequency_error_against_the_bound() -> None:
    """Assert that the error lies between the Cramer-Rao bound and twice it, and is as large as it is said to be."""
    rng = np.random.default_rng(1)
    depth, events, cells, duration_s = 0.6, 400.0, 64, BINS / RATE_HZ
    over_noise = depth**2 * events * cells / 4  # of a window without taper
    bound_hz = math.sqrt(6 / over_noise) / (2 * np.pi * duration_s)
    errors, stated_hz = [], []
    for _ in range(100):
        tone_hz = rng.uniform(199.5, 200.5)
        result = tone_of(trains(rng, tone_hz=tone_hz, depth=depth))
        assert result is not None
        errors.append(result.frequency_hz - tone_hz)
        stated_hz.append(result.uncertainty_hz)
    rms_hz = math.sqrt(np.mean(np.square(errors)))
    assert bound_hz < rms_hz < 2.1 * bound_hz
    assert 0.7 * rms_hz < math.sqrt(np.mean(np.square(stated_hz))) < 1.8 * rms_hz
    assert abs(np.mean(errors)) < 4 * rms_hz / math.sqrt(len(errors))


@pytest.mark.parametrize("wanted", few([0.2, 0.5, 0.95], 0.5))
def test_chance_of_finding_a_weak_tone(wanted: float) -> None:
    """Assert that a tone is found as often as noncentral chi-square statistics of a periodogram say."""
    rng = np.random.default_rng(2)
    cells, events, false_alarms, trials = 64, 400.0, 0.01, 100
    frequencies = BINS // 2 - 1 - 25
    threshold = special.gammainccinv(cells, false_alarms / frequencies)
    centrality = _solve(lambda total: stats.ncx2.sf(2 * threshold, 2 * cells, 2 * total), wanted)
    depth = math.sqrt(6 * centrality / (cells * events))
    result = [tone_of(trains(rng, tone_hz=200.0, depth=depth), false_alarms=false_alarms) for _ in range(trials)]
    right = sum(line is not None and abs(line.frequency_hz - 200.0) < 1.0 for line in result)
    assert abs(right / trials - wanted) < 0.04 + 3.3 * math.sqrt(wanted * (1 - wanted) / trials)


def _solve(chance: Any, wanted: float) -> float:
    low, high = 0.0, 1000.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if chance(middle) < wanted else (low, middle)
    return low


def _steady(rng: np.random.Generator) -> NDArray[np.int16]:
    return trains(rng)


def _uneven(rng: np.random.Generator) -> NDArray[np.int16]:
    """Cells of very different rates, most of one polarity, some of them hot."""
    events = 10.0 ** rng.uniform(1.5, 4.0, 64)
    return np.concatenate([rng.poisson(n / BINS, (1, BINS)).astype(np.int16) for n in events])


def _drifting(rng: np.random.Generator) -> NDArray[np.int16]:
    """Slow motion beside noise: a spectrum that falls with frequency."""
    slow = np.cumsum(rng.normal(size=(64, BINS)), axis=1) * 0.02
    slow -= slow.mean(axis=1, keepdims=True)
    return (rng.poisson(0.5, (64, BINS)) - rng.poisson(0.5, (64, BINS)) + np.round(slow)).astype(np.int16)


@pytest.mark.parametrize("noise", [_steady, _uneven, _drifting], ids=["steady", "uneven", "drifting"])
def test_false_alarms(noise: Any) -> None:
    """Assert that noise is taken for a vibration no more often than was asked for, and not never, with any spectrum."""
    rng = np.random.default_rng(3)
    trials, asked = 100, 0.25
    alarms = sum(
        bool(list(vibration._lines(vibration.spectrum(noise(rng), RATE_HZ), 25.0, asked))) for _ in range(trials)
    )
    assert alarms <= stats.binom.isf(1e-3, trials, asked)
    assert noise is not _steady or alarms >= 3


def test_the_tone_and_not_twice_it() -> None:
    """Assert that rims that go back and forth, on both sides, give the tone; the count beats at twice it."""
    time_s = (np.arange(10_000) + 0.5) / 5000
    speed = np.cos(2 * np.pi * 110.0 * time_s)
    side = np.repeat([1, -1], 8)[:, None]
    tally = np.round(6 * side * speed).astype(np.int16)
    counts = np.abs(tally).sum(axis=0).reshape(-1, 5).sum(axis=1)
    assert strongest_of_counts(counts, 1000, 25.0) == pytest.approx(220.0, abs=0.5)
    result = find(vibration.spectrum(tally, 5000), 25.0, 500.0)
    assert result.tone is not None
    assert result.tone.frequency_hz == pytest.approx(110.0, abs=0.01)


def test_a_speaker_with_harmonics() -> None:
    """Assert that the tone wins over harmonics whose speed is as large, and that they are told as what they move."""
    rng = np.random.default_rng(4)
    time_s = (np.arange(10_000) + 0.5) / 5000
    speed = sum(
        order * share * np.cos(2 * np.pi * 150.0 * order * time_s + order)
        for order, share in ((0.5, 0.3), (1.0, 1.0), (2.0, 0.45), (3.0, 0.2))
    )
    lean = rng.choice([-1.0, 1.0], (40, 1)) * speed * 0.3
    tally = (rng.poisson(np.maximum(1 + lean, 0)) - rng.poisson(np.maximum(1 - lean, 0))).astype(np.int16)
    result = find(vibration.spectrum(tally, 5000), 25.0, 500.0)
    assert result.tone is not None
    assert result.tone.frequency_hz == pytest.approx(150.0, abs=0.02)
    for order, share in ((0.5, 0.3), (2.0, 0.45), (3.0, 0.2)):
        assert result.harmonics[order] == pytest.approx(share, rel=0.1)


@pytest.mark.parametrize(("tone_hz", "folded_hz"), [(600.0, 400.0), (1300.0, 300.0), (1750.0, 250.0)])
def test_nothing_folds(tone_hz: float, folded_hz: float) -> None:
    """Assert that a tone beyond the band is told as such, where a count a slice shows it folded."""
    rng = np.random.default_rng(5)
    tally = trains(rng, tone_hz=tone_hz, depth=0.8, bins=5000, rate_hz=5000)
    result = find(vibration.spectrum(tally, 5000), 25.0, 500.0)
    assert result.tone is None
    assert result.above_band is not None
    assert result.above_band.frequency_hz == pytest.approx(tone_hz, abs=0.2)
    within = find(vibration.spectrum(tally, 5000), 25.0, 2500.0).tone
    assert within is not None and within.frequency_hz == result.above_band.frequency_hz
    counts = rng.poisson(50 * (1 + 0.8 * np.cos(2 * np.pi * tone_hz * np.arange(1000) / 1000)))
    assert strongest_of_counts(counts, 1000, 25.0) == pytest.approx(folded_hz)


def test_nothing_is_no_vibration() -> None:
    """Assert that without events, or with the same number in every bin, there is no frequency."""
    silent = vibration.spectrum(np.zeros((4, 500), np.int16), 1000)
    assert silent.terms == 0
    assert find(silent, 25.0, 500.0) == (None, {}, None)
    assert strongest_of_counts(np.zeros(100, int), 1000, 25.0) is None
    assert strongest_of_counts(np.full(100, 7), 1000, 25.0) is None
    assert strongest_of_counts(np.zeros(0, int), 1000, 25.0) is None


def test_counts_below_the_lowest_are_removed() -> None:
    """Assert that the paper's method leaves out what is below 25 Hz, and keeps 25 Hz itself."""
    time_s = np.arange(1000) / 1000
    counts = 100 + 50 * np.sin(2 * np.pi * 24 * time_s) + 5 * np.sin(2 * np.pi * 25 * time_s)
    assert strongest_of_counts(counts, 1000, 25.0) == 25.0
