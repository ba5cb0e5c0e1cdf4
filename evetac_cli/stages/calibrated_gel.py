"""The gel that found dots belong to: its rows and columns, which of them are missing, and where its window is.

What is known of it beforehand is an Evetac's size, what the flags say, and what the recording says of its sensor. The
dots are held against that. What they leave open is asked for: a wrong window makes wrong labels without a word.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evetac_cli.commands.calibrate import Calibrate
from evetac_cli.errors import InputError
from evetac_cli.kernels.calibration import gel_layout, grid
from evetac_cli.kernels.calibration.gel_layout import CLOSED_COLUMNS, CUT_COLUMNS, ROWS, Grid, Window
from evetac_cli.sim.setup import sensor_file
from evetac_cli.store.calibration import Calibration

MOST_MISSING = 0.25  # of the dots; with more, a part of the gel was not pressed
MANY_MISSING = f"more than {MOST_MISSING:.0%} of them are missing"
LEAST_ON_GRID = 0.9  # of the dots: with so many in rows and columns they are a grid, also where none was asked for
SIZES = {"closed": (ROWS, CLOSED_COLUMNS), "cut": (ROWS, CUT_COLUMNS)}
REFINE = "--refine takes the others from a default grid"
IRREGULAR = "--irregular takes dots that are in no grid"
PRESS = "press over the whole gel, and lift off between strokes"
BY_HAND = "or write window_px into the JSON by hand, docs/recordings.md"


class FoundDots(NamedTuple):
    """Dots as they were found, and what their source says of the gel."""

    places_px: Grid  # (n, 2) in any order
    radius_px: float
    frame_px: tuple[int, int]
    where: str  # the source, as an error names it
    remedy: str = ""  # how more of the dots would be found
    gel: str | None = None  # cut or closed, where the source says it
    window_px: Window | None = None  # of a cut gel, where the source says it


def check_options(params: Calibrate) -> None:
    """InputError for flags that contradict each other, ask for too much, or have no effect."""
    size = "--rows, --columns"
    if (params.rows is None) != (params.columns is None):
        raise InputError("one needs the other", where=size, expected="both, or neither")
    if params.rows is not None and params.irregular:
        raise InputError("dots in no grid have no rows and columns", where="--irregular", found=size)
    if params.rows is not None and params.columns is not None and params.rows * params.columns > grid.MOST_DOTS:
        raise _too_many(size, params.rows * params.columns)
    given = {"--gel": params.gel is not None, size: params.rows is not None, "--irregular": params.irregular}
    unused = [flag for flag in given if given[flag]]
    of_sensor = params.source is not None and params.source.suffix == sensor_file.SUFFIX
    if of_sensor:
        unused = [flag for flag in unused if flag != "--gel"]
    if unused and (of_sensor or params.refine is not None):
        raise InputError(
            "has no effect: the file with the grid says it",
            where=", ".join(unused),
            found=f"--import {params.source}" if of_sensor else "--refine",
            hint=f"leave out {', '.join(unused)}",
        )


def arranged(seen: FoundDots, params: Calibrate) -> tuple[Grid, Window | None]:
    """The dots of the whole gel, (rows, columns, 2), NaN where one is missing, and its window, None if it is closed.

    InputError if a part of the gel is missing, or if the dots do not say which gel it is.
    """
    gel = params.gel or seen.gel
    if params.irregular:
        if len(seen.places_px) > grid.MOST_DOTS:
            raise _too_many(seen.where, len(seen.places_px))
        dots = grid.one_row(seen.places_px)
        if grid.pitch(dots) == 0.0:
            raise InputError("several dots are at the same place", where=seen.where)
        return dots, _window(dots, gel, seen)
    size_given = None if params.rows is None or params.columns is None else (params.rows, params.columns)
    size = size_given or SIZES.get(gel or "")
    try:
        dots = grid.lattice(seen.places_px, size or (0, 0))
    except ValueError as error:
        raise InputError(
            f"the dots do not form a grid: {error}", where=seen.where, hint=_either(seen.remedy, IRREGULAR)
        ) from None
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
        raise _another_size(dots, size, gel, seen, f"there is room for more dots: {', '.join(free)}")
    return whole, window


def rearranged(calibration: Calibration, params: Calibrate, where: str) -> Calibration:
    """The dots of a grid that was written by hand or by a program, arranged as the flags say; as it is without any."""
    if params.gel is None and params.rows is None and not params.irregular:
        return calibration
    dots = calibration.dot_xy_px.reshape(-1, 2)
    places = dots[np.isfinite(dots[:, 0])]
    gel = None if calibration.window_px is None else "cut"
    seen = FoundDots(places, calibration.dot_radius_px, calibration.frame_px, where, "", gel, calibration.window_px)
    arranged_dots, window = arranged(seen, params)
    return replace(calibration, dot_xy_px=arranged_dots, window_px=window)


def notes(calibration: Calibration) -> list[str]:
    """What a user should know of a grid beside its figures."""
    dots = calibration.dot_xy_px
    said = [gel_layout.mounting(dots, calibration.frame_px, calibration.window_px)]
    if len(dots) == 1:
        said.append(_as_a_grid(dots[0]))
    else:
        missing = np.isnan(dots[..., 0])
        gone = [f"row {index + 1}" for index in np.flatnonzero(missing.all(axis=1))]
        gone += [f"column {index + 1}" for index in np.flatnonzero(missing.all(axis=0))]
        if gone:
            said.append(f"no dot was found in {', '.join(gone)}: worn, or not pressed?")
    return [note for note in said if note]


def _as_a_grid(places_px: Grid) -> str:
    try:
        rows, columns = (dots := grid.lattice(places_px)).shape[:2]
    except ValueError:
        return ""
    if np.isfinite(dots[..., 0]).sum() < LEAST_ON_GRID * len(places_px):
        return ""
    return (
        f"these dots form {rows} rows and {columns} columns: with --rows and --columns, networks of dots can use them"
    )


def _window(dots: Grid, gel: str | None, seen: FoundDots) -> Window | None:
    """Where the window is, None for a closed gel, also where nothing is said and there is no room; InputError."""
    if gel == "closed" or (gel is None and not gel_layout.free_sides(dots, seen.frame_px)):
        return None
    if gel is not None and seen.window_px is not None:
        return seen.window_px
    try:
        side, window = gel_layout.window(dots, seen.radius_px, seen.frame_px)
    except ValueError as error:
        if gel is None:
            hint = f"--gel closed says that there is none; {BY_HAND}"
        else:
            hint = f"--gel closed if there is none, {BY_HAND}"
        raise InputError(f"the place of the window is unclear: {error}", where=seen.where, hint=hint) from None
    if gel is None:
        raise _asked(dots, side, window, seen)
    return window


def _many_missing(dots: Grid) -> bool:
    return bool(np.isnan(dots[..., 0]).mean() > MOST_MISSING)


def _which_gel(dots: Grid, seen: FoundDots) -> InputError:
    """For dots that are not those of a closed Evetac, where nothing says what else they are."""
    rows, columns = dots.shape[:2]
    as_it_is = f"--rows {rows} --columns {columns}"
    if (rows, columns) == SIZES["cut"]:
        try:
            side, window = gel_layout.window(dots, seen.radius_px, seen.frame_px)
        except ValueError:
            pass
        else:
            return _asked(dots, side, window, seen)
    elif (rows, columns) == SIZES["closed"]:
        free = ", ".join(gel_layout.free_sides(dots, seen.frame_px))
        return InputError(
            "there is room for more dots than those of an Evetac",
            where=seen.where,
            expected="dots that fill the frame",
            found=f"{_in_words(dots)}; room: {free}",
            hint=f"{as_it_is} --gel closed says that these are all",
        )
    if (columns, rows) in SIZES.values():
        return _turned(dots, seen)
    try:
        whole = gel_layout.completed(dots, SIZES["closed"], seen.frame_px)
        worn = "" if _many_missing(whole) else "--gel closed if the others are worn"
    except ValueError:
        worn = ""
    return InputError(
        "this is not the whole grid of an Evetac",
        where=seen.where,
        expected=_sizes(),
        found=_in_words(dots),
        hint=_either(seen.remedy, worn, f"{as_it_is} if the gel has no more", REFINE),
    )


def _turned(dots: Grid, seen: FoundDots) -> InputError:
    """For dots with the rows and columns of an Evetac exchanged."""
    rows, columns = dots.shape[:2]
    as_it_is = f"--rows {rows} --columns {columns}"
    if (columns, rows) == SIZES["closed"]:
        hint = f"{as_it_is} --gel closed takes them as they are"
    else:
        hint = f"{as_it_is} --gel cut takes them as they are; --rows {rows + 1} --columns {columns} --gel closed"
        hint += " if a row does not show"
    return InputError(
        "these are the dots of an Evetac that is turned by 90 degrees",
        where=seen.where,
        expected=_sizes(),
        found=_in_words(dots),
        hint=hint,
    )


def _asked(dots: Grid, side: str, window: Window, seen: FoundDots) -> InputError:
    """For dots that leave room on one side."""
    what = "column" if side in ("left", "right") else "row"
    place = " ".join(map(str, window))
    return InputError(
        f"is the gel cut, or does a {what} of dots not show? There is room for either at the {side}",
        where=seen.where,
        expected=f"--gel cut for a window there (window_px {place}), --gel closed for a {what} that is worn or missing",
        found=_in_words(dots),
        hint=_either("--gel cut or --gel closed", seen.remedy and f"if the {what} was not pressed: {seen.remedy}"),
    )


def _another_size(dots: Grid, size: tuple[int, int], gel: str | None, seen: FoundDots, why: str = "") -> InputError:
    """For a grid that is not the one that was said or taken for granted."""
    shape = rows, columns = dots.shape[:2]
    if size in SIZES.values() and shape == size[::-1]:
        return _turned(dots, seen)
    lacks = rows < size[0] or columns < size[1] or _many_missing(dots)
    if shape == size:
        hint = REFINE
    elif gel == "cut" and shape == SIZES["closed"]:
        hint = "--gel closed if there is no window"
    else:
        hint = f"--rows {rows} --columns {columns}{f' --gel {gel}' if gel else ''} if the gel has no other dots"
    return InputError(
        f"these are not the dots of the gel{f': {why}' if why else ''}",
        where=seen.where,
        expected=f"{size[0]} rows and {size[1]} columns" + (f" of a {gel} gel" if gel else ""),
        found=_in_words(dots),
        hint=_either(seen.remedy if lacks else "", hint),
    )


def _too_many(where: str, count: int) -> InputError:
    expected = f"at most {grid.MOST_DOTS}, which the tracker has room for"
    return InputError("too many dots", where=where, expected=expected, found=str(count))


def _sizes() -> str:
    return f"{ROWS} rows and {CLOSED_COLUMNS} columns, or {CUT_COLUMNS} beside the window of a cut gel"


def _in_words(dots: Grid) -> str:
    """How many dots there are, and where."""
    missing = int(np.isnan(dots[..., 0]).sum())
    (x0, y0), (x1, y1) = np.nanmin(dots, axis=(0, 1)), np.nanmax(dots, axis=(0, 1))
    place = f"centres from x = {x0:.0f} to {x1:.0f}, y = {y0:.0f} to {y1:.0f} px"
    if len(dots) == 1:
        return f"{dots.shape[1]} dots, {place}"
    return f"{dots.shape[0]} rows and {dots.shape[1]} columns, {missing} dots missing, {place}"


def _either(*hints: str) -> str:
    return "; ".join(filter(None, hints))
