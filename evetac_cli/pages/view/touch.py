"""Touch file in view: series of the values in every slice, and the maps that belong to the event images.

A map is stored as a byte per cell for pressure and for each component of shear. There are only as many maps as the
images need and a page has room for. Numbers next to a map are the exact ones from the file.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.pages import shared
from evetac_cli.pages.shared import BLUE, GREEN, INK, ORANGE, PINK
from evetac_cli.pages.view.event_images import read_rows
from evetac_cli.pages.view.time_series import Read, decimated, rows_of, slice_times_s
from evetac_cli.pages.view.trial_files import OpenTrial
from evetac_cli.pages.view.view_data import Panel, ViewData
from evetac_cli.store.files import StageFile

MAP_BYTES = 2_000_000  # of maps per page; a third more as base64
CELL_BYTES = 4  # pressure, two of shear, patch
LEVELS, SHEAR_LEVELS = 255, 127  # of pressure, and of shear either way
SLICES = ("centre_mm", "centre_sd_mm", "sticking_share", "slip_direction_rad")  # shown of each slice
SHOWN_SHARE = 0.99  # of touched cells are within the scale, so that a few outliers do not fade all others


def touch_panels(touch: StageFile, span: tuple[int, int]) -> list[Panel]:
    """Return forces, torsion, area and sticking share of the span, each with its standard deviation."""
    start, t_s = span[0], slice_times_s(span[0], min(touch.length("known"), span[1]))

    def size(name: str) -> Read:
        return lambda first, last: np.hypot(*touch.read(name, start + first, start + last).T)[:, None]

    def less_sure(name: str) -> Read:  # larger deviation of the two axes
        return lambda first, last: touch.read(name, start + first, start + last).max(axis=1, keepdims=True)

    def panel(title: str, unit: str, caption: str, *lines: tuple[str, str, Read, Read], **more: Any) -> Panel:
        series = [one for name, colour, value, sd in lines for one in decimated({name: colour}, t_s, value, {name: sd})]
        return Panel(title, unit, series, caption=caption, **more)

    def rows(name: str) -> Read:
        return rows_of(touch, name, start)

    panels = [
        panel(
            "Force on the gel, estimated",
            "N",
            _how_sure(touch),
            ("normal", INK, rows("normal_n"), rows("normal_sd_n")),
            ("shear", ORANGE, size("shear_n"), less_sure("shear_sd_n")),
            ("shear since rest", BLUE, size("shear_since_n"), less_sure("shear_since_sd_n")),
        ),
        panel(
            "Torsion, estimated",
            "N mm",
            "About the centre of pressure, from x to y: clockwise in the image.",
            ("torsion", PINK, rows("torsion_n_mm"), rows("torsion_sd_n_mm")),
        ),
        panel("Area of contact, estimated", "mm²", "", ("area", BLUE, rows("area_mm2"), rows("area_sd_mm2"))),
        panel(
            "Share of the contact that sticks, estimated",
            "",
            "Since the field of the dots last came to rest.",
            ("sticks", GREEN, rows("sticking_share"), rows("sticking_share_sd")),
            ends=(0.0, 1.05),
        ),
    ]
    return [one for one in panels if one.lines]


def _how_sure(touch: StageFile) -> str:
    """Return the meaning of the band of estimated forces, and how well the gel's stiffness, their scale, is known."""
    texts = {
        shared.ADAPTED: "The scale was adapted to this sensor with known forces.",
        shared.KNOWN: "The stiffness of this gel is taken as known.",
        shared.NOT_KNOWN: "The stiffness of this gel is not known, and a typical value is assumed: a curve may be"
        " wrong by one constant factor. Use predict-touch --sensor if the stiffness is known.",
    }
    return f"Band: plus and minus one standard deviation. {texts[shared.stiffness(touch.header)]}"


