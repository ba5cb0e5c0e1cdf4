"""Vibration in a stream of events: the frequency at which the gel vibrates, or that it does not.

There are two methods. The paper's takes the strongest line in the spectrum of the number of events per slice. A rim
that swings back and forth has events in both directions, so this number also oscillates at twice the tone. A rattling
contact adds half the tone, and slices of a millisecond alias everything above 500 Hz. In short windows one of these
lines is sometimes the strongest.

The other method follows motion. A pixel on a rim gets brighter while the rim moves forward and darker while it moves
back. So brighter minus darker events is the rate of change of its brightness, at the frequency of the tone itself. In a
sum over the frame, both sides of a dot would cancel. So the frame is divided into cells smaller than a dot, each with
its own spectrum, and their powers are summed. Neither the dots nor the direction of motion need to be known. Speed
divided by frequency is the displacement of a line, and the tone is the line with the largest product of displacement
and speed.

Reasons:
- Events are counted at 5 kHz or more for any band: the camera scans 5000 times per second, so nothing is aliased into
  the band, and a line above it is reported as such.
- In each cell, power is divided by the noise there, the median around a frequency. Without a line the result is
  exponential with mean 1 in any cell, for any kind of noise (hot pixels, slow motion). The sum over cells is then a
  gamma variate, which gives the threshold. No cell counts for more than LARGEST: one blinking pixel is not a vibration.
- By speed alone, the second harmonic of a speaker would win (simulated: up to 1.1 times the tone). By displacement
  alone a subharmonic would, as the sensor sees large swings and misses small ones (up to 0.93 times the tone). Their
  product is off by the same factor on either side: in it no other line exceeded 0.83.
- Hann windows are used, because their leakage from slow motion and strong lines falls with the cube of the distance.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, special

from evetac_cli.arrays import Floats, Singles
from evetac_cli.kernels.compiled import njit

FINEST_HZ = 5000  # scan rate of the camera
CELL_PX = 16  # side of a cell; a dot's two sides are 30 px apart
HANN_SQUARED = 0.375  # mean square of the window
LEAST_EVENTS = 10  # of a cell; with fewer it is left out
LARGEST = 12.0  # largest evidence of one cell, as power over noise: noise exceeds it once in 160,000
NOISE_HZ = 50.0  # width of the spectrum over which the noise is a median
NOISE_BINS = 32  # ... or this many frequencies, if that is more
CELLS_AT_ONCE = 64  # processed together, to bound memory
LINE_HALF_BINS = 2.0  # half the width of a line
SPREAD_BINS = 0.608  # sd of a line's position times the root of its power over the noise, see `locate`

Tally = NDArray[np.int16]


@njit(cache=True)
def add_events(
    tally: Tally,
    t_us: NDArray[np.int64],
    x_px: NDArray[np.uint16],
    y_px: NDArray[np.uint16],
    brighter: NDArray[np.uint8],
    start_us: int,
    rate_hz: int,
    cells_across: int,
) -> None:
    """Add +1 for every brighter event and -1 for every other to `tally` (cells, bins), in its cell and time bin.

    Bins are 1 / `rate_hz` long, starting at `start_us`; events outside the bins or cells are left out.
    """
    cells = tally.shape[0]
    bins = tally.shape[1]
    for k in range(t_us.shape[0]):
        place = (t_us[k] - start_us) * rate_hz // 1_000_000
        cell = (y_px[k] // CELL_PX) * cells_across + x_px[k] // CELL_PX
        if place < 0 or place >= bins or cell >= cells:
            continue
        if brighter[k]:
            tally[cell, place] += 1
        else:
            tally[cell, place] -= 1


def cell_grid(frame_px: tuple[int, int]) -> tuple[int, int]:
    """Return the columns and rows of cells that cover a frame."""
    width, height = frame_px
    assert width >= 1 and height >= 1
    return math.ceil(width / CELL_PX), math.ceil(height / CELL_PX)


class Spectrum(NamedTuple):
    """Sums over cells and windows at `frequency_hz` (frequencies,), from 0 to half the rate."""

    frequency_hz: Floats
    evidence: Floats  # power over noise, limited to LARGEST per cell
    power: Floats  # power over the larger of the noise and the power of events at random times
    speed: Floats  # power of brighter minus darker events
    terms: int  # number of cells, summed over windows

    def plus(self, other: "Spectrum") -> "Spectrum":
        """Return the sum with another window's spectrum, of the same length and rate."""
        assert np.array_equal(self.frequency_hz, other.frequency_hz)
        return Spectrum(
            self.frequency_hz,
            self.evidence + other.evidence,
            self.power + other.power,
            self.speed + other.speed,
            self.terms + other.terms,
        )


