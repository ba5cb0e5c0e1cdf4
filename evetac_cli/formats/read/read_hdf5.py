"""Read events from HDF5 files of DSEC, rpg's e2vid, M3ED, MVSEC, v2e and Prophesee; each layout is a row of one table.

The layouts differ in names and in the unit of time. The columns are separate datasets, a table (N, 4), or the fields of
a compound. Indices from milliseconds to events are not read, because they refer to the file's own clock, while evetac's
clock starts at the first event. All other data in a file is named and counted.
"""

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.errors import InputError
from evetac_cli.formats.note import CLOCK_LIMIT_US, NAME, Note, read_note
from evetac_cli.formats.read.columns import (
    ColumnTimes,
    by_name,
    declared_order,
    declared_unit,
    places_of,
    refuse_columns,
)
from evetac_cli.formats.read.source import (
    EventColumns,
    EventSource,
    ImportFormat,
    at_index,
    check_lengths,
    choose_frame,
)
from evetac_cli.store.hdf5.checked_hdf5 import CheckedHdf5, damage_in_words

BATCH_ROWS = 1 << 20
OFFSETS = ("t_offset", "events/t_offset")
# Indices from time to events, which contain no further information.
INDICES = re.compile(r"(^|/)(ms_to_idx|ms_map_idx|indexes|t_offset|image_raw_event_inds)$")


class Hdf5Layout(NamedTuple):
    """The paths of a layout's events; `order` names the columns of a table, and is empty for a compound."""

    name: str
    paths: tuple[str, ...]  # columns t, x, y, p, or the one table
    order: str = ""
    us_per_unit: float | None = 1.0  # None: determined from the numbers (columns.py)
    stream: str = ""  # name of the camera, if files may have two


LAYOUTS = (
    Hdf5Layout("DSEC", ("events/t", "events/x", "events/y", "events/p")),
    Hdf5Layout("rpg", ("events/ts", "events/xs", "events/ys", "events/ps"), us_per_unit=None),
    Hdf5Layout("MVSEC", ("davis/left/events",), "x y t p", 1e6, "left"),
    Hdf5Layout("MVSEC", ("davis/right/events",), "x y t p", 1e6, "right"),
    Hdf5Layout("M3ED", tuple(f"prophesee/left/{name}" for name in "txyp"), stream="left"),
    Hdf5Layout("M3ED", tuple(f"prophesee/right/{name}" for name in "txyp"), stream="right"),
    Hdf5Layout("v2e", ("events",), "t x y p"),
    Hdf5Layout("Prophesee", ("CD/events",)),
)
EXPECTED = "events in the layout of " + ", ".join(dict.fromkeys(layout.name for layout in LAYOUTS))


