"""Estimates without a gripper: the camera's noise from the longest rest; dots, optics and thresholds from a press."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.calibration import dot_search, grid, rest_image
from evetac_cli.kernels.calibration.rest_image import RestImage
from evetac_cli.kernels.estimates import Estimate
from evetac_cli.kernels.identify import dots, rest, thresholds
from evetac_cli.kernels.identify.dots import Optics, RimProfile, Runs
from evetac_cli.kernels.identify.rest import RestNoise
from evetac_cli.kernels.identify.thresholds import StrokeEvents
from evetac_cli.sim.setup.sensor import Sensor
from evetac_cli.sim.setup.tables import as_table
from evetac_cli.stages import calibrate, calibrated_gel, gel_at_rest
from evetac_cli.stages.identify.sensor_text import Entry, EstimateRow
from evetac_cli.store.recordings.read import Recording

T = TypeVar("T")
SHORTEST_REST = 500  # slices
LONGEST_REST = 60_000  # slices that are used
MOST_EVENTS = 20_000_000  # events that are used
MAKE_REST = "cannot be estimated from these recordings: make one of 3 s or more in which nothing touches the gel"
MAKE_HOT = "cannot be estimated from these recordings: make a longer one in which nothing touches the gel"


def longest_rest(recording: Recording, rng: np.random.Generator) -> tuple[RestNoise, str] | None:
    """Return the noise in the longest time at rest, and its source; None if there is no rest of SHORTEST_REST."""
    spells = rest_image.quiet_spells(np.diff(recording.starts))
    first, stop = max(spells, key=lambda spell: spell[1] - spell[0], default=(0, 0))
    stop = min(stop, first + LONGEST_REST)
    most = int(np.searchsorted(recording.starts, recording.starts[first] + MOST_EVENTS, side="right")) - 1
    stop = min(stop, most)
    if stop - first < SHORTEST_REST:
        return None
    events = recording.between(first, stop)
    columns = (events.t - SLICE_US * first, events.x, events.y, events.p)
    try:
        noise = rest.analyse(*columns, recording.frame_px, SLICE_US * (stop - first), rng)
    except ValueError:  # too many pixels are busy for a rest
        return None
    return noise, f"{recording.path.name}, {first} to {stop} ms"


def rest_rows(resting: tuple[RestNoise, str] | None) -> tuple[list[EstimateRow], dict[str, Entry]]:
    """Return rows and keys of the camera's noise."""
    units = {
        "noise_hz": "Hz a pixel",
        "noise_on_share": "",
        "hot pixels above 20 Hz": "",
        "events of hot pixels": "Hz",
        "ON share of hot pixels": "",
        "hot_pixel_table.dead_time_us": "us",
        "timestamp_step_us": "us",
    }
    if resting is None:
        return [EstimateRow(name, unit, None, MAKE_REST) for name, unit in units.items()], {}
    noise, source = resting
    estimates = (
        noise.noise_hz,
        noise.noise_on_share if np.isfinite(noise.noise_on_share.value) else None,
        noise.hot_pixels,
        noise.hot_total_hz,
        noise.hot_on_share if np.isfinite(noise.hot_on_share.value) else None,
        noise.dead_time_us,
        noise.timestamp_step_us,
    )
    listed_rows = [
        EstimateRow(name, unit, estimate, MAKE_HOT if estimate is None else source)
        for (name, unit), estimate in zip(units.items(), estimates, strict=True)
    ]
    values = {"noise_hz": Entry(noise.noise_hz.value, noise.noise_hz, source)}
    if np.isfinite(noise.noise_on_share.value):
        values["noise_on_share"] = Entry(noise.noise_on_share.value, noise.noise_on_share, source)
    if noise.timestamp_step_us is not None:
        values["timestamp_step_us"] = Entry(noise.timestamp_step_us.value, noise.timestamp_step_us, source)
    values["hot_pixels"] = Entry(0, None, f"{source}: all hot pixels are in the table")
    listed = noise.table
    if len(listed.x_px):
        half = np.median((listed.high_hz - listed.low_hz) / 2 / listed.rate_hz)
        about = f"{source}: {len(listed.x_px)} above {rest.HOT_HZ:g} Hz; rates within {half:.0%} (median, 95 %)"
        dead_us = 0.0 if noise.dead_time_us is None else noise.dead_time_us.value
        columns = {name: column for name, column in listed._asdict().items() if name not in ("low_hz", "high_hz")}
        values["hot_pixel_table"] = Entry({**columns, "dead_time_us": dead_us}, None, about)
    return listed_rows, values


