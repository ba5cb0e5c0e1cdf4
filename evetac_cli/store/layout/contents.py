"""Validity of a file's contents: the limits of its schema, and rules across datasets.

All checks are here. `StageFile.read` returns nothing that `check_values` refuses, so a stage never gets a value that
its schema forbids. Faults of names and shapes alone are refused when a file is opened (`check_shapes`). A small dataset
is read as a whole before any of it is returned, together with those that have to fit it by a rule (`check_first`). Not
all datasets are read, because most callers need only a few. `validate` reads all, block by block, in bounded memory
(`faults`), and so does the writer of a new file before it takes its place.
"""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, SchemaError
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.rules import RULES, Contents, Fault, Rule, Shapes, blocks
from evetac_cli.store.layout.schema import Dataset, Limits
from evetac_cli.text_files import SEED_BITS, parse_json

SMALL_VALUES = 4096  # datasets with at most this many values are checked as a whole: 4 s of a trial, in a few ms
SHORT = 60  # longest value in a message, in characters


def check_values(file: Contents, path: str, values: Any, first: int = 0) -> None:
    """Raise SchemaError if values of a dataset, starting at row `first`, violate its schema."""
    row = schema.load(file.kind).find(path)
    if row is None or row.limits == schema.ANYTHING:
        return
    if isinstance(values, str):
        fault = _text_fault(row.limits, values)
    else:
        fault = _array_fault(file, row, np.asarray(values), first) if np.size(values) else None
    if fault:
        _refuse(file.path, (path, *fault))


def check_shapes(file: Contents, shapes: Shapes) -> None:
    """Raise SchemaError if the set of datasets, or their shapes, are invalid."""
    table = schema.load(file.kind)
    for name in shapes:
        row = table.find(name)
        for other in (row.limits.index_of, row.limits.nan_where) if row is not None else ():
            if other and other not in shapes:
                _refuse(file.path, (name, f"together with {other}", f"no {other} in the file"))
    _check_rules(file, "", shapes, set())


def check_first(file: Contents, name: str, shapes: Shapes, passed: set[Rule]) -> None:
    """Raise SchemaError if a small dataset is invalid, or if a dataset violates the rules for it.

    It must be called before the dataset is first read. passed: the rules that were applied, which is extended.
    """
    row = schema.load(file.kind).find(name)
    if row is None:
        return
    shape = shapes[name][1]
    if row.limits != schema.ANYTHING and math.prod(shape) <= SMALL_VALUES:
        file.read(name)
    if row.edges:
        begin, end = int(file.read(name, 0, 1)[0]), int(file.read(name, shape[0] - 1, shape[0])[0])
        rows = file.length(row.limits.index_of)
        if (begin, end) != (0, rows):
            expected = f"begins at 0 and ends at {rows}, the length of {row.limits.index_of}"
            _refuse(file.path, (name, expected, f"{begin} and {end}"))
    _check_rules(file, name, shapes, passed)


def _check_rules(file: Contents, name: str, shapes: Shapes, passed: set[Rule]) -> None:
    for rule, concerns in RULES.get(file.kind, ()):
        if rule in passed or not re.fullmatch(concerns, name):
            continue
        passed.add(rule)  # before it runs, because it reads the datasets that it concerns
        try:
            for fault in rule(file, shapes):
                _refuse(file.path, fault)
        except BaseException:
            passed.discard(rule)
            raise


def faults(file: Contents) -> Iterator[str]:
    """Read every dataset, block by block; yield a line for each that is unreadable or invalid."""
    for path, (_, shape) in file.contents().items():
        try:
            check_dataset(file, path, shape)
        except InputError as error:
            yield " ".join(str(error).split())


def check_dataset(file: Contents, path: str, shape: tuple[int, ...]) -> None:
    """Read a dataset, block by block; SchemaError if it is invalid, or not in order from one block to the next."""
    row = schema.load(file.kind).find(path)
    last: Any = None
    for values in blocks(file, path, shape):
        if row is None or not row.limits.increasing or not np.size(values):
            continue
        flat = np.ravel(values)
        if last is not None:
            check_values(file, path, np.append(last, flat[:1]))
        last = flat[-1:]


def _refuse(path: Path, fault: Fault) -> None:
    name, expected, value = fault
    raise SchemaError(f"{name} is impossible", where=str(path), expected=expected, found=value)


