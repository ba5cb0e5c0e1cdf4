"""Optics of printed dots from images of the gel at rest (calibration/rest_image.py): the rim of each, and the lens.

The model of a rim is that of the simulated camera (sim/camera/optics.py): log brightness ln(ink + (1 - ink) Phi((r -
radius) / sigma)) at distance r from the centre of a dot. If a pixel is moved onto the gel and onto a dot, its share of
darkening events shows its position between ink and gel at rest. Events only depend on the ratio of contrast to
threshold, so the contrast itself must be known: it shapes the rim slightly.

Reasons:
- First runs before a stroke overcount slightly on a rim, because the largest of many strokes counts. Runs after a
  stroke, taken backwards in time, undercount slightly, because they end where the threshold was last crossed. The mean
  of both is right.
- The thresholds of ON and OFF may differ, and each run has events of one polarity. Before a stroke, the inside of a dot
  makes ON events and the gel makes OFF events; after it, the opposite. Each is measured in the events of its own
  plateau.
- Dots are fitted one by one, because the mean rim of unequal dots would be more blurred than each of them.

A lens bends the straight rows of dots. Its model is that of the simulated camera (sim/camera/gel_camera.py) without its
second term. A point at distance r from the middle of the frame is seen at r (1 + k1 r^2), with r = 1 at the corners.
Print and picture may be shifted, rotated and scaled against each other.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import least_squares
from scipy.special import ndtr

from evetac_cli.arrays import Floats
from evetac_cli.kernels.calibration.rest_image import RestImage
from evetac_cli.kernels.estimates import LEVEL, Estimate, of_samples

WHOLE_RUN = 0.7  # a pixel counts if its brightness changed by at least this share of its dot's contrast
RIM_PX = 7.0  # pixels farther from the radius than this are not fitted
PLATEAU_PX = (4.5, 10.0)  # distances from the rim between which pixels see only ink, or only gel
FARTHEST_PX = 5.0  # farthest fitted centre from where the dot was expected
FEWEST_PIXELS = 100  # of one dot, for a fit
MOST_LACKING = 0.5  # a rim pixel counts if its run after the stroke has more than this share of the contrast
INK_SHARE = 0.3  # a dot is fitted if some pixel has a share of darkening below this and another above 1 minus this
WORST_RESIDUAL = 0.12  # rms of a fit, as a share of the contrast; worse fits are dropped
BIN_PX = 0.25  # bin width of the rim profile

RESAMPLES = 400  # of the bootstrap
FEWEST_DOTS = 8  # for statistics over dots

# Corrections of the fitted radius and blur. Their causes: camera scans, unequal events per threshold, and the largest
# of several strokes. Fitted to simulated press scenes (sensors randomized:100 to 125 and, with few events, to 348).
# Each "sd" is the scatter of single sensors about the correction.

# Fitted radius minus true radius: a constant, plus a coefficient over the squared number of events from dot to gel.
RADIUS_ADDED_PX, RADIUS_BY_EVENTS_PX, RADIUS_SD_PX = 0.04, 3.2, 0.08
# ln(true blur / fitted blur): a constant, plus coefficients of the excess, 1 / n, 1 / n^2 and the noise of a pixel in
# Hz. The excess is that of runs before strokes over runs after them. Here n is the smaller number of events, from dot
# to gel or back. Noise matters because it ends runs too early.
BLUR, BLUR_BY_EXCESS, BLUR_BY_EVENTS, BLUR_BY_SQUARED_EVENTS, BLUR_BY_NOISE = -0.032, -0.65, 3.84, -12.5, -0.76
BLUR_SD, BLUR_SD_FEW_EVENTS = 0.03, 0.5  # the second is divided by n^2
# Events that a first run lacks compared with contrast over threshold: a constant, plus a multiple of the events merged
# by scans. Only ON events are used: if OFF has as few as three, most gel pixels do not show the whole contrast.
RUN_LACKS, RUN_LACKS_MERGED = 0.6, 0.7
EVENTS_SD = 0.03  # relative sd of contrast over threshold
# Scatter of the fits for dots of equal size, and of equal contrast: relative sd, and the sd of that sd.
RADIUS_CHANCE, RADIUS_CHANCE_SD = 0.0025, 0.001
CONTRAST_CHANCE, CONTRAST_CHANCE_SD = 0.012, 0.006

FEWEST_FOR_LENS = 12  # dots
LENS_ROUNDS = 3  # iterations: the lens acts on undistorted distances, which k1 itself determines


class Runs(NamedTuple):
    """First runs of events from the rest before each stroke, and backwards in time from the rest after it."""

    before: RestImage
    after: RestImage

    @property
    def joined(self) -> RestImage:
        """Return the larger count of both, per pixel."""
        return self.before.joined(self.after)


class DotOptics(NamedTuple):
    """Fitted optics per dot, (dots, 2) and (dots,); NaN for a dot that could not be fitted.

    Positions, radii and blur are in px. `inside_on`: mean ON events of the first runs from ink to gel, over the pixels
    inside a dot. `excess`: how much more rim pixels change before strokes than after them, in units of the contrast.
    """

    centre_xy_px: Floats
    radius_px: Floats
    sigma_px: Floats
    inside_on: Floats
    excess: Floats


class RimProfile(NamedTuple):
    """Mean share of darkening events over the distance from the edge, (bins,), over all dots; NaN for empty bins."""

    distance_px: Floats
    share: Floats


def darkening_share(distance_px: Floats, radius_px: float, sigma_px: float, log_contrast: float) -> Floats:
    """Return the position of the log brightness between dot (0) and gel (1) at a distance from a dot's centre."""
    ink = np.exp(-log_contrast)
    share: Floats = 1.0 + np.log(ink + (1.0 - ink) * ndtr((distance_px - radius_px) / sigma_px)) / log_contrast
    return share