MAKE_PRESS = "make one in which a blunt tip strokes the whole gel, as for evetac calibrate"
MAKE_WHOLE = "cannot be estimated from these recordings: some dots were not seen; press on the whole gel"
PLACE = "error of a dot's place, 95 %"
MAKE_LONGER = "cannot be estimated from these recordings: make one with more strokes over the whole gel"
NOT_ALONE = "cannot be estimated from events, which depend only on contrast over threshold"
OTHER_GRID = (
    "cannot be estimated from these recordings: the dots are not the grid of --like, whose rows would show a lens"
)
UNEVEN = "cannot be estimated from these recordings: the dots are printed too unevenly for their rows to show a lens"
ONLY_LATE = (
    "cannot be estimated from these recordings: slow pixels show a motion later and smoother, as a slow gel would; make"
    " one of a motion with known times, e.g. of a shaker that reports its phase"
)
MAKE_LONG_REST = "cannot be estimated from these recordings: make one of ten minutes in which nothing touches the gel"
WORST_JITTER_PX = calibrate.WORST_JITTER_PX
MOST_MISSING = calibrated_gel.MOST_MISSING
APART = 0.01  # relative sd of ON against OFF thresholds; a smaller one counts as one threshold for both
WIDEST_LENS = 0.0175  # interval of k1, a quarter of the range of `--sensor randomized`; a wider one is not shown
UNITS = {
    "dots": "",
    PLACE: "px",
    "dot_radius_px": "px",
    "dot_radius_spread": "",
    "dot_contrast_spread": "",
    "edge_sigma_px": "px",
    "distortion": "k1",
    "log_contrast / threshold": "",
    "threshold_off / threshold": "",
    "mismatch": "",
}


@dataclass(frozen=True)
class Press:
    """Dots (rows, columns, 2) in px, NaN for missing ones, the difference between halves of the strokes, optics, lens.

    `is_apart`: whether the thresholds of a pixel for ON and OFF differ.
    """

    dot_xy_px: NDArray[np.float64]
    jitter_px: float
    optics: Optics
    lens_k1: Estimate | None
    off_over_on: Estimate | None
    mismatch: Estimate | None
    is_apart: bool
    profile: RimProfile
    frame_px: tuple[int, int]
    source: str

    @property
    def dots(self) -> int:
        """Number of dots found."""
        return int(np.isfinite(self.dot_xy_px[..., 0]).sum())

    @property
    def informative_lens_k1(self) -> Estimate | None:
        """The lens, if its interval is narrow enough to be informative."""
        k1 = self.lens_k1
        return k1 if k1 is not None and k1.high - k1.low <= WIDEST_LENS else None


