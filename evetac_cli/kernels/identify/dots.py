"""Radius, blur, contrast over threshold, and how far dots differ, from fitted rims (rim.py), each with an interval."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from evetac_cli.kernels.identify.estimates import LEVEL, Estimate, of_samples
from evetac_cli.kernels.identify.rim import Dots

Floats = NDArray[np.float64]

RESAMPLES = 400
FEWEST_DOTS = 8

# What scans, thresholds of some events each and the largest of several strokes add, chosen on simulated press scenes
# (sensors randomized:100 to 125 and, with few events, to 348), and how far single sensors were from that (sd).
RADIUS_ADDED_PX, RADIUS_BY_EVENTS_PX, RADIUS_SD_PX = 0.04, 3.2, 0.08  # the second over squared events from dot to gel
# Logarithm of the blur over that which is seen: a constant, and what is added for each unit of by how much runs before
# strokes count more than runs after them, of the inverse of the events from dot to gel or back, whichever are fewer, of
# its square, and for each Hz of a pixel's noise, which ends runs too early. How far single sensors were from that (sd);
# more over squared events.
BLUR, BLUR_BY_EXCESS, BLUR_BY_EVENTS, BLUR_BY_SQUARED_EVENTS, BLUR_BY_NOISE = -0.032, -0.65, 3.84, -12.5, -0.76
BLUR_SD, BLUR_SD_FEW_EVENTS = 0.03, 0.5
# Events that a first run lacks of contrast over threshold: so many, and so many times those that scans merge. Those of
# ON alone count: where OFF has but three, most of the gel's pixels show none of the whole contrast.
RUN_LACKS, RUN_LACKS_MERGED = 0.6, 0.7
EVENTS_SD = 0.03
# How far single dots of equal size, and of equal contrast, were from each other: relative sd, and its own sd.
RADIUS_CHANCE, RADIUS_CHANCE_SD = 0.0025, 0.001
CONTRAST_CHANCE, CONTRAST_CHANCE_SD = 0.012, 0.006


class Optics(NamedTuple):
    """Radius and blur of the dots in px, contrast over the threshold of ON, and relative sd of radii and contrasts."""

    dot_radius_px: Estimate
    edge_sigma_px: Estimate
    contrast_over_threshold: Estimate
    dot_radius_spread: Estimate
    dot_contrast_spread: Estimate


def optics(dots: Dots, kept_share: float, off_over_on: float, noise_hz: float, rng: np.random.Generator) -> Optics:
    """What the rims tell of all dots; ValueError with fewer than FEWEST_DOTS.

    `kept_share` of the events are left by scans (stroke_events.py), `off_over_on` is the ratio of the thresholds, 1
    where it is not known, `noise_hz` the noise of a pixel.
    Intervals: bootstrap over dots, and the scatter of the corrections over simulated sensors.
    """
    shown = np.isfinite(dots.radius_px)
    if shown.sum() < FEWEST_DOTS:
        raise ValueError(f"expected {FEWEST_DOTS} dots or more, found {shown.sum()}")
    radius_px, sigma_px = dots.radius_px[shown], dots.sigma_px[shown]
    inside_on = dots.inside_on[shown]
    ratio = inside_on + RUN_LACKS + RUN_LACKS_MERGED * inside_on * (1.0 / kept_share - 1.0)
    usual = float(np.nanmean(ratio))
    fewest = usual / max(1.0, off_over_on)
    added_px = RADIUS_ADDED_PX + RADIUS_BY_EVENTS_PX / usual**2
    of_seen = blur_over_seen(float(np.nanmean(dots.excess[shown])), fewest, noise_hz)
    columns = np.stack([radius_px - added_px, of_seen * sigma_px, ratio])
    value = np.nanmean(columns, axis=1)
    chosen = rng.integers(0, shown.sum(), (RESAMPLES, shown.sum()))
    means = np.nanmean(columns[:, chosen], axis=2).T
    blur_sd = np.hypot(BLUR_SD, BLUR_SD_FEW_EVENTS / fewest**2)
    scatter = np.array([RADIUS_SD_PX, blur_sd * value[1], EVENTS_SD * value[2]])
    samples = means + scatter * rng.standard_normal((RESAMPLES, 3))
    radius, blur, ratio_of_all = (of_samples(float(one), column) for one, column in zip(value, samples.T, strict=True))
    return Optics(
        radius,
        blur,
        ratio_of_all,
        spread(radius_px, RADIUS_CHANCE, RADIUS_CHANCE_SD),
        spread(ratio[np.isfinite(ratio)], CONTRAST_CHANCE, CONTRAST_CHANCE_SD),
    )


def blur_over_seen(excess: float, events: float, noise_hz: float) -> float:
    """The blur over that which rims show, by their excess (rim.py), the events of a rim, and a pixel's noise."""
    sensor = BLUR_BY_EVENTS / events + BLUR_BY_SQUARED_EVENTS / events**2 + BLUR_BY_NOISE * noise_hz
    return float(np.exp(BLUR + BLUR_BY_EXCESS * excess + sensor))


def spread(values: Floats, chance: float, chance_sd: float) -> Estimate:
    """Relative standard deviation of what values measure, without that of chance, and its interval for normal values.

    ValueError with fewer than FEWEST_DOTS values.
    """
    if len(values) < FEWEST_DOTS:
        raise ValueError(f"expected {FEWEST_DOTS} values or more, found {len(values)}")
    degrees = len(values) - 1
    variance = float((values / values.mean()).var(ddof=1))
    tail = (1 - LEVEL) / 2
    low, high = (variance * degrees / stats.chi2.ppf(share, degrees) for share in (1 - tail, tail))
    z = float(stats.norm.ppf(1 - tail))
    most, least = (chance + z * chance_sd) ** 2, max(chance - z * chance_sd, 0.0) ** 2
    ends = (variance - chance**2, low - most, high - least)
    return Estimate(*(float(np.sqrt(max(one, 0.0))) for one in ends))