def _text_fault(limits: Limits, text: str) -> tuple[str, str] | None:
    short = text if len(text) <= SHORT else text[:SHORT] + "..."
    if limits.one_of and text not in limits.one_of:
        return f"one of {', '.join(limits.one_of)}", short
    if not limits.json:
        return None
    try:
        value = parse_json(text, whole_bits=SEED_BITS)
    except ValueError:
        return f"a JSON {limits.json}", short
    rows = [value] if limits.json == "object" else value
    fine = isinstance(rows, list) and all(isinstance(row, dict) for row in rows)
    if fine and limits.json != "object":
        fine = not any(isinstance(one, (dict, list)) for row in rows for one in row.values())
    return None if fine else (f"a JSON {limits.json}", short)


def _array_fault(file: Contents, row: Dataset, array: NDArray[Any], first: int) -> tuple[str, str] | None:
    """Return expected and found values of the first limit that an array violates; None if there is none."""
    limits = row.limits
    least, most = array.min(), array.max()
    if array.dtype.kind == "f":
        has_nan = bool(np.isnan(least))
        if has_nan:
            least, most = np.fmin.reduce(array, axis=None), np.fmax.reduce(array, axis=None)  # NaN where all are
        if np.isinf((least, most)).any() or (limits.finite is True and has_nan):
            wrong = np.isinf(array) if limits.finite == "or NaN" else ~np.isfinite(array)
            return "finite values" + (" or NaN" if limits.finite == "or NaN" else ""), _first_wrong(wrong, array, first)
        if limits.nan_where and has_nan:
            missing = np.isnan(file.read(limits.nan_where).reshape(-1, 2)).any(axis=1)
            wrong = np.isnan(array) & ~missing[:, None]
            if wrong.any():
                words = f"NaN only for dots that are missing in the grid {limits.nan_where}"
                return words, _first_wrong(wrong, array, first)
    for part, low, high, expected in _bounds(file, row, array):
        beyond = least < low or most > high  # some value, possibly in another part
        if beyond and (np.fmin.reduce(part, axis=None) < low or np.fmax.reduce(part, axis=None) > high):
            return expected, _first_wrong((part < low) | (part > high), part, first)
    if limits.above is not None and not (array > limits.above).all():
        return f"more than {limits.above:g}", _first_wrong(~(array > limits.above), array, first)
    if limits.one_of:
        is_allowed = np.logical_or.reduce([array == value for value in limits.one_of])
        if not is_allowed.all():
            return f"one of {', '.join(map(str, limits.one_of))}", _first_wrong(~is_allowed, array, first)
    if limits.increasing:
        flat = array.ravel()
        back = flat[1:] <= flat[:-1] if limits.increasing == "strictly" else flat[1:] < flat[:-1]
        if back.any():
            words = "strictly increasing" if limits.increasing == "strictly" else limits.increasing
            place = int(np.argmax(back))
            return words, f"{flat[place]}, then {flat[place + 1]}"
    return None


def _first_wrong(wrong: NDArray[np.bool_], array: NDArray[Any], first: int) -> str:
    """Return the first invalid value of an array, and its row, counted from row `first` of a dataset."""
    place = tuple(int(index) for index in np.argwhere(wrong)[0])
    value = str(array[place])[:SHORT]
    return f"{value} in row {first + place[0]}" if place else value


def _bounds(file: Contents, row: Dataset, array: NDArray[Any]) -> Iterator[tuple[NDArray[Any], float, float, str]]:
    """Yield parts of an array, the smallest and largest allowed value of each, and a description of these."""
    limits = row.limits
    if limits.index_of:
        least = int(limits.minimum or 0)
        most = file.length(limits.index_of) - (not row.edges)
        yield array, least, most, f"{least} to {most}, an index of {limits.index_of}"
    elif limits.minimum is not None or limits.maximum is not None:
        low, high = _or(limits.minimum, -np.inf), _or(limits.maximum, np.inf)
        words = f"{limits.minimum} to {limits.maximum}"
        if limits.minimum is None or limits.maximum is None:
            words = f"{high} or less" if limits.minimum is None else f"{low} or more"
        yield array, low, high, words
    if limits.inside_frame:
        width, height = (int(size) for size in file.read("sensor/frame_px"))
        margin = limits.margin_px
        near = f", or up to {margin} px outside it" if margin else ""
        for axis, (name, size) in enumerate((("x", width), ("y", height))):
            if name in limits.inside_frame:
                part = array[..., axis] if limits.inside_frame == "xy" else array
                last = size - 1 if array.dtype.kind == "u" else size  # of pixels, or of positions
                yield part, -margin, last + margin, f"{name} inside the frame of {width} x {height} px{near}"


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value