def find(
    recording: Recording,
    log_contrast: float,
    printed_xy: NDArray[np.float64] | None,
    noise_hz: float,
    rng: np.random.Generator,
) -> Press:
    """Return the estimates from dots that move from rest in a recording; ValueError, with the reason, if insufficient.

    printed_xy: the grid as printed, (rows, columns, 2), as reference for the lens; None if unknown.
    noise_hz: noise of a pixel.
    """
    halves, events, seconds = _stroked(recording)
    runs = Runs(*(first.joined(second) for first, second in zip(*halves, strict=True)))
    places = dot_search.find(runs.joined)
    seen = grid.lattice(places.centre_xy_px)
    radius_px = float(np.median(places.radius_px))
    jitter_px = gel_at_rest.jitter_px((halves[0].joined, halves[1].joined), seen, radius_px)
    if not np.isfinite(jitter_px):
        raise ValueError("too few strokes to determine where dots come to rest")
    if jitter_px > WORST_JITTER_PX:
        raise ValueError(
            f"dots come to rest at different positions after each stroke, {jitter_px:.2f} px rms apart,"
            f" at most {WORST_JITTER_PX:g} allowed"
        )
    expected = _filled(seen)
    looked_for = np.isfinite(expected[..., 0])
    fitted, profile = dots.fit_rims(runs, expected[looked_for], radius_px, log_contrast)
    places_px = np.full(seen.shape, np.nan)
    places_px[looked_for] = fitted.centre_xy_px
    of_polarity = events.on.sum(axis=0), events.off.sum(axis=0)
    ratio = _if_enough(thresholds.of_either_polarity, *of_polarity, 0.5 * noise_hz * seconds, rng)
    off_over_on = ratio.off_over_on.value if ratio else 1.0
    optics = dots.optics(fitted, events.kept_share, off_over_on, noise_hz, rng)
    whole = optics.contrast_over_threshold.value
    is_apart = ratio is not None and (ratio.mismatch.low > APART or ratio.mismatch.value > 1.5 * APART)
    if ratio and is_apart:
        mismatch: Estimate | None = ratio.mismatch
    else:  # each pixel has one threshold for both polarities
        mismatch = _if_enough(thresholds.of_both_polarities, *events.events, whole, rng)
    lens_k1 = None
    if printed_xy is not None and printed_xy.shape == places_px.shape:
        present = np.isfinite(places_px[..., 0])
        lens_k1 = _if_enough(dots.distortion, places_px[present], printed_xy[present], recording.frame_px)
    return Press(
        dot_xy_px=places_px,
        jitter_px=jitter_px,
        optics=optics,
        lens_k1=lens_k1,
        off_over_on=thresholds.without_last_thresholds(ratio.off_over_on, whole) if ratio else None,
        mismatch=mismatch,
        is_apart=is_apart,
        profile=profile,
        frame_px=recording.frame_px,
        source=recording.path.name,
    )


def _stroked(recording: Recording) -> tuple[tuple[Runs, Runs], StrokeEvents, float]:
    """Return first runs of every other pair of strokes and of the other pairs, all events, and the total duration."""
    nothing = np.zeros(recording.frame_px[::-1], np.uint8)
    halves = [[RestImage(nothing, nothing), RestImage(nothing, nothing)] for _ in range(2)]
    events = thresholds.start(recording.frame_px)
    edges = []
    for half, (start, stop), pictures in gel_at_rest.stroke_images(recording):
        halves[half] = [one.joined(picture) for one, picture in zip(halves[half], pictures, strict=True)]
        edges += [start, stop]
        for block in recording.blocks(gel_at_rest.BLOCK_SLICES, start, stop):
            thresholds.add(events, *block.events, half)
    if not edges:
        raise ValueError("nothing strokes the gel from rest")
    return (Runs(*halves[0]), Runs(*halves[1])), events, (edges[-1] - edges[0]) * 1e-3


