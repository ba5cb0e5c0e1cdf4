"""Find dots in an image of the gel at rest (rest_image.py), without knowing their positions or size.

First a vote: for every pixel and radius, the brightness just inside a circle is compared with that just outside. The
radius whose best positions have the most votes is that of the dots. Then a fit: each centre and its radius are adjusted
until a round edge with a smooth step fits the pixels of the rim (Gauss-Newton, with weights that reduce the influence
of outliers).

The radius is where log brightness is half way from dot to gel. Blur acts on brightness, not on its logarithm. So a dot
five times darker than the gel looks smaller than it is printed, by half the blur: 0.6 px in the simulation.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.kernels.calibration.rest_image import RestImage

SMALLEST_RADIUS_PX = 4  # that is tried
LARGEST_SHARE = 0.1  # largest radius that is tried, as a share of the shorter side of the frame
LEAST_CONTRAST = 3.0  # events; fewer are noise
LEAST_PIXELS = 100  # with this contrast; with fewer, nothing has moved
VOTE = 0.8  # smallest vote, inside minus outside: 2 for a dot that was moved in all directions, 1 for half a dot
WHOLE_RUN = 0.7  # a pixel is fitted if its brightness changed by at least this share of the contrast
RIM_PX = 8.0  # pixels farther from the edge than this are not fitted
SECTORS, SECTORS_SEEN = 8, 6  # sectors around the rim, and the number that must show it
SECTOR_SHARE = 0.3  # of a sector's rim pixels that the edge must have passed
WORST_RESIDUAL = 0.2  # rms of a fit, as a share of the contrast; also the scale of the weights
ITERATIONS = 20  # of Gauss-Newton


class DotCentres(NamedTuple):
    """Centres (n, 2) in px and radii (n,) in px; NaN if the rim is not visible."""

    centre_xy_px: Floats
    radius_px: Floats


def contrast(picture: RestImage) -> float:
    """Return the number of events from dot to gel; 0 if too few pixels saw motion."""
    span = picture.brighter.astype(np.int64) + picture.darker
    moved = span[span >= LEAST_CONTRAST]
    return float(np.percentile(moved, 90)) if len(moved) >= LEAST_PIXELS else 0.0


def find(picture: RestImage) -> DotCentres:
    """Find all dots of one size, in no particular order; none if nothing moved."""
    events = contrast(picture)
    nothing = DotCentres(np.empty((0, 2)), np.empty(0))
    if events == 0.0:
        return nothing
    signed = np.clip((picture.brighter.astype(np.float32) - picture.darker) / events, -1.0, 1.0).astype(np.float32)
    largest = int(LARGEST_SHARE * min(signed.shape))
    best, places, radius = 0.0, np.empty((0, 2)), 0
    for tried in range(SMALLEST_RADIUS_PX, largest + 1):
        score, at = _vote(signed, tried)
        if score > best:
            best, places, radius = score, at, tried
    if len(places) == 0:
        return nothing
    return _distinct(fit(picture, places, float(radius)))


def fit(picture: RestImage, centre_xy_px: Floats, radius_px: float) -> DotCentres:
    """Fit dots near expected positions, (n, 2), and a common radius; NaN for a dot that is not visible.

    A dot is rejected if its centre is more than 0.6 radii from the expected position. It is also rejected if its radius
    differs by more than a fifth from the others', or if more than a quarter of its rim is hidden. Something must have
    moved in the picture.
    """
    events = contrast(picture)
    assert events > 0.0
    fitted = np.array([_fit_one(picture, events, place, radius_px) for place in centre_xy_px]).reshape(-1, 3)
    usual = np.median(fitted[np.isfinite(fitted[:, 2]), 2]) if np.isfinite(fitted[:, 2]).any() else np.nan
    fitted[~(np.abs(fitted[:, 2] - usual) <= 0.2 * usual)] = np.nan
    return DotCentres(fitted[:, :2], fitted[:, 2])


def _vote(signed: NDArray[np.float32], radius: int) -> tuple[float, Floats]:
    """Return the sum of the votes for a radius, and their positions (n, 2)."""
    width = max(2, radius // 3)
    reach = radius + width
    dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    distance = np.hypot(dx, dy)
    inside = (distance <= radius) & (distance > radius - width)
    outside = (distance > radius) & (distance <= reach)
    kernel = (inside / inside.sum() - outside / outside.sum()).astype(np.float32)
    votes = cv2.filter2D(signed, cv2.CV_32F, kernel, borderType=cv2.BORDER_CONSTANT)
    around = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    peaks = (votes >= cv2.dilate(votes, around)) & (votes >= VOTE)
    y, x = np.nonzero(peaks)
    return float(votes[peaks].sum()), np.stack([x, y], axis=1).astype(np.float64)


def _fit_one(picture: RestImage, events: float, place: Floats, radius: float) -> tuple[float, float, float]:
    """Return centre x, y and radius of one dot, or NaN; model: share of darkening = 1 / (1 + exp((r - rho) / s))."""
    refused = (np.nan, np.nan, np.nan)
    height, width = picture.brighter.shape
    reach = 1.6 * radius + RIM_PX
    left, top = (max(0, int(value - reach)) for value in place)
    right, bottom = (min(size, int(value + reach) + 2) for value, size in zip(place, (width, height), strict=True))
    if right - left < 3 or bottom - top < 3:
        return refused
    brighter, darker = (side[top:bottom, left:right].astype(np.float64).ravel() for side in picture)
    y, x = (axis.ravel().astype(np.float64) for axis in np.mgrid[top:bottom, left:right])
    whole = brighter + darker >= WHOLE_RUN * events
    if whole.sum() < LEAST_PIXELS // 4:
        return refused
    x, y, share = x[whole], y[whole], (darker / np.maximum(brighter + darker, 1))[whole]
    estimate = np.array([*place, radius, 1.5])
    rim_px = min(RIM_PX, 0.6 * radius)
    for _ in range(ITERATIONS):
        dx, dy = x - estimate[0], y - estimate[1]
        rho = np.maximum(np.hypot(dx, dy), 1e-9)
        near = np.abs(rho - estimate[2]) < rim_px
        z = (rho[near] - estimate[2]) / estimate[3]
        model = 1.0 / (1.0 + np.exp(-z))
        slope = model * (1.0 - model) / estimate[3]
        residual = share[near] - model
        weight = 1.0 / (1.0 + (residual / WORST_RESIDUAL) ** 2)
        jacobian = np.stack([-slope * dx[near] / rho[near], -slope * dy[near] / rho[near], -slope, -slope * z], axis=1)
        weighted = jacobian * weight[:, None]
        change = np.linalg.solve(weighted.T @ jacobian + 1e-6 * np.eye(4), weighted.T @ residual)
        estimate += np.clip(change, -2.0, 2.0)
        estimate[2] = np.clip(estimate[2], 0.5 * radius, 1.6 * radius)
        estimate[3] = np.clip(estimate[3], 0.3, 0.5 * rim_px)
        if np.hypot(*(estimate[:2] - place)) > 0.6 * radius:
            return refused
    if not near.any() or np.sqrt(np.average(residual**2, weights=weight)) > WORST_RESIDUAL:
        return refused
    edge = np.abs(rho - estimate[2]) < 2.0
    sector = ((np.arctan2(dy, dx)[edge] / (2 * np.pi) % 1.0) * SECTORS).astype(int) % SECTORS
    passed = np.bincount(sector, minlength=SECTORS) / (4.0 * 2 * np.pi * estimate[2] / SECTORS)
    if (passed >= SECTOR_SHARE).sum() < SECTORS_SEEN:
        return refused
    return float(estimate[0]), float(estimate[1]), float(estimate[2])


def _distinct(dots: DotCentres) -> DotCentres:
    """Return each dot once: positions within a radius of an earlier one are the same dot."""
    distinct: list[int] = []
    for index, centre in enumerate(dots.centre_xy_px):
        if np.isfinite(centre).all() and all(
            np.hypot(*(centre - dots.centre_xy_px[other])) > dots.radius_px[other] for other in distinct
        ):
            distinct.append(index)
    return DotCentres(dots.centre_xy_px[distinct], dots.radius_px[distinct])
