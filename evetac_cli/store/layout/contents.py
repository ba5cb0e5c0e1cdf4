"""Whether the contents of a file make sense: the limits of its schema, and rules across datasets.

Why so: there is one place for both and no second way around it. `StageFile.read` hands out nothing that `check_values`
refuses, so a stage is never given a value that its schema forbids; opening a file reads all that is small, and holds it
to the rules (`check_small`); `validate` reads the rest, block by block, in bounded memory (`faults`). What a stage
writes is held to the same before it takes its place (new_contents.py).
"""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from evetac_cli import plugins
from evetac_cli.errors import InputError, SchemaError
from evetac_cli.kernels.calibration import grid
from evetac_cli.kernels.slip.architectures import (
    ARCHITECTURES,
    LEAST_COLUMNS,
    LEAST_ROWS,
    Architecture,
    DotArchitecture,
    PluginArchitecture,
    prefixes,
    weight_shapes,
)
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.schema import Dataset, Limits
from evetac_cli.store.recordings import streams
from evetac_cli.text_files import parse_json

SMALL_VALUES = 4096  # opening a file reads and checks datasets of no more values: 4 s of a trial, in a few ms
BLOCK_VALUES = 1 << 20  # that validate reads together: 8 MiB
SHORT = 60  # characters of a value that a message shows

Fault = tuple[str, str, str]  # dataset, what was expected, what was found
Shapes = dict[str, tuple[str, tuple[int, ...]]]


class Contents(Protocol):
    """What is checked: a stage file, or one that is being written."""

    @property
    def kind(self) -> str:
        """One of schema.KINDS."""

    path: Path

    def read(self, path: str, start: int = 0, stop: int | None = None) -> Any:
        """A dataset, or its rows [start, stop)."""

    def has(self, path: str) -> bool:
        """Whether there is such a dataset."""

    def contents(self) -> Shapes:
        """Path -> (dtype, shape)."""

    def length(self, path: str) -> int:
        """Rows of a dataset."""


def check_values(file: Contents, path: str, values: Any, first: int = 0) -> None:
    """Raise SchemaError if values, of which the first is row `first` of a dataset, are not what its schema allows."""
    row = schema.load(file.kind).find(path)
    if row is None or row.limits == schema.ANYTHING:
        return
    if isinstance(values, str):
        fault = _text_fault(row.limits, values)
    else:
        fault = _array_fault(file, row, np.asarray(values), first) if np.size(values) else None
    if fault:
        _refuse(file, (path, *fault))


def check_small(file: Contents, shapes: Shapes) -> None:
    """Raise SchemaError if a small dataset, or how the datasets fit each other, makes no sense."""
    table = schema.load(file.kind)
    for path, (_, shape) in shapes.items():
        row = table.find(path)
        if row is None or row.limits == schema.ANYTHING:
            continue
        if np.prod(shape) <= SMALL_VALUES:
            file.read(path)
        if row.edges:
            begin, end = int(file.read(path, 0, 1)[0]), int(file.read(path, shape[0] - 1, shape[0])[0])
            rows = file.length(row.limits.index_of)
            if (begin, end) != (0, rows):
                expected = f"begins at 0 and ends at {rows}, the length of {row.limits.index_of}"
                _refuse(file, (path, expected, f"{begin} and {end}"))
    for rule in _RULES.get(file.kind, ()):
        for fault in rule(file, shapes):
            _refuse(file, fault)


def faults(file: Contents) -> Iterator[str]:
    """Read every dataset, block by block; a line for each that cannot be read or makes no sense."""
    for path, (_, shape) in file.contents().items():
        try:
            check_dataset(file, path, shape)
        except InputError as error:
            yield " ".join(str(error).split())


def check_dataset(file: Contents, path: str, shape: tuple[int, ...]) -> None:
    """Read a dataset, block by block; SchemaError if it makes no sense."""
    last: Any = None
    for values in blocks(file, path, shape):
        last = check_order(file, path, last, values)