def _filled(seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the grid with missing dots at their expected positions: a smooth surface over rows and columns."""
    row, column = (
        axis / max(1, size - 1) - 0.5 for axis, size in zip(np.indices(seen.shape[:2]), seen.shape, strict=False)
    )
    terms = np.stack([row**i * column**j for i in range(4) for j in range(4 - i)], axis=-1)
    present = np.isfinite(seen[..., 0])
    if present.all() or present.sum() < 2 * terms.shape[-1]:
        return seen
    expected = terms @ np.linalg.lstsq(terms[present], seen[present], rcond=None)[0]
    return np.where(present[..., None], seen, expected)


def _if_enough(estimate: Callable[..., T], *inputs: Any) -> T | None:
    """Return the estimate from these inputs; None if they do not suffice."""
    try:
        return estimate(*inputs)
    except ValueError:
        return None


def rows(press: Press | None, like: Sensor, why_none: str = "") -> tuple[list[EstimateRow], dict[str, Entry]]:
    """Return rows and keys of dots, optics, lens and thresholds.

    like: the sensor with the values of all other keys; its log_contrast was used for the rims.
    why_none: if there is no press, a recording without one, and the reason.
    """
    never = [
        EstimateRow("log_contrast", "log units", None, NOT_ALONE),
        EstimateRow("bandwidth_hz", "Hz", None, ONLY_LATE),
        EstimateRow("leak_hz", "Hz a pixel", None, MAKE_LONG_REST),
    ]
    if press is None:
        why = f"cannot be estimated from {why_none or 'these recordings'}; {MAKE_PRESS}"
        return [*(EstimateRow(name, unit, None, why) for name, unit in UNITS.items()), *never], {}
    half_px = 1.96 * press.jitter_px / np.sqrt(2.0)
    whole = press.dot_xy_px[..., 0].size - press.dots <= MOST_MISSING * press.dot_xy_px[..., 0].size
    optics, source = press.optics, press.source
    estimates = (
        (Estimate(float(press.dots), float(press.dots), float(press.dots)), ""),
        (Estimate(half_px, np.nan, np.nan) if whole else None, MAKE_WHOLE),
        (optics.dot_radius_px, ""),
        (optics.dot_radius_spread, ""),
        (optics.dot_contrast_spread, ""),
        (optics.edge_sigma_px, ""),
        (press.informative_lens_k1, OTHER_GRID if press.lens_k1 is None else UNEVEN),
        (optics.contrast_over_threshold, ""),
        (press.off_over_on, MAKE_LONGER),
        (press.mismatch, MAKE_LONGER),
    )
    listed = [
        EstimateRow(name, unit, one, otherwise if one is None else source)
        for (name, unit), (one, otherwise) in zip(UNITS.items(), estimates, strict=True)
    ]
    return [*listed, *never], _entries(press, like, half_px if whole else None)


def _entries(press: Press, like: Sensor, half_px: float | None) -> dict[str, Entry]:
    """Return keys of the sensor's file.

    A spread, a lens or a second threshold that is not significant is set to none if `like` has one.
    """
    optics, source, log_contrast = press.optics, press.source, like.log_contrast
    ratio = optics.contrast_over_threshold
    threshold = Estimate(log_contrast / ratio.value, log_contrast / ratio.high, log_contrast / ratio.low)
    values = {
        "dot_radius_px": Entry(optics.dot_radius_px.value, optics.dot_radius_px, source),
        "edge_sigma_px": Entry(optics.edge_sigma_px.value, optics.edge_sigma_px, source),
        "log_contrast": Entry(log_contrast, None, "not estimated: events depend only on contrast over threshold"),
        "threshold": Entry(threshold.value, threshold, f"{source}, for this log_contrast"),
    }
    none: dict[str, Any] = {"threshold_off": threshold.value, "dot_radius_spread": 0.0, "dot_contrast_spread": 0.0}
    for key in ("dot_radius_spread", "dot_contrast_spread"):
        one: Estimate = getattr(optics, key)
        if one.low > 0.0:
            values[key] = Entry(one.value, one, source)
    off_over_on = press.off_over_on
    if off_over_on is not None and (press.is_apart or not off_over_on.low <= 1.0 <= off_over_on.high):
        off = Estimate(*(threshold.value * one for one in off_over_on))
        values["threshold_off"] = Entry(off.value, off, f"{source}, for this threshold")
    if press.mismatch is not None:
        values["mismatch"] = Entry(press.mismatch.value, press.mismatch, source)
    k1 = press.informative_lens_k1
    if k1 is not None and k1.low <= 0.0 <= k1.high:
        k1 = None
    if k1 is not None:
        values["distortion"] = Entry(np.array([k1.value, 0.0]), k1, f"k1; {source}")
    places = _filled(press.dot_xy_px)
    if half_px is not None and np.isfinite(places).all():
        none["distortion"] = np.zeros(2)  # already as seen: the lens of `like` would move them again
        if k1 is not None:
            places = dots.without_lens(places, k1.value, press.frame_px)
        missing = press.dot_xy_px[..., 0].size - press.dots
        about = f"each within {half_px:.2g} px in x and in y{'' if k1 is None else ' without the lens'}; {source}"
        if missing:
            about += f"; {missing} that were not seen are at positions expected from the others"
        values["dot_xy_px"] = Entry(places, None, about)
    of_like = as_table(like)
    not_shown = {key: one for key, one in none.items() if key in of_like and key not in values}
    return values | {key: Entry(one, None, "not significant in the press") for key, one in not_shown.items()}
