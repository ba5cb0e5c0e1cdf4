"""Read events from HDF5 files in the layout of DSEC: `events/{t,x,y,p}`, `t_offset`, both in microseconds.

`ms_to_idx` is not read: it counts milliseconds of the file's own clock, and ours starts at the first event.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from evetac_cli.errors import InputError
from evetac_cli.formats.note import NAME, read_note
from evetac_cli.formats.read.event_validation import (
    CLOCK_LIMIT_US,
    Columns,
    Foreign,
    at_index,
    check_lengths,
    choose_frame,
)
from evetac_cli.store.checked_hdf5 import DAMAGE, EVENT_FILE_FILTERS, CheckedHdf5

BATCH_ROWS = 1 << 20
LAYOUT = "events/t, events/x, events/y, events/p (the layout of DSEC)"
COLUMNS = [f"events/{name}" for name in "txyp"]
OFFSETS = ("t_offset", "events/t_offset")


def open_hdf5(path: Path, frame_px: tuple[int, int] | None) -> Foreign:
    """Events of an HDF5 file; FrameUnknown without frame_px: the layout does not say it (an export of ours does)."""
    where = str(path)
    with CheckedHdf5(path) as file:
        _refuse_own(file)
        datasets = file.datasets([*COLUMNS, *OFFSETS], EVENT_FILE_FILTERS)
        for name in COLUMNS:
            _check_column(file, datasets, name)
        lengths = [len(datasets[name]) for name in COLUMNS]
        check_lengths(lengths, where)
        try:
            clock_us = _t_offset(datasets, where)
        except DAMAGE as error:
            raise _unreadable(where, error) from error
        text = file.text_attribute(NAME)
        note = None if text is None else read_note(text, where)
    hint = "say it: --frame-size WIDTHxHEIGHT (640x480 for the DSEC data set)"
    frame = choose_frame(note.frame_px if note else None, frame_px, where, hint)
    return Foreign("hdf5", frame, _batches(path, lengths[0]), clock_us, note=note, may_be_empty=note is None)


def _batches(path: Path, rows: int) -> Iterator[Columns]:
    with CheckedHdf5(path) as file:
        datasets = file.datasets(COLUMNS, EVENT_FILE_FILTERS)
        columns = [datasets[name] for name in COLUMNS]
        try:
            for start in range(0, rows, BATCH_ROWS):
                t, x, y, p = (column[start : start + BATCH_ROWS] for column in columns)
                yield Columns(t, x, y, p, partial(at_index, start))
        except DAMAGE as error:
            raise _unreadable(str(path), error) from error


def _unreadable(where: str, error: Exception) -> InputError:
    reason = (str(error).strip("'\"").splitlines() or [type(error).__name__])[0][:200]
    return InputError(
        "cannot be read as HDF5", where=where, found=reason, hint="the file may be cut short: copy it again"
    )


def _refuse_own(file: CheckedHdf5) -> None:
    """Our own files carry a header; a recording needs no import, and the other kinds hold no events."""
    header = file.text_attribute("header")
    if header is not None and '"kind"' in header:
        raise InputError(
            "is a file of evetac's own, not a foreign one",
            where=file.where,
            hint="a recording needs no import: give it to label or track as it is",
        )


def _check_column(file: CheckedHdf5, datasets: dict[str, Any], name: str) -> None:
    """One of the four columns is a plain list of whole numbers."""
    column = datasets.get(name)
    if column is None:
        held, hint = _what_there_is(file, name)
        raise InputError("holds no columns of events", where=file.where, expected=LAYOUT, found=held, hint=hint)
    kinds = "iub" if name == "events/p" else "iu"
    if column.dtype.kind not in kinds or len(column.shape or ()) != 1:
        expected = "a list of integers" + (" in microseconds" if name == "events/t" else "")
        held = f"{column.dtype} of shape {column.shape}"
        raise InputError(f"{name} is not a column", where=file.where, expected=expected, found=held)


def _what_there_is(file: CheckedHdf5, name: str) -> tuple[str, str]:
    """What the file holds in place of a column, and what to do with it."""
    events = file.h5.get("events")
    if name in file.h5:
        return f"a group `{name}`", ""
    if events is not None and not hasattr(events, "keys"):
        return f"`events` is one table of shape {events.shape}", ""
    names = ", ".join(sorted(map(str, file.h5 if events is None else events))[:12]) or "nothing"  # may be bytes
    return names, "Prophesee's own layout: convert it with the maker's tools" if "CD" in file.h5 else ""


def _t_offset(datasets: dict[str, Any], where: str) -> int:
    """Microseconds to add to every time, 0 where the file does not say."""
    for offset in (datasets[name] for name in OFFSETS if name in datasets):
        if offset.dtype.kind not in "iu" or offset.size != 1:
            raise InputError("`t_offset` is not a number", where=where, expected="one integer, microseconds")
        value = int(offset[()].reshape(()))
        if abs(value) >= CLOCK_LIMIT_US:
            expected = "microseconds within 285 years of 0"
            raise InputError("`t_offset` out of range", where=where, expected=expected, found=str(value))
        return value
    return 0
