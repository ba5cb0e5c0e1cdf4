"""Read events from Prophesee's RAW (EVT2, EVT2.1, EVT3) and DAT files, all but EVT2.1 with faery, the extra `convert`.

The text at the head of a file, lines that begin with "% ", is read here: which encoding, which frame. Where it does not
say the frame, faery would take 1280 x 720; we ask. Exports of ours have two lines more: the note, and where the start
of the recording is on the source's clock. And faery times events from the first word on, though they have no time
before the first word that holds its high bits: a recorder that was started in the middle of a stream would seem to
begin seconds too early. So what comes before that word is left out, as the maker's own software does. Words of
external triggers are counted.

faery 0.7.1 has no EVT2.1. Its words have 64 bits: four of type, and for events six of time, eleven of column, eleven of
row, and one for each of 32 columns from there on. Some sensors send the upper half first (`endianness=legacy`).
"""

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.note import CLOCK_LIMIT_US, NAME, Note, read_note
from evetac_cli.formats.read.event_validation import Columns, Foreign, at_index, choose_frame
from evetac_cli.formats.read.faery_library import load_faery, refusal_text, scratch_file

SIGNS = (b"% evt", b"% format", b"% date", b"% camera", b"% integrator", b"% Data", b"% Version", b"% Width", b"% Date")
OFFSET = "t_offset_us"  # the key of a line of ours
HEAD_LIMIT_BYTES = 1 << 20
KINDS = {"2.0": "evt2", "evt2": "evt2", "2.1": "evt2.1", "evt21": "evt2.1", "3.0": "evt3", "evt3": "evt3"}
WORD_BYTES = {"evt2": 4, "evt2.1": 8, "evt3": 2, "dat1": 8, "dat2": 8}
KINDS_21 = (0x0, 0x1, 0x8, 0xA, 0xE, 0xF)  # darker, brighter, time, trigger, and two that hold no events
FIELDS_21 = ((54, 0x3F), (43, 0x7FF), (32, 0x7FF))  # shift and mask of the low bits of time, of column and row
HIGH_21 = 1 << 28  # at which the high bits of time begin anew
TIME_HIGH, TRIGGER = 0x8, 0xA  # the upper four bits of a word that holds the high bits of time, or a trigger


class Head(NamedTuple):
    """What the text says, and where the words begin."""

    kind: str  # evt2, evt2.1, evt3, dat1 or dat2
    frame_px: tuple[int, int] | None
    size: int
    note: Note | None = None  # of an export of ours
    clock_us: int = 0  # to be added to every time
    swapped: bool = False  # of each word, the upper half comes first


def open_prophesee(path: Path, frame_px: tuple[int, int] | None) -> Foreign:
    """Events of a RAW or DAT file; frame_px only for files that do not say theirs."""
    where = str(path)
    head = read_head(path)
    frame = choose_frame(head.frame_px, frame_px, where)
    foreign = Foreign("prophesee", frame, (), head.clock_us, note=head.note)
    raw = not head.kind.startswith("dat")
    skipped = untimed_bytes(path, head) if raw else 0
    rest = (path.stat().st_size - head.size) % WORD_BYTES[head.kind]
    if skipped:
        foreign.notes.append(f"left out {skipped} bytes before the first time stamp")
    if rest:
        foreign.notes.append(f"cut short: the last {rest} bytes are no whole word")
    if raw and (triggers := sum(int(np.count_nonzero(kinds == TRIGGER)) for kinds in _kinds(path, head))):
        foreign.left_out["triggers"] = triggers
    if head.kind == "evt2.1":
        foreign.batches = _evt21(path, head, skipped)
    elif skipped:
        foreign.batches = _trimmed(path, head, frame, skipped)
    else:
        foreign.batches = decode(path, head.kind, frame, where)
    return foreign


def read_head(path: Path) -> Head:
    """Encoding and frame from the lines at the head; InputError for encodings that are not read here."""
    where = str(path)
    with path.open("rb") as file:
        content = file.read(HEAD_LIMIT_BYTES)
    fields: dict[str, str] = {}
    size = 0
    while content.startswith(b"% ", size) and "end" not in fields:
        end = content.find(b"\n", size)
        if end < 0:
            raise InputError("the file ends inside its header", where=where, hint="copy it again")
        key, _, value = content[size + 2 : end].decode(errors="replace").strip().partition(" ")
        fields[key.lower()] = value.strip()
        size = end + 1
    kind = _kind(fields, where)
    legacy = fields.get("endianness") == "legacy" or "endianness=legacy" in fields.get("format", "").split(";")
    return Head(
        kind,
        _frame(fields),
        size + 2 * kind.startswith("dat"),
        read_note(fields[NAME], where) if NAME in fields else None,
        _clock_us(fields, where),
        legacy and kind == "evt2.1",
    )


def _clock_us(fields: dict[str, str], where: str) -> int:
    """Where the times of an export of ours begin on the source's clock; 0 in other files."""
    text = fields.get(OFFSET, "0")
    if not re.fullmatch("-?[0-9]{1,16}", text) or abs(int(text)) >= CLOCK_LIMIT_US:
        expected = "microseconds within 285 years of 0"
        raise InputError(f"`{OFFSET}` is damaged", where=where, expected=expected, found=text[:40])
    return int(text)