def fit_rims(runs: Runs, centre_xy_px: Floats, radius_px: float, log_contrast: float) -> tuple[DotOptics, RimProfile]:
    """Fit every dot near its expected centre (dots, 2) and radius; NaN for a dot that is not visible."""
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
    return DotOptics(fitted[:, :2], fitted[:, 2], fitted[:, 3], count[:, 0], fitted[:, 4]), profile


def _excess(before: Floats, after: Floats, dot: Floats) -> float:
    """Return how much more pixels within 1 px of a rim change before strokes than after them, in contrasts."""
    box, distance = _box(dot[:2], dot[2] + 2.0, before.shape[1], before.shape[0])
    rim = np.abs(distance - dot[2]) < 1.0
    rim &= (before[box] > WHOLE_RUN) & (after[box] > MOST_LACKING)
    return float((before[box] - after[box])[rim].mean()) if rim.any() else float("nan")


def _plateaus(runs: Runs, centre_xy_px: Floats, radius_px: float) -> Floats:
    """Return the mean events and the number of pixels, (dots, 4, 2), of the inside and the gel around each dot.

    Order: inside before strokes (ON) and after (OFF), gel before (OFF) and after (ON). Only pixels that were moved
    across the whole contrast count.
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
    """Return the part of the frame around a position, and the distance of its pixels from that position."""
    left, top = (max(0, int(value - reach)) for value in place)
    right, bottom = (
        max(begin, min(size, int(value + reach) + 2))
        for begin, value, size in zip((left, top), place, (width, height), strict=True)
    )
    y, x = np.mgrid[top:bottom, left:right]
    return (slice(top, bottom), slice(left, right)), np.hypot(x - place[0], y - place[1])


def _around(whole: NDArray[np.int64], share: Floats, place: Floats, radius_px: float) -> tuple[Floats, Floats]:
    """Return positions (pixels, 2) and darkening shares of pixels near a dot's rim that saw the whole contrast."""
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
    """Return the best fit (least squares) of centre x, y, radius and blur, and its rms residual."""

    def off(guess: Floats) -> Floats:
        distance = np.hypot(pixels_xy[:, 0] - guess[0], pixels_xy[:, 1] - guess[1])
        result: Floats = darkening_share(distance, guess[2], guess[3], log_contrast) - share
        return result

    low = [place[0] - FARTHEST_PX, place[1] - FARTHEST_PX, max(1.0, radius_px - RIM_PX), 0.2]
    high = [place[0] + FARTHEST_PX, place[1] + FARTHEST_PX, radius_px + RIM_PX, RIM_PX]
    result = least_squares(off, [*place, max(radius_px, 1.5), 1.3], bounds=(low, high))
    return result.x, float(np.sqrt(np.mean(result.fun**2)))


