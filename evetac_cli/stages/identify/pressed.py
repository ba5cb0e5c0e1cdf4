"""What a press tells of a sensor: the places of its dots at rest, their radius and blur, contrast over threshold."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.kernels.calibration import dot_search, grid
from evetac_cli.kernels.identify import mismatch, rim
from evetac_cli.kernels.identify.estimates import Estimate
from evetac_cli.kernels.identify.rim import Rim, RimProfile
from evetac_cli.stages import calibrate
from evetac_cli.stages.identify.sensor_text import Entry, Row
from evetac_cli.store.read import Recording

MAKE_PRESS = (
    "cannot be told from these recordings: make one in which a blunt tip strokes the whole gel, as for evetac calibrate"
)
MAKE_WHOLE = "cannot be told from these recordings: some dots were not seen; press over the whole gel"
PLACE = "error of a dot's place, 95 %"
MAKE_LONGER = "cannot be told from these recordings: make one with more strokes over the whole gel"
NOT_ALONE = "cannot be told from events: only contrast over threshold makes them"
WORST_JITTER_PX = calibrate.WORST_JITTER_PX


@dataclass(frozen=True)
class Press:
    """Dots (rows, columns, 2) in px, NaN where one is missing, how far halves of the strokes disagree, rims."""

    dot_xy_px: NDArray[np.float64]
    jitter_px: float
    rim: Rim
    mismatch: Estimate | None
    profile: RimProfile
    source: str

    @property
    def dots(self) -> int:
        """How many dots were found."""
        return int(np.isfinite(self.dot_xy_px[..., 0]).sum())


def find(recording: Recording, log_contrast: float, rng: np.random.Generator) -> Press | None:
    """The dots that a recording shows moved from rest; None where it shows no grid of them."""
    try:
        halves = calibrate.rest_images(recording)
        picture = halves[0].joined(halves[1])
        places = dot_search.find(picture)
        dots = grid.lattice(places.centre_xy_px)
        radius_px = float(np.median(places.radius_px))
        jitter_px = calibrate.jitter_px(halves, dots, radius_px)
        if not jitter_px <= WORST_JITTER_PX:
            return None
        on_grid = dots[np.isfinite(dots[..., 0])]
        rims = rim.estimate(picture, on_grid, radius_px, log_contrast, rng)
        profile = rim.profile(picture, on_grid, radius_px)
    except (InputError, ValueError):  # nothing was pressed, or too little
        return None
    spread = _mismatch(recording, rims.contrast_over_threshold.value, rng)
    return Press(dots, jitter_px, rims, spread, profile, recording.path.name)


def _mismatch(recording: Recording, contrast_over_threshold: float, rng: np.random.Generator) -> Estimate | None:
    """The spread of the thresholds, from every other pair of strokes and the other pairs; None with too few."""
    width, height = recording.frame_px
    halves = np.zeros((2, height * width), np.int64)
    for stroke, (start, stop) in enumerate(calibrate.strokes(recording)):
        for first in range(start, stop, calibrate.BLOCK_SLICES):
            events = recording.between(first, min(stop, first + calibrate.BLOCK_SLICES))
            pixel = events.y.astype(np.int64) * width + events.x
            halves[stroke // 2 % 2] += np.bincount(pixel, minlength=height * width)
    first_half, second_half = halves.reshape(2, height, width)
    try:
        return mismatch.estimate(first_half, second_half, contrast_over_threshold, rng)
    except ValueError:
        return None


def rows(press: Press | None, log_contrast: float) -> tuple[list[Row], dict[str, Entry]]:
    """Rows and keys of dots and optics; `log_contrast` is what the rims were read with."""
    units = {"dots": "", PLACE: "px", "dot_radius_px": "px", "edge_sigma_px": "px"}
    units |= {"log_contrast / threshold": "", "mismatch": ""}
    alone = Row("log_contrast", "log units", None, NOT_ALONE)
    if press is None:
        return [*(Row(name, unit, None, MAKE_PRESS) for name, unit in units.items()), alone], {}
    half_px = 1.96 * press.jitter_px / np.sqrt(2.0)
    count = Estimate(float(press.dots), float(press.dots), float(press.dots))
    source = press.source
    ratio = press.rim.contrast_over_threshold
    threshold = Estimate(log_contrast / ratio.value, log_contrast / ratio.high, log_contrast / ratio.low)
    estimates = (count, Estimate(half_px, np.nan, np.nan), press.rim.radius_px, press.rim.edge_sigma_px, ratio)
    listed = [
        Row(name, unit, one, MAKE_LONGER if one is None else source)
        for (name, unit), one in zip(units.items(), (*estimates, press.mismatch), strict=True)
    ]
    values = {
        "dot_radius_px": Entry(press.rim.radius_px.value, press.rim.radius_px, source),
        "edge_sigma_px": Entry(press.rim.edge_sigma_px.value, press.rim.edge_sigma_px, source),
        "log_contrast": Entry(log_contrast, None, "not estimated: only contrast over threshold makes events"),
        "threshold": Entry(threshold.value, threshold, f"{source}, for this log_contrast"),
    }
    if press.mismatch is not None:
        values["mismatch"] = Entry(press.mismatch.value, press.mismatch, source)
    if np.isfinite(press.dot_xy_px).all():
        values["dot_xy_px"] = Entry(press.dot_xy_px, None, f"each within {half_px:.2g} px in x and in y; {source}")
    else:
        listed[1] = Row(PLACE, "px", None, MAKE_WHOLE)
    return [*listed, alone], values
