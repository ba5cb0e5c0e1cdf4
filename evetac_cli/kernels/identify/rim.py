"""The rim of printed dots from an image of the gel at rest (calibration/rest_image.py): radius, blur, events.

The model is that of the simulated camera (sim/camera/optics.py): log brightness ln(ink + (1 - ink) Phi((r - radius) /
sigma)) over the distance r from a dot's centre. A pixel that was moved onto the gel and onto a dot shows by its share
of darkening events how far it is from one to the other at rest. Only the ratio of contrast and threshold makes events,
so the contrast itself must be known: it shapes the rim a little.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr

from evetac_cli.kernels.calibration import dot_search
from evetac_cli.kernels.calibration.rest_image import RestImage
from evetac_cli.kernels.identify.estimates import Estimate, of_samples

Floats = NDArray[np.float64]

WHOLE_RUN = 0.7  # a pixel counts if its brightness changed by so much of the contrast
RIM_PX = 7.0  # from the radius to the farthest pixel of the fit
PLATEAU_PX = (4.5, 10.0)  # from the rim: pixels that see only ink, or only gel
BIN_PX = 0.25
RESAMPLES = 200
FEWEST_DOTS = 8

# What scans, thresholds of some events each and the largest of several strokes add, chosen on simulated press scenes
# (sensors evetac, second, randomized:3 to 5; seeds 1 to 5), and how far single ones were from that (sd). Strokes of 15
# to 60 mm/s change little; at 120 mm/s scans merge events, and 5 % more are missing than is corrected for.
BLUR_KEPT = 0.899  # of the blur that is seen
RADIUS_ADDED_PX = 0.06
EVENTS_KEPT = 0.872  # of contrast over threshold
RADIUS_SD_PX, SIGMA_SD_PX, EVENTS_SD = 0.015, 0.025, 0.03


class RimProfile(NamedTuple):
    """Share of darkening events over the distance from the centre, in bins of BIN_PX, dot by dot.

    `distance_px` (bins,), sums of the share and counts of pixels (dots, bins); events of plateau pixels and how many
    there are (dots,).
    """

    distance_px: Floats
    share_sum: Floats
    pixels: Floats
    plateau_events: Floats
    plateau_pixels: Floats

    @property
    def share(self) -> Floats:
        """Mean share of all dots, NaN in a bin without pixels."""
        with np.errstate(invalid="ignore", divide="ignore"):
            mean: Floats = self.share_sum.sum(axis=0) / self.pixels.sum(axis=0)
        return mean


class Rim(NamedTuple):
    """Radius and blur of the dots in px, and contrast over threshold, with intervals."""

    radius_px: Estimate
    edge_sigma_px: Estimate
    contrast_over_threshold: Estimate


def profile(picture: RestImage, centre_xy_px: Floats, radius_px: float) -> RimProfile:
    """The rims of dots at known places, (dots, 2); ValueError where nothing moved."""
    events = dot_search.contrast(picture)
    if events == 0.0:
        raise ValueError("expected a picture in which dots have moved, found none")
    brighter, darker = (side.astype(np.float64) for side in picture)
    height, width = brighter.shape
    reach = radius_px + PLATEAU_PX[1]
    bins = int(np.ceil(reach / BIN_PX))
    share_sum, pixels = np.zeros((len(centre_xy_px), bins)), np.zeros((len(centre_xy_px), bins))
    plateau_events, plateau_pixels = np.zeros(len(centre_xy_px)), np.zeros(len(centre_xy_px))
    for number, (x, y) in enumerate(centre_xy_px):
        left, right = max(0, int(x - reach)), min(width, int(x + reach) + 2)
        top, bottom = max(0, int(y - reach)), min(height, int(y + reach) + 2)
        grid_y, grid_x = np.mgrid[top:bottom, left:right]
        distance = np.hypot(grid_x - x, grid_y - y)
        up, down = brighter[top:bottom, left:right], darker[top:bottom, left:right]
        moved = (up + down >= WHOLE_RUN * events) & (distance < reach)
        place = (distance[moved] / BIN_PX).astype(np.int64)
        share_sum[number] = np.bincount(place, down[moved] / (up + down)[moved], bins)
        pixels[number] = np.bincount(place, minlength=bins)
        off_px = np.abs(distance - radius_px)
        plateau = moved & (off_px > PLATEAU_PX[0]) & (off_px < PLATEAU_PX[1])
        plateau_events[number], plateau_pixels[number] = (up + down)[plateau].sum(), plateau.sum()
    middle_px = np.linspace(0.5, bins - 0.5, bins) * BIN_PX
    return RimProfile(middle_px, share_sum, pixels, plateau_events, plateau_pixels)


def darkening_share(distance_px: Floats, radius_px: float, sigma_px: float, log_contrast: float) -> Floats:
    """How far from dot (0) to gel (1) log brightness is at a distance from a dot's centre."""
    ink = np.exp(-log_contrast)
    share: Floats = 1.0 + np.log(ink + (1.0 - ink) * ndtr((distance_px - radius_px) / sigma_px)) / log_contrast
    return share


def fit(rims: RimProfile, radius_px: float, log_contrast: float) -> tuple[float, float]:
    """Radius and blur that fit the mean profile best, by least squares from a radius that is nearly right."""
    seen = (rims.pixels.sum(axis=0) > 0) & (np.abs(rims.distance_px - radius_px) < RIM_PX)
    weight = np.sqrt(rims.pixels.sum(axis=0)[seen])
    distance_px, share = rims.distance_px[seen], rims.share[seen]

    def off(guess: Floats) -> Floats:
        result: Floats = weight * (darkening_share(distance_px, guess[0], guess[1], log_contrast) - share)
        return result

    bounds = ([radius_px - RIM_PX, 0.2], [radius_px + RIM_PX, RIM_PX])
    found_radius, found_sigma = least_squares(off, [radius_px, 1.3], bounds=bounds).x
    return float(found_radius), float(found_sigma)


def estimate(
    picture: RestImage, centre_xy_px: Floats, radius_px: float, log_contrast: float, rng: np.random.Generator
) -> Rim:
    """Radius, blur and contrast over threshold, corrected for what a camera adds; ValueError with too few dots.

    Intervals: bootstrap over dots, and the scatter of the corrections over simulated sensors.
    """
    if len(centre_xy_px) < FEWEST_DOTS:
        raise ValueError(f"expected {FEWEST_DOTS} dots or more, found {len(centre_xy_px)}")
    rims = profile(picture, centre_xy_px, radius_px)

    def corrected(of: RimProfile) -> tuple[float, float, float]:
        radius, sigma = fit(of, radius_px, log_contrast)
        kept = of.plateau_events.sum() / max(of.plateau_pixels.sum(), 1.0)
        return radius - RADIUS_ADDED_PX, BLUR_KEPT * sigma, kept / EVENTS_KEPT

    values = corrected(rims)
    samples = np.empty((RESAMPLES, 3))
    for resample in range(RESAMPLES):
        chosen = rng.integers(0, len(centre_xy_px), len(centre_xy_px))
        samples[resample] = corrected(RimProfile(rims.distance_px, *(part[chosen] for part in rims[1:])))
    scatter = rng.standard_normal((RESAMPLES, 3)) * [RADIUS_SD_PX, SIGMA_SD_PX, EVENTS_SD * values[2]]
    return Rim(*(of_samples(value, column) for value, column in zip(values, (samples + scatter).T, strict=True)))
