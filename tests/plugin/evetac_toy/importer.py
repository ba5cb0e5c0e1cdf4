"""Read toy files: a first line `toy events 640x480`, then a line `t_us,x,y,p` for every event."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.formats.imports import ImportFormat
from evetac_cli.formats.read.source import EventColumns, EventSource, choose_frame

MARK = b"toy events "


def read(path: Path, frame_px: tuple[int, int] | None) -> EventSource:
    """Return the frame at once and the events batch by batch; their times, order and frame are checked afterwards."""
    with path.open(encoding="ascii", errors="replace") as file:
        width, _, height = file.readline().removeprefix(MARK.decode()).strip().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise InputError("no frame in the first line", where=str(path), expected="as in toy events 640x480")
    frame = choose_frame((int(width), int(height)), frame_px, str(path))
    return EventSource("toy", frame, batches(path), may_be_empty=True)


def batches(path: Path) -> Iterator[EventColumns]:
    """Yield all events; a reader of large files should yield several batches."""
    try:
        table = np.loadtxt(path, np.int64, delimiter=",", skiprows=1, ndmin=2)
    except ValueError as error:
        raise InputError("not a line of an event", where=str(path), found=str(error)) from None
    if table.size:
        yield EventColumns(*table.T, place=lambda row: f"in line {row + 2}")


TOY = ImportFormat((MARK,), read)
