"""Rules across the datasets of a file, in addition to the limits of its schema, which concern single datasets.

Each rule yields its violations: the dataset, the expected value, and the value found. contents.py applies the rules.
"""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

from evetac_cli import plugins
from evetac_cli.kernels.calibration import grid
from evetac_cli.kernels.slip.architectures import (
    ARCHITECTURES,
    LEAST_COLUMNS,
    LEAST_ROWS,
    Architecture,
    DotArchitecture,
    PluginLayers,
    PluginNetwork,
    weight_shapes,
)
from evetac_cli.store.recordings import streams
from evetac_cli.text_files import parse_json

BLOCK_VALUES = 1 << 20  # values read at a time: 8 MiB
SHORT = 60  # longest value in a message, in characters

Fault = tuple[str, str, str]  # dataset, expected, found
Shapes = dict[str, tuple[str, tuple[int, ...]]]
Rule = Callable[["Contents", Shapes], Iterator[Fault]]


class Contents(Protocol):
    """The checked contents: those of a stage file, or of one that is being written."""

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


def blocks(file: Contents, path: str, shape: tuple[int, ...]) -> Iterator[Any]:
    """Yield a dataset in blocks of at most BLOCK_VALUES values, or of one row; a scalar or a text as a whole."""
    if not shape:
        yield file.read(path)
        return
    rows = max(1, BLOCK_VALUES // max(1, int(np.prod(shape[1:]))))
    for first in range(0, max(shape[0], 1), rows):  # an empty dataset has one block
        yield file.read(path, first, min(first + rows, shape[0]))


def _sensor(file: Contents, shapes: Shapes) -> Iterator[Fault]:
    """Check that window, radius and dots at rest fit the frame, and that dots over time fit the grid."""
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
        yield "sensor/dot_xy_px", "NaN in both coordinates of a missing dot", "NaN in one"
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


def _stream_shapes(file: Contents, shapes: Shapes) -> Iterator[Fault]:
    """Check the names of streams and columns, and the shape of images."""
    for path, (_, shape) in shapes.items():
        if not path.startswith(f"{streams.GROUP}/"):
            continue
        _, *parts = path.split("/")
        wrong = [name for name in parts if not streams.NAME.fullmatch(name)]
        if wrong or len(parts) != 2 or parts[1] in streams.TAKEN[3:]:
            yield path, f"streams/NAME/COLUMN, in letters, digits, _ . and -, not {', '.join(streams.TAKEN[3:])}", path
        if parts[-1] == "frames" and (
            shape[3] not in (1, 3) or not all(0 < side <= streams.LARGEST_FRAME_PX for side in shape[1:3])
        ):
            most = streams.LARGEST_FRAME_PX
            yield path, f"1 or 3 channels, and 1 to {most} rows and columns", " x ".join(map(str, shape[1:]))


def _units_of_streams(file: Contents, shapes: Shapes) -> Iterator[Fault]:
    for path in shapes:
        if re.fullmatch(f"{streams.GROUP}/[^/]+/about", path):
            units = parse_json(file.read(path)).get("units", {})
            if not isinstance(units, dict) or not all(isinstance(unit, str) for unit in units.values()):
                yield path, "`units` that are texts, by column", str(units)[:SHORT]


def _label_and_onset(file: Contents, shapes: Shapes) -> Iterator[Fault]:
    for one, other in (("label", "onset_slice"), ("onset_slice", "label")):
        if one in shapes and other not in shapes:
            yield other, f"{other}, because {one} is present", "none"


def _grid_of_features(file: Contents, shapes: Shapes) -> Iterator[Fault]:
    rows, columns = (int(size) for size in file.read("dot_shape"))
    dots = shapes["displacement_px"][1][1]
    if rows * columns != dots:
        yield "dot_shape", f"rows x columns of {dots} dots", f"{rows} x {columns}"


def _weights(file: Contents, shapes: Shapes) -> Iterator[Fault]:
    """Check that the weights are those of the architecture for this grid."""
    stored = {
        path.removeprefix("weights/"): shape for path, (_, shape) in shapes.items() if path.startswith("weights/")
    }
    if "0.input_scale" in stored:  # written by 0.2
        yield "weights", "one network: train the model again", "an ensemble of networks, which is no longer read"
        return
    name = file.read("architecture")
    try:
        architecture = named_architecture(name)
    except ValueError as error:
        yield "architecture", str(error), name
        return
    rows, columns = (int(size) for size in file.read("dot_shape"))
    history = int(file.read("history"))
    if history != architecture.history:
        yield "history", f"{architecture.history}, that of the architecture {name}", str(history)
    if isinstance(architecture, DotArchitecture) and (rows < LEAST_ROWS or columns < LEAST_COLUMNS):
        yield "dot_shape", f"at least {LEAST_ROWS} x {LEAST_COLUMNS} dots", f"{rows} x {columns}"
        return
    wanted = weight_shapes(architecture, rows, columns)
    for layer in sorted(wanted.keys() | stored.keys()):
        if wanted.get(layer) != stored.get(layer):
            expected = (
                f"shape {wanted[layer]}, that of {name} for a dot_shape of {rows} x {columns}"
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
    """Check that the onset is the first slice of slip; an hour of labels takes a few ms.

    If labels abstain, the onset is a guess, in a slice that is not examined, and no slice before it is slip.
    """
    if "label" not in shapes:
        return
    onset, first, slip, guessed = int(file.read("onset_slice")), 0, -1, False
    for label in blocks(file, "label", shapes["label"][1]):
        if slip < 0 and (label == 1).any():
            slip = first + int(np.argmax(label == 1))
        if first <= onset < first + len(label):
            guessed = label[onset - first] == -1
        first += len(label)
    if "abstained" in shapes and bool(file.read("abstained")):
        if not guessed or 0 <= slip < onset:
            yield "onset_slice", "a slice before all slip with label -1, because the labels abstain", str(onset)
    elif onset != slip:
        yield "onset_slice", f"{slip}, the first slice of slip in label, or -1", str(onset)


_SENSOR = "sensor/(frame|window|dot_radius|dot_xy)_px|(truth/)?dot_xy_px"
_ONSET = "label|onset_slice|abstained"
# Rules, each with a pattern for the datasets that it concerns; an empty one is for names and shapes alone.
RULES: dict[str, tuple[tuple[Rule, str], ...]] = {
    "recording": (
        (_sensor, _SENSOR),
        (_lost_slices, "capture/lost_slices"),
        (_units_of_streams, f"{streams.GROUP}/.*"),
        (_stream_shapes, ""),
    ),
    "tracks": ((_sensor, _SENSOR),),
    "labels": ((_onset, _ONSET),),
    "features": ((_grid_of_features, "dot_shape|displacement_px"), (_onset, _ONSET), (_label_and_onset, "")),
    "model": ((_weights, "architecture|history|dot_shape|weights/.*"),),
    "force-model": ((_layers_of_force, "dot_shape|network/0/weight"),),
}


def named_architecture(name: str) -> Architecture:
    """Return an architecture by its name, evetac's or a plug-in's; ValueError if there is none of this name."""
    of_plugin = cast(PluginNetwork | None, plugins.find(plugins.NETWORKS, name, PluginLayers))
    architecture = ARCHITECTURES.get(name) or of_plugin
    if architecture is None:
        others = plugins.usable(plugins.NETWORKS)
        names = ", ".join((*ARCHITECTURES, *others))
        raise ValueError(f"one of {names}; if it is from a plug-in, install that, else train again")
    return architecture
