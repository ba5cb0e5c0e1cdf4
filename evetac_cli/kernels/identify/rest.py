"""The noise of a camera from events at rest: rates of ordinary pixels, and a table of hot pixels and their intervals.

Nothing may move in the picture. A pixel is listed as hot above HOT_HZ if the rate of ordinary pixels cannot explain its
count. The limit is low because pixels of a real camera have all rates. Only a table down to 5 Hz gives a simulated
sensor as many pixels above 20 Hz, the usual limit, as the camera has.

Intervals are the times between events of one hot pixel, in us. Their model: a time stamp step, a shortest time (dead
time) and a mixture of two exponentials. It has no source in the literature; it fits a real DVXplorer
(sim/camera/noise.py).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import convolve

from evetac_cli.arrays import Floats, Ints
from evetac_cli.kernels.estimates import BLOCKS, Estimate, of_samples, poisson_rate, rate_over_blocks, share

HOT_HZ = 5.0  # slowest pixel that is listed as hot
SHOWN_HZ = 20.0  # usual limit for hot pixels, for the reported counts
RESAMPLES = 1000  # of the bootstrap
FEWEST_EVENTS = 6  # of a hot pixel
FALSE_ALARMS = 0.01  # expected number of ordinary pixels in the whole frame that are mistaken for hot ones
MOST_HOT_SHARE = 0.02  # of all pixels; with more, something moves in the picture
FEW_HOT = 10  # this many may be side by side by chance
# share of hot pixels; with more, something moves: 97 % of a DVXplorer's hot pixels are isolated
MOST_SIDE_BY_SIDE = 0.5
LONGEST_SHARE = 0.98  # of a pixel's mean interval: most that dead time and short intervals may take up

FEWEST_INTERVALS = 200  # for time stamp step and dead time
MOST_INTERVALS = 20_000  # used for the time stamp step
LONGEST_INTERVAL_US = 20_000.0  # for the step: in longer intervals a small error of the step adds up to a whole step
HIGHEST_HZ, STEP_HZ = 20_000.0, 5.0  # range and resolution of the frequency scan for the step
SLOWEST_SCAN = 3.0  # lowest scanned frequency over the mean rate; slower steps cannot be distinguished from slow pixels
COHERENT = 0.8  # smallest mean of the phases' unit vectors for a step; 1 if all intervals are whole steps
DEAD_SHARES = (0.02, 0.04)  # quantiles of the intervals from which the shortest possible interval is extrapolated
DEAD_RESAMPLES = 200  # of the bootstrap
FEWEST_FOR_TWO = 15  # intervals of a pixel, for a mixture of two exponentials
WORTH_IT = 2.0  # gain in log likelihood that two exponentials must reach (Akaike: two more parameters)
MEANS = np.geomspace(0.05, 1e4, 48)  # candidate means of an exponential, in steps
ROUNDS = 25  # of expectation maximisation for the share of an exponential
EXACT_BELOW, BINS_A_DECADE = 32, 20  # intervals of at least this many steps are binned


class HotPixelRates(NamedTuple):
    """Hot pixels, one entry each; `low_hz` and `high_hz` are the 95 % intervals of `rate_hz`."""

    x_px: Ints
    y_px: Ints
    rate_hz: Floats
    low_hz: Floats
    high_hz: Floats
    on_share: Floats
    polarity_change_share: Floats
    short_interval_share: Floats
    short_interval_us: Floats


class RestNoise(NamedTuple):
    """Noise of a camera at rest; None for quantities that the events do not determine."""

    duration_s: float
    noise_hz: Estimate
    noise_on_share: Estimate
    hot_pixels: Estimate  # number above SHOWN_HZ
    hot_total_hz: Estimate  # events per second of all of them together
    hot_on_share: Estimate
    dead_time_us: Estimate | None
    timestamp_step_us: Estimate | None
    table: HotPixelRates


def analyse(
    t_us: Ints,
    x: NDArray,
    y: NDArray,
    p: NDArray,
    frame_px: tuple[int, int],
    duration_us: int,
    rng: np.random.Generator,
) -> RestNoise:
    """Estimate the noise from events of `duration_us`, in order of time, t from 0; `rng` is for bootstrap intervals.

    Shares have Wilson intervals. Rates have exact intervals, or those of their spread over blocks of time if these are
    wider. ValueError if so many pixels are busy that something must move.
    """
    width, height = frame_px
    duration_s = duration_us * 1e-6
    pixel = y.astype(np.int64) * width + x
    counts = np.bincount(pixel, minlength=width * height)
    is_hot = find_hot(counts, duration_s)
    check_still(is_hot.reshape(height, width))
    of_hot = is_hot[pixel]
    block = np.minimum(t_us * BLOCKS // duration_us, BLOCKS - 1)
    ordinary = np.bincount(block[~of_hot], minlength=BLOCKS)
    busy = np.bincount(block[of_hot], minlength=BLOCKS)
    order = np.lexsort((t_us[of_hot], pixel[of_hot]))
    hot_t, hot_pixel, hot_p = (column[of_hot][order] for column in (t_us, pixel, p))
    follows = hot_pixel[1:] == hot_pixel[:-1]
    between_us = np.diff(hot_t)[follows].astype(np.float64)
    step_us = time_step(between_us)
    dead_us = dead_time(between_us, step_us.value if step_us else 0.0, rng)
    laws = (dead_us.value if dead_us else 0.0, step_us.value if step_us else 0.0)
    table = _table(hot_t, hot_pixel, hot_p, width, duration_s, *laws)
    busiest = counts[counts > SHOWN_HZ * duration_s]
    near = counts[(counts > SHOWN_HZ * duration_s / 3) & is_hot]
    resampled = (rng.poisson(near, (RESAMPLES, len(near))) > SHOWN_HZ * duration_s).sum(axis=1)
    return RestNoise(
        duration_s=duration_s,
        noise_hz=rate_over_blocks(ordinary, duration_s * int((~is_hot).sum())),
        noise_on_share=share(int(p[~of_hot].sum()), int(ordinary.sum())),
        hot_pixels=of_samples(float(len(busiest)), resampled.astype(np.float64)),
        hot_total_hz=rate_over_blocks(busy, duration_s),
        hot_on_share=share(int(hot_p.sum()), len(hot_p)),
        dead_time_us=dead_us,
        timestamp_step_us=step_us,
        table=table,
    )


def check_still(is_hot: NDArray[np.bool_]) -> None:
    """Raise ValueError if hot pixels (height, width) are so many, or so clustered, that something must move."""
    around = convolve(is_hot.astype(np.int64), np.ones((3, 3), np.int64), mode="constant")
    hot = int(is_hot.sum())
    side_by_side = int((around[is_hot] > 1).sum())
    if is_hot.mean() > MOST_HOT_SHARE or (hot > FEW_HOT and side_by_side > MOST_SIDE_BY_SIDE * hot):
        raise ValueError(
            f"expected few, isolated hot pixels, found {hot}, {side_by_side} side by side: the picture moves"
        )


def find_hot(counts: Ints, duration_s: float) -> NDArray[np.bool_]:
    """Return which pixels are hot, from the event count of each."""
    hot = counts > max(FEWEST_EVENTS - 1, HOT_HZ * duration_s)
    for _ in range(2):  # the second round uses the mean of the pixels that are not hot
        usual = counts[~hot].mean() if not hot.all() else 0.0
        limit = stats.poisson.isf(FALSE_ALARMS / len(counts), usual)
        hot = counts > max(FEWEST_EVENTS - 1, HOT_HZ * duration_s, limit)
    return np.asarray(hot, np.bool_)


def _table(
    t_us: Ints, pixel: Ints, p: NDArray, width: int, duration_s: float, dead_us: float, step_us: float
) -> HotPixelRates:
    """Return the table of hot pixels from their events, sorted by pixel and then by time."""
    numbers, first = np.unique(pixel, return_index=True)
    rows = [
        _row(times, signs, duration_s, dead_us, step_us)
        for times, signs in zip(np.split(t_us, first[1:]), np.split(p.astype(np.int64), first[1:]), strict=True)
        if len(times)
    ]
    columns = np.array(rows, np.float64).reshape(-1, 7).T
    return HotPixelRates(numbers % width, numbers // width, *columns)


def _row(
    t_us: Ints, p: Ints, duration_s: float, dead_us: float, step_us: float
) -> tuple[float, float, float, float, float, float, float]:
    """Return rate and interval, share of ON, share of polarity changes, and interval model of one pixel."""
    count = len(t_us)
    between_us = np.diff(t_us).astype(np.float64)
    rate = poisson_rate(count, duration_s)
    # The count of a renewal process varies as its intervals do: more evenly than Poisson, or in bursts.
    spread = between_us.std() / between_us.mean() if count > 2 and between_us.mean() > 0 else 1.0
    spread = max(spread, 0.1) if count > FEWEST_EVENTS * 4 else max(spread, 1.0)
    low, high = (max(0.0, rate.value + (end - rate.value) * spread) for end in rate[1:])
    on = (p.sum() + 0.5) / (count + 1)
    change = (np.count_nonzero(p[1:] != p[:-1]) + 0.5) / count
    change = min(change, 2 * min(on, 1 - on))
    mean_us = 1e6 / rate.value
    short_share, short_us = two_exponentials(between_us, dead_us, step_us)
    room_us = LONGEST_SHARE * mean_us - dead_us
    if short_share > 0.0 and short_share * short_us > room_us:
        short_us = max(0.0, room_us / short_share)
    return rate.value, low, high, float(on), float(change), short_share, short_us


def time_step(interval_us: Floats) -> Estimate | None:
    """Return the step of which all intervals are multiples, in us; 0 if there is no step, None with too few intervals.

    This is the longest step whose phase coherence is about as good as the best.
    """
    near = interval_us[(interval_us > 0) & (interval_us < LONGEST_INTERVAL_US)]
    if len(near) < FEWEST_INTERVALS:
        return None
    near = near[:: max(1, len(near) // MOST_INTERVALS)]
    scan_hz = np.arange(SLOWEST_SCAN * 1e6 / near.mean(), HIGHEST_HZ, STEP_HZ)
    whole_us, count = np.unique(near, return_counts=True)
    turn = np.exp(2j * np.pi * 1e-6 * STEP_HZ * whole_us)
    phase = np.exp(2j * np.pi * 1e-6 * scan_hz[0] * whole_us) * count if len(scan_hz) else np.empty(0)
    coherence = np.empty(len(scan_hz))
    for place in range(len(scan_hz)):
        coherence[place] = abs(phase.sum()) / len(near)
        phase = phase * turn
    coherent = np.flatnonzero(coherence >= max(COHERENT, 0.95 * coherence.max(initial=0.0)))
    if not len(coherent):
        return Estimate(0.0, 0.0, 0.0)
    first = coherent[0]
    best = first + int(np.argmax(coherence[first : first + 20]))
    step_us = 1e6 / scan_hz[best]
    for _ in range(3):
        steps = np.round(near / step_us)
        step_us = float((steps @ near) / (steps @ steps))
    off_us = near - np.round(near / step_us) * step_us
    half_us = 1.96 * float(np.sqrt((steps**2) @ (off_us**2))) / float(steps @ steps)
    return Estimate(step_us, step_us - half_us, step_us + half_us)


def dead_time(interval_us: Floats, step_us: float, rng: np.random.Generator) -> Estimate | None:
    """Return the shortest time between two events of one pixel, in us; None with too few intervals.

    Extrapolated from two small quantiles, so that rare shorter intervals do not count; bootstrap interval.
    """
    if len(interval_us) < FEWEST_INTERVALS:
        return None
    ordered = np.sort(interval_us)
    size = len(ordered)
    first, second = DEAD_SHARES

    def extrapolated(lower: Floats, upper: Floats) -> Floats:
        near, far = (ordered[np.minimum((share * size).astype(np.int64), size - 1)] for share in (lower, upper))
        dead_us: Floats = np.maximum(2.0 * near - far, 0.0)
        return np.round(dead_us / step_us) * step_us if step_us else dead_us

    # Positions of a resample's quantiles among the ordered values are shares of gamma variates.
    parts = rng.gamma(size * np.array([first, second - first, 1 - second]), size=(DEAD_RESAMPLES, 3))
    shares = np.cumsum(parts, axis=1) / parts.sum(axis=1, keepdims=True)
    value = extrapolated(np.array([first]), np.array([second]))[0]
    return of_samples(float(value), extrapolated(shares[:, 0], shares[:, 1]))


def two_exponentials(interval_us: Floats, dead_us: float, step_us: float) -> tuple[float, float]:
    """Return the share of intervals from the shorter of two exponentials, and its mean beyond the dead time, in us.

    Both are 0 if two exponentials do not fit the intervals of a pixel better than one. Maximum likelihood over a
    table of means. Intervals are whole steps of `step_us`; 0 means steps of 1 us.
    """
    unit_us = max(step_us, 1.0)
    steps = np.maximum(np.round((interval_us - dead_us) / unit_us), 0.0)
    if len(steps) < FEWEST_FOR_TWO:
        return 0.0, 0.0
    binned = np.where(
        steps < EXACT_BELOW,
        steps,
        np.round(10 ** (np.round(np.log10(np.maximum(steps, 1.0)) * BINS_A_DECADE) / BINS_A_DECADE)),
    )
    value, count = np.unique(binned, return_counts=True)
    means = MEANS * (200.0 / unit_us if step_us == 0.0 else 1.0)
    likelihood = np.maximum(_share_of_steps(value[None], means[:, None]), 1e-300)
    one = float((np.log(likelihood) @ count).max())
    short, long = np.triu_indices(len(means), 1)
    shorter, longer = likelihood[short], likelihood[long]
    weight = np.full(len(short), 0.5)
    for _ in range(ROUNDS):
        part = weight[:, None] * shorter
        weight = (part / (part + (1 - weight[:, None]) * longer)) @ count / count.sum()
    both = np.log(weight[:, None] * shorter + (1 - weight[:, None]) * longer) @ count
    best = int(np.argmax(both))
    if both[best] - one < WORTH_IT:
        return 0.0, 0.0
    return float(min(weight[best], 0.99)), float(means[short[best]] * unit_us)


def _share_of_steps(steps: Floats, mean: Floats) -> Floats:
    """Return the probability of each number of whole steps, for an exponential that starts anywhere within a step."""
    survival = np.exp(-1.0 / mean)
    some: Floats = np.where(
        steps <= 0, 1 - mean * (1 - survival), mean * (1 - survival) ** 2 * survival ** np.maximum(steps - 1, 0)
    )
    return some
