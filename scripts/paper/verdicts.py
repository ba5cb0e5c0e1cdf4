"""Whether a figure of evetac differs from the paper's, by the 95 % interval of their difference and a margin.

The interval of a difference follows from those of the two figures, as for two independent samples: for shares from
Wilson's intervals (R. G. Newcombe, Interval estimation for the difference between independent proportions, 1998), for
other figures from whatever intervals they have (G. Y. Zou and A. Donner, Construction of confidence limits about effect
measures, 2008), which for means is close to Welch's test. A figure that the paper prints alone is taken as exact.
"""

import math
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels import estimates
from evetac_cli.kernels.estimates import Estimate

AGREES, COMPATIBLE, UNDECIDED, DIFFERENT = "agrees", "compatible", "undecided", "different"
VERDICTS = (AGREES, COMPATIBLE, UNDECIDED, DIFFERENT)
Margin = tuple[float, float]  # smallest and largest difference of figures that may be called equal


def difference(first: Estimate, second: Estimate) -> Estimate:
    """Return the first figure less the second with its interval."""
    value = first.value - second.value
    below = math.hypot(first.value - first.low, second.high - second.value)
    above = math.hypot(first.high - first.value, second.value - second.low)
    return Estimate(value, value - below, value + above)


def paired(first: Mapping[str, float], second: Mapping[str, float]) -> Estimate:
    """Return the mean of the first less the second over units, (figure by unit), from resampling these.

    Both are judged on the same trials, so what makes an object hard for both does not widen the interval.
    """
    off = np.array([first[name] - second[name] for name in first])
    return _ratio(off, np.ones(len(off)), first)


def paired_ratio(first: Mapping[str, float], second: Mapping[str, float]) -> Estimate:
    """Return the ratio of the means of the first and the second over units, from resampling these."""
    above, below = (np.array([one[name] for name in first]) for one in (first, second))
    return _ratio(above, below, first)


def of_units(figures: Mapping[str, float | None], how: str) -> Estimate:
    """Return the "mean", "rms" or "median" of a figure that units have; units without it do not count.

    The interval of a mean is Student's, because resampling few trajectories makes it too narrow. Units named GROUP/UNIT
    are resampled with their group, and so are those of an rms and of a median.
    """
    known = {name: figure for name, figure in figures.items() if figure is not None}
    values = np.array(list(known.values()), np.float64)
    if how == "median":
        samples = [np.median(np.repeat(values, one)) for one in _weights(known).astype(int)]
        return estimates.of_samples(float(np.median(values)), np.array(samples))
    if how == "rms":
        return Estimate(*map(math.sqrt, _ratio(values**2, np.ones(len(values)), known)))
    if any("/" in name for name in known):
        return _ratio(values, np.ones(len(values)), known)
    return estimates.mean(float(values.mean()), float(values.std(ddof=1)), len(values))


def _ratio(above: NDArray[np.float64], below: NDArray[np.float64], units: Iterable[str]) -> Estimate:
    found = estimates.ratio_of_clusters(above, below, _weights(units))
    assert found is not None
    return found


def _weights(units: Iterable[str]) -> NDArray[np.float64]:
    return estimates.cluster_weights([name.partition("/")[0] for name in units])


def of_figures(found: Estimate, margin: Margin) -> str:
    """Return the verdict on two figures, by the interval of their difference.

    They agree if the whole interval is within the margin; otherwise they are different if it does not contain 0. If it
    does, they are compatible if it is no wider than the margin; a wider one would hardly show a difference as large as
    the margin, and decides nothing.
    """
    if margin[0] <= found.low and found.high <= margin[1]:
        return AGREES
    if not found.low <= 0 <= found.high:
        return DIFFERENT
    return COMPATIBLE if found.high - found.low <= margin[1] - margin[0] else UNDECIDED


def of_range(found: Estimate, low: float, high: float) -> str:
    """Return the verdict on a figure where the paper's sentence allows a range."""
    if low <= found.low and found.high <= high:
        return COMPATIBLE
    return DIFFERENT if found.high < low or high < found.low else UNDECIDED


def of_comparison(found: Estimate, sign: int) -> str:
    """Return the verdict on a comparison that the paper draws, from a difference that has the sign if it holds."""
    if found.low <= 0 <= found.high:
        return UNDECIDED
    return COMPATIBLE if found.value * sign > 0 else DIFFERENT