def check_order(file: Contents, path: str, last: Any, values: Any) -> Any:
    """Hold the first of some values to the one before them, if any; returns the last, which the next values follow."""
    row = schema.load(file.kind).find(path)
    if row is None or not row.limits.increasing or not np.size(values):
        return last
    flat = np.ravel(values)
    if last is not None:
        check_values(file, path, np.append(last, flat[:1]))
    return flat[-1:]


def blocks(file: Contents, path: str, shape: tuple[int, ...]) -> Iterator[Any]:
    """A dataset in pieces of at most BLOCK_VALUES values, or of one row; a scalar or a text as it is."""
    if not shape:
        yield file.read(path)
        return
    rows = max(1, BLOCK_VALUES // max(1, int(np.prod(shape[1:]))))
    for first in range(0, max(shape[0], 1), rows):  # one that is empty, too, is a piece
        yield file.read(path, first, min(first + rows, shape[0]))


def _refuse(file: Contents, fault: Fault) -> None:
    path, expected, value = fault
    raise SchemaError(f"{path} is impossible", where=str(file.path), expected=expected, found=value)


def _text_fault(limits: Limits, text: str) -> tuple[str, str] | None:
    short = text if len(text) <= SHORT else text[:SHORT] + "..."
    if limits.one_of and text not in limits.one_of:
        return f"one of {', '.join(limits.one_of)}", short
    if not limits.json:
        return None
    try:
        value = parse_json(text, most_values=math.inf)
    except ValueError:
        return f"a JSON {limits.json}", short
    rows = [value] if limits.json == "object" else value
    fine = isinstance(rows, list) and all(isinstance(row, dict) for row in rows)
    if fine and limits.json != "object":
        fine = not any(isinstance(one, (dict, list)) for row in rows for one in row.values())
    return None if fine else (f"a JSON {limits.json}", short)


def _array_fault(file: Contents, row: Dataset, array: NDArray[Any], first: int) -> tuple[str, str] | None:
    """Expected and found of the first limit that an array breaks, if any."""
    limits = row.limits
    for other in (limits.index_of, limits.nan_where):
        if other and not file.has(other):
            return f"beside {other}", f"no {other} in the file"

    def first_wrong(wrong: NDArray[np.bool_], part: NDArray[Any] = array) -> str:
        place = tuple(int(index) for index in np.argwhere(wrong)[0])
        value = str(part[place])[:SHORT]
        return f"{value} in row {first + place[0]}" if place else value

    least, most = array.min(), array.max()
    if array.dtype.kind == "f":
        has_nan = bool(np.isnan(least))
        if has_nan:
            least, most = np.fmin.reduce(array, axis=None), np.fmax.reduce(array, axis=None)  # NaN where all are
        if np.isinf((least, most)).any() or (limits.finite is True and has_nan):
            wrong = np.isinf(array) if limits.finite == "or NaN" else ~np.isfinite(array)
            return "finite values" + (" or NaN" if limits.finite == "or NaN" else ""), first_wrong(wrong)
        if limits.nan_where and has_nan:
            missing = np.isnan(file.read(limits.nan_where).reshape(-1, 2)).any(axis=1)
            wrong = np.isnan(array) & ~missing[:, None]
            if wrong.any():
                return f"NaN only for dots that are missing in the grid {limits.nan_where}", first_wrong(wrong)
    for part, low, high, expected in _bounds(file, row, array):
        beyond = least < low or most > high  # some value, which may be of another part
        if beyond and (np.fmin.reduce(part, axis=None) < low or np.fmax.reduce(part, axis=None) > high):
            return expected, first_wrong((part < low) | (part > high), part)
    if limits.above is not None and not (array > limits.above).all():
        return f"more than {limits.above:g}", first_wrong(~(array > limits.above))
    if limits.one_of:
        known = np.logical_or.reduce([array == value for value in limits.one_of])
        if not known.all():
            return f"one of {', '.join(map(str, limits.one_of))}", first_wrong(~known)
    if limits.increasing:
        flat = array.ravel()
        back = flat[1:] <= flat[:-1] if limits.increasing == "strictly" else flat[1:] < flat[:-1]
        if back.any():
            words = "strictly increasing" if limits.increasing == "strictly" else limits.increasing
            place = int(np.argmax(back))
            return words, f"{flat[place]}, then {flat[place + 1]}"
    return None


def _bounds(file: Contents, row: Dataset, array: NDArray[Any]) -> Iterator[tuple[NDArray[Any], float, float, str]]:
    """Parts of an array, the least and greatest value that each may have, and that in words."""
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
        near = f", or {margin} px beside it" if margin else ""
        for axis, (name, size) in enumerate((("x", width), ("y", height))):
            if name in limits.inside_frame:
                part = array[..., axis] if limits.inside_frame == "xy" else array
                last = size - 1 if array.dtype.kind == "u" else size  # of pixels and of places
                yield part, -margin, last + margin, f"{name} inside the frame of {width} x {height} px{near}"


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


def _sensor(file: Contents, shapes: Shapes) -> Iterator[Fault]:
    """Window, radius and dots at rest of a sensor fit its frame, and dots over time fit the grid."""
    width, height = (int(size) for size in file.read("sensor/frame_px"))
    frame = f"inside the frame of {width} x {height} px"
    if "sensor/window_px" in shapes:
        x0, y0, x1, y1 = (int(edge) for edge in file.read("sensor/window_px"))
        if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
            yield "sensor/window_px", f"x0, y0, x1, y1 {frame}", f"{x0}, {y0}, {x1}, {y1}"
    if "sensor/dot_radius_px" in shapes:
        radius = float(file.read("sensor/dot_radius_px"))
        if radius > max(width, height):
            yield "sensor/dot_radius_px", f"no more than the frame of {width} x {height} px", f"{radius:g}"
    if "sensor/dot_xy_px" not in shapes:
        return
    missing = np.isnan(file.read("sensor/dot_xy_px"))
    if missing.all():
        yield "sensor/dot_xy_px", "at least one dot", "all of them NaN"
    if (missing[..., 0] != missing[..., 1]).any():
        yield "sensor/dot_xy_px", "NaN in both coordinates of a missing dot", "it in one"
    known_px = float(file.read("sensor/dot_radius_px")) if "sensor/dot_radius_px" in shapes else None
    fault = grid.impossible(file.read("sensor/dot_xy_px"), known_px)
    if fault:
        yield "sensor/dot_xy_px", *fault
    rows, columns = missing.shape[:2]
    for path in ("dot_xy_px", "truth/dot_xy_px"):
        if path in shapes and shapes[path][1][1] != rows * columns:
            yield "sensor/dot_xy_px", f"a grid of as many dots as {path}, {shapes[path][1][1]}", f"{rows} x {columns}"


def _lost_slices(file: Contents, shapes: Shapes) -> Iterator[Fault]:
    if "capture/lost_slices" in shapes:
        gaps = file.read("capture/lost_slices")
        wrong = gaps[gaps[:, 0] >= gaps[:, 1]]
        if len(wrong):
            yield "capture/lost_slices", "gaps that end after they begin", f"{wrong[0][0]} to {wrong[0][1]}"


def _streams(file: Contents, shapes: Shapes) -> Iterator[Fault]:
    """Streams and their columns have names that fit, their images a shape that can be shown, their units are texts."""
    for path, (_, shape) in shapes.items():
        if not path.startswith(f"{streams.GROUP}/"):
            continue
        _, *named = path.split("/")
        wrong = [name for name in named if not streams.NAME.fullmatch(name)]
        if wrong or len(named) != 2 or named[1] in streams.TAKEN[3:]:
            yield path, f"streams/NAME/COLUMN, in letters, digits, _ . and -, not {', '.join(streams.TAKEN[3:])}", path
        if named[-1] == "frames" and (
            shape[3] not in (1, 3) or not all(0 < side <= streams.LARGEST_FRAME_PX for side in shape[1:3])
        ):
            most = streams.LARGEST_FRAME_PX
            yield path, f"1 or 3 channels, and 1 to {most} rows and columns", " x ".join(map(str, shape[1:]))
        if named[-1] == "about":
            units = parse_json(file.read(path)).get("units", {})
            if not isinstance(units, dict) or not all(isinstance(unit, str) for unit in units.values()):
                yield path, "`units` that are texts, by column", str(units)[:SHORT]


def _grid_of_features(file: Contents, shapes: Shapes) -> Iterator[Fault]:
    rows, columns = (int(size) for size in file.read("dot_shape"))
    dots = shapes["displacement_px"][1][1]
    if rows * columns != dots:
        yield "dot_shape", f"rows x columns of {dots} dots", f"{rows} x {columns}"
    for one, other in (("label", "onset_slice"), ("onset_slice", "label")):
        if one in shapes and other not in shapes:
            yield other, f"as {one} is there, {other} too", "none"


def _weights(file: Contents, shapes: Shapes) -> Iterator[Fault]:
    """The weights are those of the architecture, for this grid."""
    name = file.read("architecture")
    try:
        architecture = named_architecture(name)
    except ValueError as error:
        yield "architecture", str(error), name
        return
    rows, columns = (int(size) for size in file.read("dot_shape"))
    history = int(file.read("history"))
    if history != architecture.history:
        yield "history", f"{architecture.history}, as of the architecture {name}", str(history)
    if isinstance(architecture, DotArchitecture) and (rows < LEAST_ROWS or columns < LEAST_COLUMNS):
        yield "dot_shape", f"at least {LEAST_ROWS} x {LEAST_COLUMNS} dots", f"{rows} x {columns}"
        return
    stored = {
        path.removeprefix("weights/"): shape for path, (_, shape) in shapes.items() if path.startswith("weights/")
    }
    wanted = weight_shapes(architecture, rows, columns, prefixes(stored))
    for layer in sorted(wanted.keys() | stored.keys()):
        if wanted.get(layer) != stored.get(layer):
            expected = (
                f"shape {wanted[layer]} as of {name} for a dot_shape of {rows} x {columns}"
                if layer in wanted
                else f"no such weights in {name}"
            )
            yield f"weights/{layer}", expected, f"shape {stored[layer]}" if layer in stored else "none"


def _layers_of_force(file: Contents, shapes: Shapes) -> Iterator[Fault]:
    if "network/0/weight" not in shapes:
        return
    rows, columns = (int(size) for size in file.read("dot_shape"))
    inputs = shapes["network/0/weight"][1][1]
    if inputs != 2 * rows * columns:
        yield (
            "network/0/weight",
            f"{2 * rows * columns} inputs, x and y of a dot_shape of {rows} x {columns}",
            str(inputs),
        )


def _onset(file: Contents, shapes: Shapes) -> Iterator[Fault]:
    """The onset is the first slice of slip; read at opening too, as an hour of labels takes a few ms."""
    if "label" not in shapes:
        return
    onset, first, slip = int(file.read("onset_slice")), 0, -1
    for label in blocks(file, "label", shapes["label"][1]):
        if slip < 0 and (label == 1).any():
            slip = first + int(np.argmax(label == 1))
        first += len(label)
    if onset != slip:
        yield "onset_slice", f"{slip}, the first slice of slip in label, or -1", str(onset)


_RULES: dict[str, tuple[Callable[[Contents, Shapes], Iterator[Fault]], ...]] = {
    "recording": (_sensor, _lost_slices, _streams),
    "tracks": (_sensor,),
    "labels": (_onset,),
    "features": (_grid_of_features, _onset),
    "model": (_weights,),
    "force-model": (_layers_of_force,),
}


def named_architecture(name: str) -> Architecture:
    """An architecture by its name, ours or a plug-in's; ValueError if there is none of this name."""
    architecture = ARCHITECTURES.get(name) or plugins.find(plugins.NETWORKS, name, PluginArchitecture)
    if architecture is None:
        others = plugins.usable(plugins.NETWORKS)
        raise ValueError(f"one of {', '.join((*ARCHITECTURES, *others))}, or of a plug-in that is not installed")
    return architecture