def open_hdf5(
    path: Path,
    frame_px: tuple[int, int] | None,
    stream: str | None = None,
    columns: str | None = None,
    time_unit: str | None = None,
) -> EventSource:
    """Return the events of an HDF5 file; raise FrameUnknown without frame_px if the file does not state it."""
    where = str(path)
    with CheckedHdf5(path) as file:
        _refuse_own(file)
        every = [name for layout in LAYOUTS for name in layout.paths]
        datasets = file.datasets([*every, *OFFSETS])
        layout, others = _choose(file, datasets, stream)
        with damage_in_words(path, "its contents"):
            for name in layout.paths:
                if not _is_readable(datasets[name], layout, name):
                    found = f"`{name}`: {str(datasets[name].dtype)[:120]} of shape {datasets[name].shape}"
                    expected = EXPECTED + (", in whole numbers, with times in us" if layout.us_per_unit == 1 else "")
                    raise InputError("the file has no event columns", where=where, expected=expected, found=found)
            rows = [len(datasets[name]) for name in layout.paths]
            check_lengths(rows * (4 // len(rows)), where)
            clock_us = _t_offset(datasets, where) if layout.name == "DSEC" else 0
        note, own_px = _frame(file, layout)
        left_out = {
            f"rows of {name}": other.shape[0] if other.shape else 1
            for name, other in file.survey().items()
            if name not in layout.paths and not INDICES.search(name)
        }
    hint = "give it with --frame-size WIDTHxHEIGHT (640x480 for the DSEC data set)"
    frame = choose_frame(own_px, frame_px, where, hint)
    source = EventSource("hdf5", frame, (), clock_us, note=note, may_be_empty=note is None, left_out=left_out)
    unit = declared_unit(time_unit, None, where) or layout.us_per_unit
    source.times = ColumnTimes(where, unit, documented=time_unit is None and note is None)
    places = None
    if layout.order:
        places = places_of(layout.order if columns is None else declared_order(columns, where))
    else:
        refuse_columns(columns, where)
    source.batches = _batches(path, layout, places, rows[0], source.times)
    if others:
        also = ", ".join(others)
        source.notes.append(f"read the camera {layout.stream}; the file also has: {also} (choose with --stream)")
    if note is None:
        source.assumed = f"the layout of {layout.name}"
        source.guessed_order = "" if columns else layout.order
    return source


def _choose(file: CheckedHdf5, datasets: dict[str, Any], wanted: str | None) -> tuple[Hdf5Layout, list[str]]:
    """Return the layout of the file, and the names of its other cameras."""
    present = [layout for layout in LAYOUTS if all(name in datasets for name in layout.paths)]
    if not present:
        started = [layout for layout in LAYOUTS if any(name in datasets for name in layout.paths)]
        missing = [name for layout in started[:1] for name in layout.paths if name not in datasets]
        found = _contents(file, missing)
        raise InputError("the file has no event columns", where=file.where, expected=EXPECTED, found=found)
    labels = {layout.stream: layout for layout in present if layout.name == present[0].name}
    if wanted is not None and wanted not in labels:
        expected = " or ".join(filter(None, labels)) or "no --stream: the file has only one stream"
        raise InputError("the file has no such event stream", where=file.where, expected=expected, found=wanted[:80])
    chosen_layout = labels[wanted] if wanted is not None else present[0]
    return chosen_layout, [label for label in labels if label != chosen_layout.stream and wanted is None]


def _frame(file: CheckedHdf5, layout: Hdf5Layout) -> tuple[Note | None, tuple[int, int] | None]:
    """Return the note of an evetac export, and the frame stated by it or by Prophesee's attribute `geometry`."""
    text = file.text_attribute(NAME)
    if text is not None:
        note = read_note(text, file.where)
        return note, note.frame_px
    geometry = file.text_attribute("geometry") if layout.name == "Prophesee" else None
    sizes = re.fullmatch("([0-9]{1,5})x([0-9]{1,5})", geometry or "")
    return None, (int(sizes[1]), int(sizes[2])) if sizes else None


def _batches(
    path: Path, layout: Hdf5Layout, order: tuple[int, int, int, int] | None, rows: int, times: ColumnTimes
) -> Iterator[EventColumns]:
    """Yield the events in blocks; order: indices of t, x, y, p in a table."""
    with CheckedHdf5(path) as file:
        datasets = file.datasets(layout.paths)
        parts = [datasets[name] for name in layout.paths]
        for start in range(0, rows, BATCH_ROWS):
            with damage_in_words(path, "its events"):
                t, x, y, p = _columns([part[start : start + BATCH_ROWS] for part in parts], order)
            place = partial(at_index, start)
            yield EventColumns(times.us(t, place), x, y, p, place)


def _columns(blocks: list[Any], order: tuple[int, int, int, int] | None) -> Any:
    """Return the columns t, x, y, p of a block of rows."""
    if len(blocks) == 4:
        return blocks
    (table,) = blocks
    if order is not None:
        return [table[:, place] for place in order]
    return [table[table.dtype.names[place]] for place in _fields(table.dtype)]


def _fields(dtype: Any) -> tuple[int, ...]:
    """Return the indices of t, x, y, p among a compound's fields; () if one is missing or a field is not a number."""
    order = by_name(dtype.names or ())
    plain = all(dtype[name].kind in "iubf" for name in dtype.names or ())
    return order.places if order is not None and plain else ()


def _refuse_own(file: CheckedHdf5) -> None:
    """Raise InputError for evetac's own files, which have a header: recordings need no import."""
    if '"kind"' in (file.text_attribute("header") or ""):
        hint = "a recording needs no import: use it directly, for example with label or track"
        raise InputError("this is already a file of evetac", where=file.where, hint=hint)


def _is_readable(dataset: Any, layout: Hdf5Layout, name: str) -> bool:
    """Whether a dataset of events is a list of numbers, a table of four columns, or a compound with t, x, y, p.

    Times are whole numbers, because a layout that documents a unit of time stores no fractions of it.
    """
    shape: tuple[int, ...] = dataset.shape or ()
    kind = dataset.dtype.kind
    if len(layout.paths) == 4:
        is_time_of_unknown_unit = name == layout.paths[0] and layout.us_per_unit is None
        return len(shape) == 1 and kind in ("iuf" if is_time_of_unknown_unit else "iub")
    if layout.order:
        return len(shape) == 2 and shape[1] == 4 and kind in "iuf"
    return len(shape) == 1 and bool(_fields(dataset.dtype))


def _contents(file: CheckedHdf5, missing: list[str]) -> str:
    """Return a text on the file's contents if columns are missing."""
    group = next((name for name in missing if name in file.h5), None)
    if group is not None:
        return f"a group `{group}`"
    events = file.h5.get("events")
    names = file.h5 if events is None or not hasattr(events, "keys") else events
    return ", ".join(sorted(map(str, names))[:12]) or "nothing"  # names may be bytes


def _t_offset(datasets: dict[str, Any], where: str) -> int:
    """Return the microseconds to add to every time; 0 if the file does not state them."""
    for offset in (datasets[name] for name in OFFSETS if name in datasets):
        if offset.dtype.kind not in "iu" or offset.size != 1:
            raise InputError("`t_offset` is not one number", where=where, expected="one integer, microseconds")
        value = int(offset[()].reshape(()))
        if abs(value) >= CLOCK_LIMIT_US:
            expected = "at most 285 years before or after 0"
            raise InputError("`t_offset` is out of range", where=where, expected=expected, found=f"{value} us")
        return value
    return 0


SIGNATURE, SIGNATURE_AT = b"\x89HDF\r\n\x1a\n", (0, 512, 1024, 2048)  # a user block may come before it
FORMAT = ImportFormat((SIGNATURE,), open_hdf5, ("stream", "columns", "time_unit"), SIGNATURE_AT)