def place_touch(view: ViewData, trial: OpenTrial) -> None:
    """Add the map for each event image, the last before its end, and the values of the slice at its end.

    Pressure (maps, rows, columns) is 0 to 255 for 0 to most_kpa; shear (maps, 2, rows, columns) is 0 to 254 for
    -most_shear_kpa to +most_shear_kpa, with 127 for 0. Values beyond are clipped. highest_kpa (maps, 4): the largest
    pressure and its deviation, the largest shear and its deviation. shown: the map of each event image; -1: none yet.
    """
    touch = trial.touch
    if touch is None or not touch.has("map/slice") or not len(view.frame_times):
        return
    ends = view.ends
    x_mm, y_mm = touch.read("map/x_mm"), touch.read("map/y_mm")
    at = np.searchsorted(touch.read("map/slice"), ends, side="right") - 1  # -1 before the first
    wanted = np.unique(at[at >= 0])
    if not len(wanted):
        return
    if min(len(x_mm), len(y_mm)) < 2:
        view.notes.append("Touch maps are not drawn: with only one row or column of cells, their size is unknown.")
        return
    most = max(1, MAP_BYTES // (CELL_BYTES * len(x_mm) * len(y_mm)))
    step = -(-len(wanted) // most)
    kept = wanted[::step]
    if step > 1:
        view.notes.append(f"Touch maps: one in {step} is kept, to keep the page small.")
    maps = [_one(touch, row) for row in kept.tolist()]
    pressure, shear, patch = (np.stack([one[name] for one in maps]) for name in ("pressure", "shear", "patch"))
    most_pa = _end_of_scale(pressure, patch)
    most_shear_pa = _end_of_scale(np.hypot(shear[:, 0], shear[:, 1]), patch)
    view.touch = {
        "x": x_mm.tolist(),
        "y": y_mm.tolist(),
        "most_kpa": most_pa * 1e-3,
        "most_shear_kpa": most_shear_pa * 1e-3,
        "pressure": _levels(pressure / most_pa, 0, LEVELS).astype(np.uint8),
        "shear": (_levels(shear / most_shear_pa, -SHEAR_LEVELS, SHEAR_LEVELS) + SHEAR_LEVELS).astype(np.uint8),
        "patch": patch.astype(np.uint8),
        "highest_kpa": np.array([one["highest"] for one in maps], np.float32) * 1e-3,
        "shown": np.where(at < 0, -1, np.searchsorted(kept, at, side="right") - 1).tolist(),
        **{name: read_rows(touch, name, ends, np.nan) for name in SLICES},
    }


def _one(touch: StageFile, row: int) -> dict[str, Any]:
    """Return a map of a file; `highest`: largest pressure and largest shear with their deviations, in Pa."""
    names = ("patch", "pressure_pa", "pressure_sd_pa", "shear_pa", "shear_sd_pa")
    patch, pressure, pressure_sd, shear, shear_sd = (touch.read(f"map/{name}", row, row + 1)[0] for name in names)
    size, size_sd = np.hypot(*shear), shear_sd.max(axis=0)
    highest: list[float] = []
    for value, sd in ((pressure, pressure_sd), (size, size_sd)):
        at = int(np.argmax(np.where(np.isfinite(value), value, -np.inf)))
        highest += [float(value.flat[at]), float(sd.flat[at])]
    return {"pressure": pressure, "shear": shear, "patch": patch, "highest": highest}


def _end_of_scale(values_pa: NDArray[Any], patch: NDArray[Any]) -> float:
    """Return the end of a scale of colours or arrows for values of touched cells; above 0."""
    touched = values_pa[(patch == 1) & (values_pa > 0)]  # excludes NaN
    return float(np.quantile(touched, SHOWN_SHARE)) if len(touched) else 1.0


def _levels(share: NDArray[Any], low: int, high: int) -> NDArray[np.float64]:
    """Return whole numbers from low to high for shares of high; unknown values become 0."""
    levels: NDArray[np.float64] = np.rint(np.clip(np.nan_to_num(share) * high, low, high))
    return levels
