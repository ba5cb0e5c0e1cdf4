"""The rims of printed dots from images of the gel at rest (calibration/rest_image.py): radii, blur, contrast of each.

The model is that of the simulated camera (sim/camera/optics.py): log brightness ln(ink + (1 - ink) Phi((r - radius) /
sigma)) over the distance r from a dot's centre. A pixel that was moved onto the gel and onto a dot shows by its share
of darkening events how far it is from one to the other at rest. Only the ratio of contrast and threshold makes events,
so the contrast itself must be known: it shapes the rim a little.

Why so:
- Runs before a stroke count a little too much on a rim, as the largest of many strokes counts; runs after one, played
  backwards, a little too little, as they end where the threshold was last passed. The mean of both is right.
- Thresholds of ON and OFF may differ, and each run has events of one polarity: before a stroke a dot's inside shows by
  ON and the gel by OFF, after it the other way round. Each is measured in the events of its own plateau.
- Dots are fitted one by one. The mean of the rims of unequal dots would be more blurred than each of them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr

from evetac_cli.kernels.calibration.rest_image import RestImage

Floats = NDArray[np.float64]

WHOLE_RUN = 0.7  # a pixel counts if its brightness changed by so much of its dot's contrast
RIM_PX = 7.0  # from the radius to the farthest pixel of the fit
PLATEAU_PX = (4.5, 10.0)  # from the rim: pixels that see only ink, or only gel
FARTHEST_PX = 5.0  # from where a dot was looked for
FEWEST_PIXELS = 100
MOST_LACKING = 0.5  # of the contrast, by a run after a stroke
INK_SHARE = 0.3  # some pixel of a dot has less darkening, some of the gel more than the rest
WORST_RESIDUAL = 0.12  # rms, share of the contrast
BIN_PX = 0.25


class Runs(NamedTuple):
    """First runs of events from the rest before each stroke, and backwards from the rest after it."""

    before: RestImage
    after: RestImage

    @property
    def joined(self) -> RestImage:
        """The larger count of both."""
        return self.before.joined(self.after)


class Dots(NamedTuple):
    """What each dot shows, (dots, 2) and (dots,), NaN where it does not show.

    Places, radii and blur are in px; `inside_on` are events of the first runs from ink to gel, mean over the pixels of
    a dot's inside. `excess` is by how much of their contrast pixels of the rim change more before strokes than after
    them.
    """

    centre_xy_px: Floats
    radius_px: Floats
    sigma_px: Floats
    inside_on: Floats
    excess: Floats


class RimProfile(NamedTuple):
    """Share of darkening events over the distance from the edge (bins,), mean of all dots; NaN without pixels."""

    distance_px: Floats
    share: Floats


def darkening_share(distance_px: Floats, radius_px: float, sigma_px: float, log_contrast: float) -> Floats:
    """How far from dot (0) to gel (1) log brightness is at a distance from a dot's centre."""
    ink = np.exp(-log_contrast)
    share: Floats = 1.0 + np.log(ink + (1.0 - ink) * ndtr((distance_px - radius_px) / sigma_px)) / log_contrast
    return share


def fit(runs: Runs, centre_xy_px: Floats, radius_px: float, log_contrast: float) -> tuple[Dots, RimProfile]:
    """Fit every dot near its place (dots, 2), with a radius that is nearly right; ValueError where nothing moved."""
    if not any(side.any() for picture in runs for side in picture):
        raise ValueError("expected pictures in which dots have moved, found none")
    events = _plateaus(runs, centre_xy_px, radius_px)
    count, pixels = events[..., 0], events[..., 1]
    usual = np.nansum(count * pixels, axis=0) / np.maximum(pixels.sum(axis=0), 1.0)
    unit = np.where(usual > 0, usual, np.inf)
    sides = (runs.before.brighter, runs.after.brighter, runs.before.darker, runs.after.darker)
    up_before, up_after, down_before, down_after = (side / one for side, one in zip(sides, unit, strict=True))
    brighter, darker = up_before + up_after, down_before + down_after
    before, after = up_before + down_before, up_after + down_after
    whole = np.minimum(*(picture.brighter.astype(np.int64) + picture.darker for picture in runs))
    share = darker / np.maximum(brighter + darker, 1e-9)
    bins = int(2 * RIM_PX / BIN_PX)
    sums = np.zeros((2, bins))
    fitted = np.full((len(centre_xy_px), 5), np.nan)
    for number, place in enumerate(centre_xy_px):
        pixels_xy, seen = _around(whole, share, place, radius_px)
        if len(seen) < FEWEST_PIXELS or seen.min() > INK_SHARE or seen.max() < 1.0 - INK_SHARE:
            continue
        best, residual = _fit_one(pixels_xy, seen, place, radius_px, log_contrast)
        if residual > WORST_RESIDUAL:
            continue
        fitted[number, :4] = best
        fitted[number, 4] = _excess(before, after, best)
        off_px = np.linalg.norm(pixels_xy - best[:2], axis=1) - best[2]
        near = np.abs(off_px) < RIM_PX
        place_in_bins = ((off_px[near] + RIM_PX) / BIN_PX).astype(np.int64)
        sums += [np.bincount(place_in_bins, seen[near], bins), np.bincount(place_in_bins, minlength=bins)]
    with np.errstate(invalid="ignore", divide="ignore"):
        from_edge_px = np.linspace(0.5, bins - 0.5, bins) * BIN_PX - RIM_PX
        profile = RimProfile(from_edge_px, sums[0] / sums[1])
    lost = np.isnan(fitted[:, 0])
    count[lost] = np.nan
    return Dots(fitted[:, :2], fitted[:, 2], fitted[:, 3], count[:, 0], fitted[:, 4]), profile