def _kind(fields: dict[str, str], where: str) -> str:
    if "evt" not in fields and "format" not in fields:
        version = fields.get("version", "1")
        if version in ("1", "2"):
            return f"dat{version}"
        raise InputError("a DAT file of another version", where=where, expected="1 or 2", found=version[:20])
    name = fields.get("evt") or fields.get("format", "").split(";")[0].lower()
    if name in KINDS:
        return KINDS[name]
    raise InputError(
        "a RAW file in an encoding that is not read here",
        where=where,
        expected="EVT2, EVT2.1 or EVT3",
        found=name[:20] or "no name",
        hint="convert it to HDF5 or text with the maker's tools",
    )


def _frame(fields: dict[str, str]) -> tuple[int, int] | None:
    """`geometry 640x480`, `format EVT3;height=480;width=640`, or `Width 640` and `Height 480`."""
    width, _, height = fields.get("geometry", "").partition("x")
    inside = dict(part.partition("=")[::2] for part in fields.get("format", "").split(";"))
    pairs = [(table.get("width"), table.get("height")) for table in (inside, fields)]
    for numbers in ((width, height), *pairs):
        if all(number and re.fullmatch("[0-9]{1,5}", number) for number in numbers):
            return int(str(numbers[0])), int(str(numbers[1]))
    return None


def untimed_bytes(path: Path, head: Head) -> int:
    """Bytes before the first word that holds the high bits of time, as far as the first block of words goes."""
    kinds = next(_kinds(path, head), None)
    if kinds is None:
        return 0
    high = np.flatnonzero(kinds == TIME_HIGH)
    whole = len(kinds) * WORD_BYTES[head.kind] == HEAD_LIMIT_BYTES  # there may be more
    return int(high[0] if len(high) else len(kinds) * whole) * WORD_BYTES[head.kind]


def _kinds(path: Path, head: Head) -> Iterator[NDArray[Any]]:
    """The upper four bits of all words, in blocks."""
    for block in _words(path, head, 0):
        word = 8 * block.dtype.itemsize
        yield block >> (word - 4)


def _words(path: Path, head: Head, skipped: int) -> Iterator[NDArray[Any]]:
    """All whole words after so many bytes, in blocks, the halves of each in order."""
    size = WORD_BYTES[head.kind]
    with path.open("rb") as file:
        file.seek(head.size + skipped)
        while block := file.read(HEAD_LIMIT_BYTES):
            words = np.frombuffer(block[: len(block) // size * size], f"<u{size}")
            yield words << np.uint64(32) | words >> np.uint64(32) if head.swapped else words


def _trimmed(path: Path, head: Head, frame: tuple[int, int], skipped: int) -> Iterator[Columns]:
    """Decode a copy without the words that have no time."""
    with scratch_file(".raw") as (copy, target):
        target.write(raw_header(head.kind, frame))
        for words in _words(path, head, skipped):
            target.write(words.tobytes())
        target.flush()
        yield from decode(copy, head.kind, frame, str(path))


def _evt21(path: Path, head: Head, skipped: int) -> Iterator[Columns]:
    """The events of EVT2.1; InputError at a word of a type that is none of its own."""
    high = turns = done = start = 0
    for words in _words(path, head, skipped):
        kind = (words >> np.uint64(60)).astype(np.int64)
        unknown = ~np.isin(kind, KINDS_21)
        if unknown.any():
            at = int(np.argmax(unknown))
            place = head.size + skipped + 8 * (done + at)
            raise InputError(
                "a word that EVT2.1 does not have",
                where=str(path),
                found=f"type {kind[at]:#x} at byte {place}",
                hint="the file is damaged; copy it again",
            )
        highs = kind == TIME_HIGH
        times = ((words[highs] >> np.uint64(32)) & np.uint64(HIGH_21 - 1)).astype(np.int64)
        wrapped = np.cumsum(np.diff(times, prepend=high) < -(HIGH_21 // 2)) + turns
        since = np.concatenate([[high + turns * HIGH_21], times + wrapped * HIGH_21])[np.cumsum(highs)]
        if len(times):
            high, turns = int(times[-1]), int(wrapped[-1])
        events = kind <= 1
        of_pixels, p = words[events], kind[events]
        word, column = np.nonzero((of_pixels.astype(np.uint32)[:, None] >> np.arange(32, dtype=np.uint32)) & 1)
        low, x, y = ((of_pixels >> np.uint64(shift)).astype(np.int64) & mask for shift, mask in FIELDS_21)
        t = (since[events] << 6) + low
        yield Columns(t[word], x[word] + column, y[word], p[word].astype(np.uint8), partial(at_index, start))
        start += len(word)
        done += len(kind)


def raw_header(kind: str, frame: tuple[int, int]) -> bytes:
    """The lines of text that a RAW file of an encoding (evt2, evt3) begins with."""
    return "% evt {}.0\n% geometry {}x{}\n% end\n".format(kind[-1], *frame).encode()


def decode(path: Path, kind: str, frame: tuple[int, int], where: str) -> Iterator[Columns]:
    """All events of a file, by faery; `where` is what the user calls it."""
    faery = load_faery("RAW and DAT files need", where)
    start = 0
    try:
        stream = faery.events_stream_from_file(
            path, dimensions_fallback=frame, version_fallback=kind, file_type=kind[:3]
        )
        if tuple(stream.dimensions()) != tuple(frame):
            raise ValueError("its header says two frame sizes")
        packets = iter(stream)
        while (events := next(packets, None)) is not None:
            yield Columns(events["t"], events["x"], events["y"], events["on"], partial(at_index, start))
            start += len(events)
    except BaseException as error:
        raise InputError(
            "cannot be read as Prophesee's",
            where=where,
            found=f"after {start} events: {refusal_text(error)}",
            hint="the file is damaged; copy it again",
        ) from None
