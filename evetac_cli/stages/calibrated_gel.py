"""The gel to which detected dots belong: its rows and columns, its missing dots, and its window.

The dots are compared with prior information: an Evetac's size, the flags, and the sensor in the recording. If this
leaves the gel undetermined, the user has to decide, because a wrong window would silently make wrong labels.
"""

from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evetac_cli.commands.calibrate import FOUND, OF_SENSOR, Calibrate
from evetac_cli.commands.parameter import refuse_unused
from evetac_cli.errors import InputError
from evetac_cli.kernels.calibration import gel_layout, grid
from evetac_cli.kernels.calibration.gel_layout import CLOSED_COLUMNS, CUT_COLUMNS, ROWS, Grid, Window
from evetac_cli.sim.setup import sensor_file
from evetac_cli.store.calibration import Calibration

MOST_MISSING = 0.25  # share of the dots; with more missing, a part of the gel was not pressed
MANY_MISSING = f"more than {MOST_MISSING:.0%} of them are missing"
SIZES = {"closed": (ROWS, CLOSED_COLUMNS), "cut": (ROWS, CUT_COLUMNS)}
CLOSED = "--gel closed if there is no window, or if dots are worn"
REFINE = "--refine takes the missing dots from a default grid"
IRREGULAR = "--irregular accepts dots that form no grid"
PRESS = "press on the whole gel, and lift off between strokes"
NO_WINDOW = "--gel closed if there is no window, or write window_px into the JSON by hand, see docs/recordings.md"


class FoundDots(NamedTuple):
    """Detected dots, with information on the gel from their source."""

    places_px: Grid  # (n, 2) in any order
    radius_px: float
    frame_px: tuple[int, int]
    where: str  # the source, for error messages
    remedy: str = ""  # how to find more of the dots
    gel: str | None = None  # cut or closed, if the source states it
    window_px: Window | None = None  # of a cut gel, if the source states it


def check_options(params: Calibrate) -> None:
    """Raise InputError for flags that contradict each other or have no effect."""
    size = "--rows, --columns"
    if (params.rows is None) != (params.columns is None):
        raise InputError("must be used together", where=size, expected="both, or neither")
    if params.rows is not None and params.irregular:
        raise InputError("dots without a grid have no rows and columns", where="--irregular", found=size)
    of_sensor = params.source is not None and params.source.suffix == sensor_file.SUFFIX
    has = [OF_SENSOR] if of_sensor else [FOUND] if params.refine is None else []
    refuse_unused(params, has, f"--import {params.source}" if of_sensor else "--refine")


def arranged(seen: FoundDots, params: Calibrate) -> tuple[Grid, Window | None]:
    """Return the dots of the whole gel, (rows, columns, 2), NaN for missing ones, and its window, None if closed.

    InputError if a part of the gel is missing, or if the gel cannot be identified from the dots.
    """
    gel = params.gel or seen.gel
    if params.irregular:
        dots = grid.one_row(seen.places_px)
        if grid.pitch(dots) == 0.0:
            raise InputError("several dots are at the same position", where=seen.where)
        return dots, _window(dots, gel, seen)
    size_given = None if params.rows is None or params.columns is None else (params.rows, params.columns)
    size = size_given or SIZES.get(gel or "")
    try:
        dots = grid.lattice(seen.places_px, size or (0, 0))
    except ValueError as error:
        hint = f"{seen.remedy}; {IRREGULAR}" if seen.remedy else IRREGULAR
        raise InputError(f"the dots do not form a grid: {error}", where=seen.where, hint=hint) from None
    if size is None:
        if dots.shape[:2] != SIZES["closed"] or gel_layout.free_sides(dots, seen.frame_px):
            raise _which_gel(dots, seen)
        if _many_missing(dots):
            raise _another_size(dots, SIZES["closed"], "closed", seen, MANY_MISSING)
        return dots, None
    if gel == "cut" and dots.shape[:2] != size:
        raise _another_size(dots, size, gel, seen)
    try:
        whole = gel_layout.completed(dots, size, seen.frame_px)
    except ValueError as error:
        raise _another_size(dots, size, gel, seen, str(error)) from None
    if _many_missing(whole):
        raise _another_size(dots, size, gel, seen, MANY_MISSING)
    window = _window(whole, gel, seen)
    free = gel_layout.free_sides(whole, seen.frame_px)
    if size_given is None and len(free) > (window is not None):
        raise _another_size(dots, size, gel, seen, f"there is space for more dots: {', '.join(free)}")
    return whole, window


def rearranged(calibration: Calibration, params: Calibrate, where: str) -> Calibration:
    """Return a calibration from a file with its dots arranged by the flags; unchanged without flags."""
    if params.gel is None and params.rows is None and not params.irregular:
        return calibration
    dots = calibration.dot_xy_px
    places = dots[np.isfinite(dots[..., 0])]
    gel = None if calibration.window_px is None else "cut"
    seen = FoundDots(places, calibration.dot_radius_px, calibration.frame_px, where, "", gel, calibration.window_px)
    if dots.shape[:2] == (params.rows, params.columns):
        return replace(calibration, window_px=_window(dots, params.gel or gel, seen))
    arranged_dots, window = arranged(seen, params)
    return replace(calibration, dot_xy_px=arranged_dots, window_px=window)


