"""Read events and external triggers from Prophesee's RAW (EVT2, EVT2.1, EVT3) and DAT files.

The text at the head of a file, lines that begin with "% ", states encoding and frame. Exports of evetac have two more
lines: the note, and the start of the recording on the source's clock; files of faery have the latter as `t0`. The words
of RAW are decoded block by block: the high bits are unwrapped (clock.py) with numpy, and a compiled loop decodes word
after word, because with numpy alone EVT3 takes ten times as long. Some sensors send the upper half of EVT2.1 words
first (`endianness=legacy`). DAT has two bytes, type and size of an event, and then for each event 32 bits of time and
32 bits of pixel and polarity:

    version 1   9 bits of column, 8 of row, 1 of polarity
    version 2   14 bits of column, 14 of row, and 4, the lowest of which is the polarity

Event types 0 (N-CARS, Gen1) and 12 have the same bits. Sources: Prophesee's pages on the formats, and its toolbox for
DAT of type 0.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.note import CLOCK_LIMIT_US, NAME, Note, read_note
from evetac_cli.formats.read.clock import BITS_32, Clock
from evetac_cli.formats.read.prophesee.encodings import ENCODINGS, STATE, TIME_HIGH, TRIGGER
from evetac_cli.formats.read.source import EventColumns, EventSource, ImportFormat, at_index, choose_frame
from evetac_cli.store.recordings.streams import Stream


class PropheseeDecoder:
    """Decodes the words of one stream, block by block."""

    def __init__(self, kind: str) -> None:
        """kind: one of ENCODINGS."""
        from evetac_cli.formats.read.prophesee import prophesee_loops  # brings numba, which only these files need

        self._count = prophesee_loops.count_types
        self._loop = prophesee_loops.evt3 if kind == "evt3" else prophesee_loops.evt2
        self.encoding = ENCODINGS[kind]
        self.clock = Clock((1 << self.encoding.high_bits,), tick_us=self.encoding.tick_us)
        self.untimed = 0  # words before the first with high bits of time
        self.undefined = Counter[int]()  # words of types that the encoding does not define
        self.first_undefined = ""
        self.words = 0
        self._timed = False
        self._state = np.zeros(1, STATE)

    def part(self, words: NDArray[Any], place: Callable[[int], str]) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
        """Decode the next complete words; place(i): a text on the position of word i.

        Return the columns t (us), x, y, p of the events; and of the triggers: time in us, input, 1 for a rising and 0
        for a falling edge.
        """
        encoding = self.encoding
        shift = 8 * words.dtype.itemsize - 4
        first = 0
        if not self._timed:
            timed = np.flatnonzero(words >> shift == TIME_HIGH)
            first = int(timed[0]) if len(timed) else len(words)
            self.untimed += first
            self._timed = len(timed) > 0
            words = words[first:]
        counts = self._count(words, shift)
        self.words += len(words)
        for kind in np.flatnonzero(counts).tolist():
            if kind not in encoding.types:
                row = int(np.argmax(words >> shift == kind))
                self.first_undefined = self.first_undefined or f"type {kind:#x} {place(first + row)}"
                self.undefined[kind] += int(counts[kind])
        rows = np.flatnonzero(words >> shift == TIME_HIGH)
        highs = (words[rows] >> encoding.high_at).astype(np.int64) & ((1 << encoding.high_bits) - 1)
        highs = self.clock.continuous(highs, lambda row: place(first + int(rows[row])))
        most = sum(int(counts[kind]) * events for kind, events in encoding.most_events.items())
        triggers = int(counts[TRIGGER])
        columns: list[Any] = [np.empty(most, kind) for kind in (np.int64, np.uint16, np.uint16, np.uint8)]
        edges: list[Any] = [np.empty(triggers, kind) for kind in (np.int64, np.uint8, np.uint8)]
        events = self._loop(words, highs, self._state, tuple(columns), tuple(edges))
        return [column[:events] for column in columns], edges


OFFSET = "t_offset_us"  # the key of a line that evetac writes
OFFSETS = (OFFSET, "t0")
HEAD_LIMIT_BYTES = BLOCK_BYTES = 1 << 20
KINDS = {"2.0": "evt2", "evt2": "evt2", "2.1": "evt2.1", "evt21": "evt2.1", "3.0": "evt3", "evt3": "evt3"}
# Shift and mask of column, row and polarity, by the version of DAT.
DAT_FIELDS = {"dat1": ((0, 0x1FF), (9, 0xFF), (17, 1)), "dat2": ((0, 0x3FFF), (14, 0x3FFF), (28, 1))}
MOST_UNDEFINED = 0.1  # share of words of undefined types above which a file has another encoding
DAT_EVENTS, DAT_BYTES = (0x00, 0x0C), 8
TRIGGERS = "external triggers; id: the input; edge: 1 rises, 0 falls"


class Head(NamedTuple):
    """The facts that the text states, and its size in bytes."""

    kind: str  # evt2, evt2.1, evt3, dat1 or dat2
    frame_px: tuple[int, int] | None
    size: int
    note: Note | None = None  # of an evetac export
    clock_us: int = 0  # to be added to every time
    swapped: bool = False  # the upper half of each word comes first


def open_prophesee(path: Path, frame_px: tuple[int, int] | None) -> EventSource:
    """Return the events of a RAW or DAT file; frame_px is only for files that do not state it."""
    where = str(path)
    head = read_head(path)
    source = EventSource("prophesee", choose_frame(head.frame_px, frame_px, where), (), head.clock_us, note=head.note)
    raw = head.kind in ENCODINGS
    word_bytes = np.dtype(ENCODINGS[head.kind].dtype).itemsize if raw else DAT_BYTES
    if rest := (path.stat().st_size - head.size) % word_bytes:
        source.notes.append(f"cut short: the last {rest} bytes are an incomplete word")
    blocks = _words(path, head, ENCODINGS[head.kind].dtype if raw else "<u8")
    source.batches = decoded(head.kind, blocks, source, where) if raw else _dat(head.kind, blocks, source)
    return source


def read_head(path: Path) -> Head:
    """Read encoding and frame from the lines at the head; raise InputError for unsupported encodings."""
    where = str(path)
    with path.open("rb") as file:
        content = file.read(HEAD_LIMIT_BYTES)
    fields: dict[str, str] = {}
    size = 0
    while content.startswith(b"% ", size) and "end" not in fields:
        end = content.find(b"\n", size)
        if end < 0:
            raise InputError("the file ends inside its header", where=where, hint="copy it again from the original")
        key, _, value = content[size + 2 : end].decode(errors="replace").strip().partition(" ")
        fields[key.lower()] = value.strip()
        size = end + 1
    kind = _kind(fields, where)
    legacy = fields.get("endianness") == "legacy" or "endianness=legacy" in fields.get("format", "").split(";")
    if kind in DAT_FIELDS:
        _check_dat(content[size : size + 2], where)
        size += 2
    return Head(
        kind,
        _frame(fields),
        size,
        read_note(fields[NAME], where) if NAME in fields else None,
        _clock_us(fields, where),
        legacy and kind == "evt2.1",
    )


def _check_dat(type_and_size: bytes, where: str) -> None:
    """Raise InputError unless the two bytes after the head of DAT announce events of a supported type and size."""
    kind, size = type_and_size if len(type_and_size) == 2 else (-1, 0)
    if kind not in DAT_EVENTS or size != DAT_BYTES:
        expected, found = f"events of type 0x0 or 0xc, of {DAT_BYTES} bytes", f"type {kind:#x}, of {size} bytes"
        raise InputError("the file has no events that can be read", where=where, expected=expected, found=found)


def _clock_us(fields: dict[str, str], where: str) -> int:
    """Return the begin of an export's times on the source's clock; 0 in other files."""
    key = next((key for key in OFFSETS if key in fields), OFFSET)
    text = fields.get(key, "0")
    if not re.fullmatch("-?[0-9]{1,16}", text) or abs(int(text)) >= CLOCK_LIMIT_US:
        expected = "at most 285 years before or after 0"
        raise InputError(f"`{key}` is damaged", where=where, expected=expected, found=text[:40])
    return int(text)


def _kind(fields: dict[str, str], where: str) -> str:
    if "evt" not in fields and "format" not in fields:
        version = fields.get("version", "1")
        if version in ("1", "2"):
            return f"dat{version}"
        raise InputError("this version of DAT is not supported", where=where, expected="1 or 2", found=version[:20])
    name = fields.get("evt") or fields.get("format", "").split(";")[0].lower()
    if name in KINDS:
        return KINDS[name]
    message, hint = "this encoding of RAW is not supported", "convert the file to HDF5 or text with Prophesee's tools"
    raise InputError(message, where=where, expected="EVT2, EVT2.1 or EVT3", found=name[:20], hint=hint)


def _frame(fields: dict[str, str]) -> tuple[int, int] | None:
    """Parse `geometry 640x480`, `format EVT3;height=480;width=640`, or `Width 640` and `Height 480`."""
    width, _, height = fields.get("geometry", "").partition("x")
    inside = dict(part.partition("=")[::2] for part in fields.get("format", "").split(";"))
    pairs = [(table.get("width"), table.get("height")) for table in (inside, fields)]
    for numbers in ((width, height), *pairs):
        if all(number and re.fullmatch("[0-9]{1,5}", number) for number in numbers):
            return int(str(numbers[0])), int(str(numbers[1]))
    return None


def _words(path: Path, head: Head, dtype: str) -> Iterator[tuple[NDArray[Any], Callable[[int], str]]]:
    """Yield all complete words in blocks, their halves in order, and a function that locates word i of a block."""
    size = np.dtype(dtype).itemsize
    at = head.size
    with path.open("rb") as file:
        file.seek(at)
        while block := file.read(BLOCK_BYTES):
            words = np.frombuffer(block[: len(block) // size * size], dtype)
            yield words << np.uint64(32) | words >> np.uint64(32) if head.swapped else words, partial(_byte, at, size)
            at += len(block)


def _byte(start: int, size: int, word: int) -> str:
    return f"at byte {start + size * word}"


def decoded(
    kind: str, blocks: Iterable[tuple[NDArray[Any], Callable[[int], str]]], source: EventSource, where: str
) -> Iterator[EventColumns]:
    """Yield the events of blocks of RAW words; at the end add triggers and left-out data to `source`."""
    decoder = PropheseeDecoder(kind)
    triggers: list[list[NDArray[Any]]] = []
    done = 0
    for words, place in blocks:
        (t, x, y, p), edges = decoder.part(words, place)
        if len(edges[0]):
            triggers.append(edges)
        if len(t):
            yield EventColumns(t, x, y, p, partial(at_index, done))
        done += len(t)
    undefined = decoder.undefined.total()
    if undefined > MOST_UNDEFINED * decoder.words:  # of all words, because a block may have only a few
        message = f"the content is not {decoder.encoding.name}, which the header states"
        found = f"{undefined:,} of {decoder.words:,} words are of undefined types, {decoder.first_undefined}"
        raise InputError(message, where=where, found=found)
    if decoder.untimed:
        size = np.dtype(decoder.encoding.dtype).itemsize
        source.notes.append(f"left out {decoder.untimed * size} bytes before the first time stamp")
    if undefined:
        source.left_out["words of undefined types"] = undefined
    source.notes += decoder.clock.notes
    if triggers:
        t_us, number, edge = (np.concatenate(column) for column in zip(*triggers, strict=True))
        rows = np.argsort(t_us, kind="stable")
        t_us, columns = t_us[rows], {"id": number[rows].astype(np.float64), "edge": edge[rows].astype(np.float64)}
        source.streams.append(
            Stream("triggers", t_us + source.clock_us, columns, what=TRIGGERS, clock="the camera's, same as the events")
        )


def _dat(
    kind: str, blocks: Iterable[tuple[NDArray[Any], Callable[[int], str]]], source: EventSource
) -> Iterator[EventColumns]:
    """Yield the events of blocks of DAT; at the end add a note on clock wraps to `source`."""
    clock = Clock((BITS_32,))
    done = 0
    for words, _ in blocks:
        place = partial(at_index, done)
        t = clock.continuous(words.view("<u4")[::2].astype(np.int64), place)
        payload = words.view("<u4")[1::2]
        x, y, p = (
            (payload >> np.uint32(shift) & np.uint32(mask)).astype(dtype)
            for (shift, mask), dtype in zip(DAT_FIELDS[kind], (np.uint16, np.uint16, np.uint8), strict=True)
        )
        yield EventColumns(t, x, y, p, place)
        done += len(words)
    source.notes += clock.notes


SIGNS = (b"% evt", b"% format", b"% date", b"% camera", b"% integrator", b"% Data", b"% Version", b"% Width", b"% Date")
FORMAT = ImportFormat(SIGNS, open_prophesee)