class SpectralLine(NamedTuple):
    """One line of a spectrum."""

    frequency_hz: float
    uncertainty_hz: float  # one sd
    motion: float  # displacement of the gel, in arbitrary units
    power: float  # over the noise


class Finding(NamedTuple):
    """The tone in a spectrum, or None; its harmonics; and a line above the band that would otherwise be the tone."""

    tone: SpectralLine | None
    harmonics: dict[float, float]  # order (0.5, 2, 3, ...) -> displacement over the tone's, 0 without a line
    above_band: SpectralLine | None


def spectrum(tally: Tally, rate_hz: float) -> Spectrum:
    """Return the sum of the cells' spectra over one window of signed events, `tally` (cells, bins) at `rate_hz`."""
    assert tally.ndim == 2 and tally.shape[1] >= 4 * NOISE_BINS and rate_hz > 0.0
    bins = tally.shape[1]
    window = _hann(bins)
    frequency_hz = np.arange(bins // 2 + 1) * (rate_hz / bins)
    evidence, power, speed = np.zeros((3, len(frequency_hz)))
    terms = 0
    for first in range(0, len(tally), CELLS_AT_ONCE):
        cells = tally[first : first + CELLS_AT_ONCE]
        cells = cells[np.count_nonzero(cells, axis=1) >= LEAST_EVENTS].astype(np.float32)
        if not len(cells):
            continue
        energy = np.square(cells).sum(axis=1)
        cells -= cells.mean(axis=1, keepdims=True)
        lines = fft.rfft(cells * window, axis=1)
        powers = np.square(lines.real) + np.square(lines.imag)
        speed += powers.sum(axis=0)
        noise = _noise(powers, bins / rate_hz)
        evidence += np.minimum(powers / noise, LARGEST).sum(axis=0)
        power += (powers / np.maximum(noise, HANN_SQUARED * energy[:, None])).sum(axis=0)
        terms += len(cells)
    return Spectrum(frequency_hz, evidence, power, speed, terms)


def _hann(bins: int) -> Singles:
    return (0.5 - 0.5 * np.cos(2 * np.pi * np.arange(bins) / bins)).astype(np.float32)


def _noise(powers: NDArray, duration_s: float, of_median: float = math.log(2)) -> NDArray:
    """Return the mean of the noise at all frequencies, (..., frequencies): medians over blocks, linear in between.

    `of_median` is the median of noise whose mean is 1; that of a periodogram is ln 2.
    """
    frequencies = powers.shape[-1] - 1  # all but 0
    width = min(max(NOISE_BINS, round(NOISE_HZ * duration_s)), frequencies)
    blocks = frequencies // width
    parts = powers[..., 1 : 1 + blocks * width].reshape(*powers.shape[:-1], blocks, width)
    medians = np.median(parts, axis=-1) / of_median
    # A cell with a handful of events can have no noise at all in a block; its power there is then no evidence.
    medians = np.maximum(medians, 1e-3 * medians.max(axis=-1, keepdims=True) + 1e-12).astype(powers.dtype)
    place = np.clip((np.arange(frequencies + 1) - 0.5 - width / 2) / width, 0.0, blocks - 1.0)
    before = np.minimum(place.astype(np.int64), max(blocks - 2, 0))
    share = (place - before).astype(powers.dtype)
    after = np.minimum(before + 1, blocks - 1)
    noise: NDArray = medians[..., before] * (1 - share) + medians[..., after] * share
    return noise


def find(sums: Spectrum, lowest_hz: float, highest_hz: float, false_alarms: float = 0.01) -> Finding:
    """Find the tone in [lowest_hz, highest_hz], its harmonics, and a stronger line above.

    A line is a peak of the evidence above a threshold. Noise alone would exceed the threshold anywhere above
    `lowest_hz` with a probability of at most `false_alarms`. It follows from the tail of a gamma variate with as many
    terms as cells, with the probability divided by the number of frequencies (Bonferroni). The tone is the line with
    the largest product of displacement and speed. If that line is above the band, there is no tone, but `above_band`.
    """
    assert 0.0 < lowest_hz < highest_hz < math.inf and 0.0 < false_alarms < 1.0
    lines = list(_lines(sums, lowest_hz, false_alarms))
    if not lines:
        return Finding(None, {}, None)
    resolution_hz = float(sums.frequency_hz[1])
    tone = max(lines, key=lambda line: line.motion**2 * line.frequency_hz)
    if tone.frequency_hz > highest_hz + resolution_hz / 2:
        return Finding(None, {}, tone)
    orders = [0.5, *np.arange(2.0, sums.frequency_hz[-1] / tone.frequency_hz).tolist()[:4]]
    others = {order: _line_near(lines, order * tone.frequency_hz, resolution_hz) for order in orders}
    return Finding(tone, {order: other.motion / tone.motion if other else 0.0 for order, other in others.items()}, None)


def _line_near(lines: list[SpectralLine], frequency_hz: float, resolution_hz: float) -> SpectralLine | None:
    """Return the line nearest to a frequency if it is within its own width; else None."""
    near = min(lines, key=lambda line: abs(line.frequency_hz - frequency_hz))
    return near if abs(near.frequency_hz - frequency_hz) <= LINE_HALF_BINS * resolution_hz else None


def _lines(sums: Spectrum, lowest_hz: float, false_alarms: float) -> Iterator[SpectralLine]:
    """Yield all lines above `lowest_hz` that exceed the noise."""
    if sums.terms == 0:
        return
    resolution_hz = float(sums.frequency_hz[1])
    first = max(math.ceil(lowest_hz / resolution_hz), 2)
    last = len(sums.frequency_hz) - 2
    if first >= last:
        return
    terms = float(sums.terms)
    duration_s = 1.0 / resolution_hz
    # The noise is itself a median of few frequencies, so means are not exactly 1; medians of the sums correct this.
    median_share = float(special.gammaincinv(terms, 0.5)) / terms
    evidence = sums.evidence / _noise(sums.evidence, duration_s, median_share) * terms
    power = sums.power - _noise(sums.power, duration_s, 1.0)
    speed = np.maximum(sums.speed - _noise(sums.speed, duration_s, 1.0), 0.0)
    threshold = float(special.gammainccinv(terms, false_alarms / (last - first)))
    peak = evidence[first:last]
    is_line = (peak > threshold) & (power[first:last] > 0.0) & (power[first:last] >= power[first - 1 : last - 1])
    is_line &= power[first:last] > power[first + 1 : last + 1]
    for k in np.flatnonzero(is_line) + first:
        frequency_hz, uncertainty_hz = locate(power, int(k), terms, resolution_hz)
        motion = math.sqrt(speed[k - 1 : k + 2].sum()) / frequency_hz
        yield SpectralLine(frequency_hz, uncertainty_hz, motion, float(power[k]))


def locate(power: Floats, k: int, terms: float, resolution_hz: float) -> tuple[float, float]:
    """Return the frequency of the line whose highest bin is `k`, in Hz, and its sd.

    `power`: power minus noise, a sum of `terms` terms. With a Hann window, a sine is at exactly k + (2 r - 1) / (1 +
    r). Here r is the amplitude of the next bin over that of bin k; the same applies on the other side. The result is
    the mean of both positions, weighted by their bins' power.

    The window correlates the noise of neighbouring bins. To first order, the position of a sine in the middle of a bin
    has an sd of 0.608 bins over the root of power over noise, and less between bins. The Cramer-Rao bound of a window
    without taper is 0.32. With many terms, noise also interferes with noise. If the tone is not steady, the three bins
    do not have the shape of a sine. The deviation of their sum is then added to the sd, as that of their difference may
    be as large.
    """
    below, at, above = np.sqrt(np.maximum(power[k - 1 : k + 2], 0.0)).tolist()
    places = ((at - 2.0 * below) / (at + below), (2.0 * above - at) / (at + above))
    weight = below**2 + above**2
    shift = (below**2 * places[0] + above**2 * places[1]) / weight if weight > 0.0 else 0.0
    shift = min(max(shift, -1.0), 1.0)
    of_sine = (1.0 - shift) / (2.0 + shift) + (1.0 + shift) / (2.0 - shift)
    misshapen = 2.0 / 3.0 * abs((below + above) / at - of_sine)
    spread = SPREAD_BINS * math.sqrt((1.0 + 2.0 * terms / power[k]) / power[k])
    return (k + shift) * resolution_hz, math.hypot(spread, misshapen) * resolution_hz


def strongest_of_counts(counts: NDArray, rate_hz: float, lowest_hz: float) -> float | None:
    """Return the frequency of the largest amplitude of `counts` (bins,), in Hz: the paper's "Sensing Vibrations".

    Everything below `lowest_hz` is removed. There is no threshold, so noise has a frequency, too. None if every bin has
    the same number of events, or if nothing remains.
    """
    amplitude = np.abs(fft.rfft(np.asarray(counts, np.float64) - np.mean(counts))) if len(counts) else np.zeros(0)
    frequency_hz = np.arange(len(amplitude)) * (rate_hz / max(len(counts), 1))
    amplitude[frequency_hz < lowest_hz] = 0.0
    if not amplitude.any():
        return None
    return float(frequency_hz[np.argmax(amplitude)])