def notes(calibration: Calibration, left_out: int) -> list[str]:
    """Return notes on a grid for the user, in addition to its figures. left_out: positions that are not in it."""
    dots = calibration.dot_xy_px
    lines = [f"positions left out, because they are not on the grid: {left_out}"] if left_out else []
    lines += [gel_layout.mounting(dots, calibration.frame_px, calibration.window_px)]
    if len(dots) > 1:
        missing = np.isnan(dots[..., 0])
        gone = [f"row {index + 1}" for index in np.flatnonzero(missing.all(axis=1))]
        gone += [f"column {index + 1}" for index in np.flatnonzero(missing.all(axis=0))]
        if gone:
            lines.append(f"no dot was found in {', '.join(gone)}: worn, or not pressed?")
    return [note for note in lines if note]


def _window(dots: Grid, gel: str | None, seen: FoundDots) -> Window | None:
    """Return the window; None for a closed gel, or if none is known and there is no space for one.

    InputError if its position is unclear, or if only the user can decide whether there is one.
    """
    if gel == "closed" or (gel is None and not gel_layout.free_sides(dots, seen.frame_px)):
        return None
    if gel is not None and seen.window_px is not None:
        return seen.window_px
    try:
        side, window = gel_layout.window(dots, seen.radius_px, seen.frame_px)
    except ValueError as error:
        raise InputError(f"the position of the window is unclear: {error}", where=seen.where, hint=NO_WINDOW) from None
    if gel is None:
        raise _space_on_one_side(dots, side, window, seen)
    return window


def _many_missing(dots: Grid) -> bool:
    return bool(np.isnan(dots[..., 0]).mean() > MOST_MISSING)


def _which_gel(dots: Grid, seen: FoundDots) -> InputError:
    """Return the error for dots that are not those of a closed Evetac, if nothing states which gel it is."""
    if dots.shape[:2] == SIZES["cut"]:
        with suppress(ValueError):
            return _space_on_one_side(dots, *gel_layout.window(dots, seen.radius_px, seen.frame_px), seen)
    expected = f"{ROWS} rows and {CLOSED_COLUMNS} columns, or {CUT_COLUMNS} next to the window of a cut gel"
    why = "these dots are not the whole grid of an Evetac"
    if dots.shape[:2] == SIZES["closed"]:
        why = f"there is space for more dots: {', '.join(gel_layout.free_sides(dots, seen.frame_px))}"
    return _another_gel(dots, seen, why, expected)


def _space_on_one_side(dots: Grid, side: str, window: Window, seen: FoundDots) -> InputError:
    """Return the error for dots that leave space on one side."""
    what = "column" if side in ("left", "right") else "row"
    why = f"is the gel cut, or is a {what} of dots not visible? There is space for either at the {side}"
    place = " ".join(map(str, window))
    expected = f"--gel cut for a window there (window_px {place}), --gel closed for a missing {what}"
    return InputError(why, where=seen.where, expected=expected, found=_in_words(dots), hint=seen.remedy)


def _another_size(dots: Grid, size: tuple[int, int], gel: str | None, seen: FoundDots, why: str = "") -> InputError:
    """Return the error for a grid that differs from the stated or assumed one."""
    expected = f"{size[0]} rows and {size[1]} columns" + (f" of a {gel} gel" if gel else "")
    return _another_gel(dots, seen, f"these are not the dots of the gel{f': {why}' if why else ''}", expected, gel)


def _another_gel(dots: Grid, seen: FoundDots, why: str, expected: str, gel: str | None = None) -> InputError:
    """Return the error for dots that are not those expected, with all that may help."""
    rows, columns = dots.shape[:2]
    as_it_is = f"--rows {rows} --columns {columns}{f' --gel {gel}' if gel else ''} if the gel has no more dots"
    hint = "; ".join(filter(None, (seen.remedy, as_it_is, CLOSED, REFINE)))
    return InputError(why, where=seen.where, expected=expected, found=_in_words(dots), hint=hint)


def _in_words(dots: Grid) -> str:
    """Return a description of the number and positions of the dots."""
    missing = int(np.isnan(dots[..., 0]).sum())
    (x0, y0), (x1, y1) = np.nanmin(dots, axis=(0, 1)), np.nanmax(dots, axis=(0, 1))
    place = f"centres from x = {x0:.0f} to {x1:.0f}, y = {y0:.0f} to {y1:.0f} px"
    if len(dots) == 1:
        return f"{dots.shape[1]} dots, {place}"
    return f"{dots.shape[0]} rows and {dots.shape[1]} columns, {missing} dots missing, {place}"
