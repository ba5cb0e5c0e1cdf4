"""Other streams of a trial as observations: a frame has the last sample before its end.

The numbers of a stream become the vector `observation.streams.NAME`, its images the video `observation.images.NAME`.
Streams that only some trials have, or whose columns or sizes differ, are left out, and the export reports this.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Ints
from evetac_cli.events import SLICE_US
from evetac_cli.store.recordings import streams
from evetac_cli.store.recordings.read import Recording

NUMBERS, IMAGES = "observation.streams.{}", "observation.images.{}"
OURS = (
    "tactile",
    "stream_",
)  # prefixes that a stream's image feature must not have: the tactile sensor's, and `stream_`


class StreamShapes(NamedTuple):
    """The streams of a trial: columns of numbers by the stream's name, and (rows, columns) of its images."""

    columns: Mapping[str, tuple[str, ...]]
    images: Mapping[str, tuple[int, int]]


def shapes(recording: Recording, columns: Sequence[str]) -> StreamShapes:
    """Return the streams of a trial; columns: the names of all columns of its slices."""
    stored = recording.contents()
    names = streams.names(stored)
    of: dict[str, list[str]] = {name: [] for name in names}
    longest_first = sorted(names, key=len, reverse=True)
    for column in columns:
        name = next((name for name in longest_first if column.startswith(f"{streams.GROUP}_{name}_")), None)
        if name is not None and column != f"{streams.GROUP}_{name}_t_us":
            of[name].append(column)
    images = {name: path for name in names if (path := f"{streams.GROUP}/{name}/frames") in stored}
    return StreamShapes(
        {name: tuple(found) for name, found in of.items() if found},
        {name: (stored[path][1][1], stored[path][1][2]) for name, path in images.items()},
    )


def shared(trials: Sequence[StreamShapes], largest_px: int) -> tuple[StreamShapes, list[str]]:
    """Return the streams that are the same in all trials, and texts on what is left out."""
    left_out = []
    kept: list[dict[str, tuple]] = []
    for what in StreamShapes._fields:
        of_all = [getattr(one, what) for one in trials]
        every = sorted(set().union(*of_all))
        alike = {name: of_all[0].get(name) for name in every if len({one.get(name) for one in of_all}) == 1}
        left_out += [f"{streams.GROUP}/{name}: its {what} differ between trials" for name in every if name not in alike]
        kept.append({name: shape for name, shape in alike.items() if shape is not None})
    too_large = [name for name, shape in kept[1].items() if max(shape) > largest_px]
    left_out += [f"images of {streams.GROUP}/{name}: more than {largest_px} px per side" for name in too_large]
    images = {name: shape for name, shape in kept[1].items() if name not in too_large}
    return StreamShapes(kept[0], images), left_out


def image_key(name: str) -> str:
    """Return the name of the feature with a stream's images, distinct from those of the tactile sensor."""
    return IMAGES.format(f"stream_{name}" if name.startswith(OURS) else name)


def pictures(recording: Recording, name: str, edges: Ints) -> Iterator[NDArray[np.uint8]]:
    """Yield the images of a stream at the end of each frame, (rows, columns, 3), black before the first.

    Odd sides get one more row or column, because codecs require even sides.
    """
    path = f"{streams.GROUP}/{name}"
    at = np.searchsorted(recording.read(f"{path}/t_us"), edges[1:] * SLICE_US) - 1
    rows, columns = recording.contents()[f"{path}/frames"][1][1:3]
    shown, picture = -1, np.zeros((rows + rows % 2, columns + columns % 2, 3), np.uint8)
    for number in at.tolist():
        if number != shown:
            shown, picture = number, np.zeros_like(picture)
            picture[:rows, :columns] = recording.read(f"{path}/frames", number, number + 1)[0]
        yield picture