class Optics(NamedTuple):
    """Radius and blur of the dots in px, contrast over the threshold of ON, and relative sd of radii and contrasts."""

    dot_radius_px: Estimate
    edge_sigma_px: Estimate
    contrast_over_threshold: Estimate
    dot_radius_spread: Estimate
    dot_contrast_spread: Estimate


def optics(dots: DotOptics, kept_share: float, off_over_on: float, noise_hz: float, rng: np.random.Generator) -> Optics:
    """Return the optics over all dots; ValueError with fewer than FEWEST_DOTS.

    `kept_share`: share of the events that camera scans leave (thresholds.py). `off_over_on`: ratio of the thresholds,
    1 if unknown. `noise_hz`: noise events of a pixel per second. Intervals: bootstrap over dots, plus the scatter of
    the corrections over simulated sensors.
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
    resampled_dots = rng.integers(0, shown.sum(), (RESAMPLES, shown.sum()))
    means = np.nanmean(columns[:, resampled_dots], axis=2).T
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
    """Return true blur over fitted blur, from the excess of a rim, its events, and the noise of a pixel."""
    sensor = BLUR_BY_EVENTS / events + BLUR_BY_SQUARED_EVENTS / events**2 + BLUR_BY_NOISE * noise_hz
    return float(np.exp(BLUR + BLUR_BY_EXCESS * excess + sensor))


def spread(values: Floats, chance: float, chance_sd: float) -> Estimate:
    """Return the relative standard deviation of the measured quantity, with the measurement's own scatter removed.

    The interval assumes normal values. ValueError with fewer than FEWEST_DOTS values.
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


def distortion(seen_xy_px: Floats, printed_xy: Floats, frame_px: tuple[int, int]) -> Estimate:
    """Return k1 from dots (dots, 2) as seen and as printed, in any unit; ValueError with too few dots.

    Least squares; the interval is Student's, from the irregularity of the dot positions.
    """
    dots = len(seen_xy_px)
    if dots < FEWEST_FOR_LENS:
        raise ValueError(f"expected {FEWEST_FOR_LENS} dots or more, found {dots}")
    middle = np.array(frame_px, np.float64) / 2
    corner2 = float(middle @ middle)
    x, y = printed_xy.T
    one, nothing = np.ones(dots), np.zeros(dots)
    similar = np.concatenate([np.column_stack([x, -y, one, nothing]), np.column_stack([y, x, nothing, one])])
    project = similar @ np.linalg.pinv(similar)
    k1, flat = 0.0, seen_xy_px - middle
    for _ in range(LENS_ROUNDS):
        outward = (flat**2).sum(axis=1, keepdims=True) / corner2 * flat
        stacked = (part.T.ravel() for part in (seen_xy_px - middle, outward))
        seen_off, outward_off = (part - project @ part for part in stacked)
        k1 = float((outward_off * seen_off).sum() / (outward_off**2).sum())
        flat = (seen_xy_px - middle) / (1.0 + k1 * (flat**2).sum(axis=1, keepdims=True) / corner2)
    left = seen_off - k1 * outward_off
    degrees = 2 * dots - 5
    sd = np.sqrt((left**2).sum() / degrees / (outward_off**2).sum())
    half = float(stats.t.ppf((1 + LEVEL) / 2, degrees) * sd)
    return Estimate(k1, k1 - half, k1 + half)


def without_lens(seen_xy_px: Floats, k1: float, frame_px: tuple[int, int]) -> Floats:
    """Return where points (..., 2) would be seen without the lens."""
    middle = np.array(frame_px, np.float64) / 2
    off_px = np.asarray(seen_xy_px, np.float64) - middle
    corner2 = float(middle @ middle)
    nearer = off_px
    for _ in range(50):  # a contraction, because k1 is small: each round multiplies the error by about 3 k1
        nearer = off_px / (1.0 + k1 * (nearer**2).sum(axis=-1, keepdims=True) / corner2)
    result: Floats = nearer + middle
    return result
