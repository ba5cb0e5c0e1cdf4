"""Read events from HDF5 files in the layout of DSEC: `events/{t,x,y,p}`, `t_offset`, both in microseconds.

`ms_to_idx` is not read: it counts milliseconds of the file's own clock, and ours starts at the first event.
"""

import importlib
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from evetac_cli.errors import InputError
from evetac_cli.formats.note import NAME, Note, read_note
from evetac_cli.formats.read.event_validation import (
    CLOCK_LIMIT_US,
    Columns,
    Foreign,
    at_index,
    check_lengths,
    choose_frame,
)

BATCH_ROWS = 1 << 20
LAYOUT = "events/t, events/x, events/y, events/p (the layout of DSEC)"
PROPHESEE_FILTER = 0x8ECF
DAMAGE = (OSError, RuntimeError, KeyError, TypeError, ValueError)  # what h5py raises when a file is broken


def open_hdf5(path: Path, frame_px: tuple[int, int] | None) -> Foreign:
    """Events of an HDF5 file; frame_px is needed because the layout does not say it (an export of ours does)."""
    import h5py

    where = str(path)
    try:
        with h5py.File(path, "r") as file:
            _refuse_own(file, where)
            columns = [_column(file, name, where) for name in "txyp"]
            lengths = [len(column) for column in columns]
            check_lengths(lengths, where)
            clock_us = _t_offset(file, where)
            note = _note(file, where)
    except DAMAGE as error:
        raise _unreadable(where, error) from error
    hint = "say it: --frame-size WIDTHxHEIGHT (640x480 for the DSEC data set)"
    frame = choose_frame(note.frame_px if note else None, frame_px, where, hint)
    return Foreign("hdf5", frame, _batches(path, lengths[0]), clock_us, note=note)


def _batches(path: Path, rows: int) -> Iterator[Columns]:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            for start in range(0, rows, BATCH_ROWS):
                t, x, y, p = (file["events"][name][start : start + BATCH_ROWS] for name in "txyp")
                yield Columns(t, x, y, p, partial(at_index, start))
    except DAMAGE as error:
        raise _unreadable(str(path), error) from error


def _unreadable(where: str, error: Exception) -> InputError:
    reason = (str(error).strip("'\"").splitlines() or [type(error).__name__])[0][:200]
    return InputError(
        "cannot be read as HDF5", where=where, found=reason, hint="the file may be cut short: copy it again"
    )


def _refuse_own(file: Any, where: str) -> None:
    """Our own files carry a header; a recording needs no import, and the other kinds hold no events."""
    header = file.attrs.get("header")
    if isinstance(header, str) and '"kind"' in header:
        raise InputError(
            "is a file of evetac's own, not a foreign one",
            where=where,
            hint="a recording needs no import: give it to label or track as it is",
        )


def _note(file: Any, where: str) -> Note | None:
    text = file.attrs.get(NAME)
    return read_note(text, where) if isinstance(text, str) else None


def _column(file: Any, name: str, where: str) -> Any:
    """One of the four columns, known to be a plain, complete list of numbers that can be decoded here."""
    import h5py

    events = _member(file, "events", where)
    if not isinstance(events, h5py.Group):
        what = f"`events` is one table of shape {getattr(events, 'shape', '?')}"
        raise InputError("holds no columns of events", where=where, expected=LAYOUT, found=what)
    column = _member(events, name, where)
    kind = column.dtype.kind if isinstance(column, h5py.Dataset) else "?"
    if kind not in ("iub" if name == "p" else "iu") or column.ndim != 1:
        what = f"{column.dtype} of shape {column.shape}" if kind != "?" else "a group"
        expected = "a list of integers" + (" in microseconds" if name == "t" else "")
        raise InputError(f"events/{name} is not a column", where=where, expected=expected, found=what)
    _check_stored(column, name, where)
    _check_filters(column, name, where)
    return column


def _member(group: Any, name: str, where: str) -> Any:
    """A child that lies in the file itself: a link to elsewhere could lead to any file of the reader's machine."""
    import h5py

    link = group.get(name, getlink=True)
    if isinstance(link, h5py.HardLink):
        return group[name]
    if link is not None:
        raise InputError(f"`{name}` is a link", where=where, expected="data in the file itself")
    hint = "Prophesee's own layout: convert it with the maker's tools" if group.get("CD", getlink=True) else ""
    names = ", ".join(sorted(map(str, group))[:12]) or "nothing"  # names may be bytes
    raise InputError("holds no columns of events", where=where, expected=LAYOUT, found=names, hint=hint)


def _check_stored(column: Any, name: str, where: str) -> None:
    """Refuse rows that were announced but never written: HDF5 would make zeros of them, without end."""
    if column.external or column.is_virtual:
        raise InputError(f"events/{name} lies in another file", where=where, expected="data in the file itself")
    if column.chunks:
        complete = column.id.get_num_chunks() >= -(-len(column) // column.chunks[0])
    else:
        complete = column.id.get_storage_size() >= len(column) * column.dtype.itemsize
    if not complete:
        raise InputError(
            f"events/{name} is incomplete",
            where=where,
            expected=f"{len(column)} rows",
            found="parts that were never written",
            hint="the program that wrote the file may have been stopped",
        )


def _check_filters(column: Any, name: str, where: str) -> None:
    """Name the plugin that is missing, before HDF5 says it in its own words."""
    import h5py

    recipe = column.id.get_create_plist()
    filters = [recipe.get_filter(i) for i in range(recipe.get_nfilters())]
    for number, _, _, label in filters:
        if not h5py.h5z.filter_avail(number):
            with suppress(ImportError):
                importlib.import_module("hdf5plugin")  # registers its filters
        if not h5py.h5z.filter_avail(number):
            spoken = label.decode(errors="replace").split(";")[0] or "unknown"
            ours = number == PROPHESEE_FILTER
            raise InputError(
                f"events/{name} is compressed with a filter that is not installed here",
                where=where,
                found=f"HDF5 filter {number} ({spoken})",
                hint="convert it with Prophesee's tools" if ours else "pip install hdf5plugin",
            )


def _t_offset(file: Any, where: str) -> int:
    """Microseconds to add to every time, 0 where the file does not say."""
    import h5py

    for group in (file, file["events"]):
        if group.get("t_offset", getlink=True) is None:
            continue
        offset = _member(group, "t_offset", where)
        if not isinstance(offset, h5py.Dataset) or offset.dtype.kind not in "iu" or offset.size != 1:
            raise InputError("`t_offset` is not a number", where=where, expected="one integer, microseconds")
        value = int(offset[()].reshape(()))
        if abs(value) >= CLOCK_LIMIT_US:
            expected = "microseconds within 285 years of 0"
            raise InputError("`t_offset` out of range", where=where, expected=expected, found=str(value))
        return value
    return 0