def _excess(before: Floats, after: Floats, dot: Floats) -> float:
    """By how much pixels within 1 px of a rim change more before strokes than after them, in contrasts."""
    box, distance = _box(dot[:2], dot[2] + 2.0, before.shape[1], before.shape[0])
    rim = np.abs(distance - dot[2]) < 1.0
    rim &= (before[box] > WHOLE_RUN) & (after[box] > MOST_LACKING)
    return float((before[box] - after[box])[rim].mean()) if rim.any() else float("nan")


def _plateaus(runs: Runs, centre_xy_px: Floats, radius_px: float) -> Floats:
    """Events and pixels (dots, 4, 2) of inside and gel of each dot.

    Inside before strokes (ON) and after (OFF), gel before (OFF) and after (ON); of pixels that were moved wholly.
    """
    height, width = runs.before.brighter.shape
    reach = radius_px + PLATEAU_PX[1]
    result = np.full((len(centre_xy_px), 4, 2), np.nan)
    result[..., 1] = 0.0
    sides = (runs.before.brighter, runs.after.brighter, runs.before.darker, runs.after.darker)
    for number, place in enumerate(centre_xy_px):
        box, distance = _box(place, reach, width, height)
        inside = distance < radius_px - PLATEAU_PX[0]
        outside = (distance > radius_px + PLATEAU_PX[0]) & (distance < reach)
        for which, (side, area) in enumerate(zip(sides, (inside, inside, outside, outside), strict=True)):
            events = side[box][area]
            if len(events) and (most := np.percentile(events, 90)) > 0:
                moved = events[events >= WHOLE_RUN * most]
                result[number, which] = moved.mean(), len(moved)
    return result


def _box(place: Floats, reach: float, width: int, height: int) -> tuple[tuple[slice, slice], Floats]:
    """The part of the frame around a place, and the distance of its pixels from there."""
    left, top = (max(0, int(value - reach)) for value in place)
    right, bottom = (
        max(begin, min(size, int(value + reach) + 2))
        for begin, value, size in zip((left, top), place, (width, height), strict=True)
    )
    y, x = np.mgrid[top:bottom, left:right]
    return (slice(top, bottom), slice(left, right)), np.hypot(x - place[0], y - place[1])


def _around(whole: NDArray[np.int64], share: Floats, place: Floats, radius_px: float) -> tuple[Floats, Floats]:
    """Places (pixels, 2) of the pixels near a dot's rim that were moved wholly, and their shares of darkening."""
    box, distance = _box(place, radius_px + RIM_PX, whole.shape[1], whole.shape[0])
    if not distance.size:
        return np.empty((0, 2)), np.empty(0)
    events = whole[box]
    near = distance < radius_px + RIM_PX
    moved = near & (events >= max(1.0, WHOLE_RUN * np.percentile(events[near], 90))) if near.any() else near
    moved &= distance > radius_px - RIM_PX
    y, x = np.nonzero(moved)
    return np.stack([x + box[1].start, y + box[0].start], axis=1).astype(np.float64), share[box][moved]


def _fit_one(
    pixels_xy: Floats, share: Floats, place: Floats, radius_px: float, log_contrast: float
) -> tuple[Floats, float]:
    """Centre x, y, radius and blur that fit best (least squares), and the rms of what is left."""

    def off(guess: Floats) -> Floats:
        distance = np.hypot(pixels_xy[:, 0] - guess[0], pixels_xy[:, 1] - guess[1])
        result: Floats = darkening_share(distance, guess[2], guess[3], log_contrast) - share
        return result

    low = [place[0] - FARTHEST_PX, place[1] - FARTHEST_PX, max(1.0, radius_px - RIM_PX), 0.2]
    high = [place[0] + FARTHEST_PX, place[1] + FARTHEST_PX, radius_px + RIM_PX, RIM_PX]
    result = least_squares(off, [*place, max(radius_px, 1.5), 1.3], bounds=(low, high))
    return result.x, float(np.sqrt(np.mean(result.fun**2)))
