"""Read events from AEDAT 2 files of jAER and v2e: lines that begin with `#`, then words, big-endian.

    uint32 address, uint32 time in us
    DVS128    address bits 1-7 column, 8-14 row, 0 polarity (0 is brighter); higher bits set: not a pixel
    DAVIS     12-21 column, 22-30 row, 11 polarity (1 is brighter), 10 external input; bit 31: frame or IMU

Columns count from the right and rows from the bottom, as in jAER's extractors and v2e's writer. Here both are flipped,
so that (0, 0) is at the top left. The chip is the one named in the line `AEChip`, otherwise the one whose addresses
fit. iniVation's page states the opposite polarity for the DVS128; jAER and dv-processing read it as here.
"""

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.read.clock import BITS_31, BITS_32, Clock
from evetac_cli.formats.read.source import (
    EventColumns,
    EventSource,
    ImportFormat,
    at_index,
    checked_frame,
    choose_frame,
)

WORD = np.dtype([("address", ">u4"), ("t", ">u4")])
BATCH_WORDS = 1 << 18
LINE_LIMIT_BYTES = 1 << 16
HEAD_LIMIT_BYTES = 1 << 24  # jAER writes all its settings there
NOT_TEXT = re.compile(rb"[^\t\r\n\x20-\xff]")
LAST_LINE = b"#End Of ASCII Header"
# DAVIS: words with bit 31 are samples of frames, or of the IMU if both bits of IMU are set
NO_PIXEL, EXTERNAL, IMU = 1 << 31, 1 << 10, 0b11 << 10


class Chip(NamedTuple):
    """The layout of an address: shift and mask of column and row, shift of the polarity and its value for ON."""

    name: str
    x: tuple[int, int]
    y: tuple[int, int]
    polarity: tuple[int, int]
    no_pixel: int  # bits that are set if a word is not a pixel


DVS128 = Chip("DVS128", (1, 0x7F), (8, 0x7F), (0, 0), 0xFFFF8000)
DAVIS = Chip("DAVIS", (12, 0x3FF), (22, 0x1FF), (11, 1), NO_PIXEL | EXTERNAL)
DVS128_PX = (128, 128)
DAVIS_PX = {"240": (240, 180), "346": (346, 260), "128": (128, 128), "208": (208, 192), "640": (640, 480)}
GUESSED_PX = (DAVIS_PX["240"], DAVIS_PX["346"], DAVIS_PX["640"])


def open_aedat2(path: Path, frame_px: tuple[int, int] | None) -> EventSource:
    """Return the events of an AEDAT 2 file; frame_px is only for files that name no chip."""
    where = str(path)
    with path.open("rb") as handle:
        header_chip, start = _head(handle, where)
    size = path.stat().st_size
    count, rest = divmod(size - start, WORD.itemsize)
    if header_chip is None:
        chip, own_px = _guess_chip(path, start, frame_px, where)
    else:
        chip, own_px = header_chip
    frame = choose_frame(own_px if header_chip else None, frame_px or own_px, where)
    source = EventSource("aedat2", frame, ())
    source.assumed = ("" if header_chip else f"a {chip.name} of {frame[0]}x{frame[1]}, by its addresses; ") + (
        f"columns from the right, rows from the bottom, polarity bit {chip.polarity[1]} brighter, time in microseconds"
    )
    if rest:
        source.notes.append(f"cut short: the last {rest} bytes are an incomplete event")
        source.cut_short = True
    source.batches = _batches(path, start, count, chip, source)
    return source


def _head(handle: BinaryIO, where: str) -> tuple[tuple[Chip, tuple[int, int]] | None, int]:
    """Return the chip named in the head, and the position of the first word."""
    chip = None
    start = 0
    while start <= HEAD_LIMIT_BYTES:
        line = handle.readline(LINE_LIMIT_BYTES)
        # Words may begin with the byte of `#`, but lines of text contain no control characters.
        if not line.startswith(b"#") or NOT_TEXT.search(line):
            return chip, start
        start += len(line)
        key, _, value = line.decode("latin-1").strip("# \t\r\n").partition(":")
        if key.strip() == "AEChip":
            chip = _chip(value.strip(), where)
        if line.startswith(LAST_LINE):
            return chip, start
    raise InputError("the header of the file does not end", where=where, found=f"more than {HEAD_LIMIT_BYTES:,} bytes")


def _chip(name: str, where: str) -> tuple[Chip, tuple[int, int]]:
    """Return the chip from the name of its Java class, for example `eu.seebetter.ini.chips.davis.DAVIS240C`."""
    last = name.rpartition(".")[2]
    davis = re.match("davis([0-9]{3})", last, re.IGNORECASE)
    if davis and davis[1] in DAVIS_PX:
        return DAVIS, DAVIS_PX[davis[1]]
    if re.match("dvs128|tmpdiff128", last, re.IGNORECASE):
        return DVS128, DVS128_PX
    supported_chips = ", ".join(["DVS128", *(f"DAVIS{size}" for size in DAVIS_PX)])
    raise InputError("the file is from an unsupported chip", where=where, expected=supported_chips, found=last[:60])


def _guess_chip(path: Path, start: int, frame_px: tuple[int, int] | None, where: str) -> tuple[Chip, tuple[int, int]]:
    """Return the chip whose addresses fit the file, and the requested frame or the smallest that fits."""
    most, width, height = 0, 0, 0
    for words in _words(path, start):
        address = words["address"]
        most = max(most, int(address.max(initial=0)))
        pixels = address[(address & DAVIS.no_pixel) == 0]
        width = max(width, int(_field(pixels, DAVIS.x).max(initial=-1)) + 1)
        height = max(height, int(_field(pixels, DAVIS.y).max(initial=-1)) + 1)
    if most < 1 << 16:
        return DVS128, DVS128_PX if frame_px is None else checked_frame(frame_px, where, "")
    if frame_px is not None:
        return DAVIS, checked_frame(frame_px, where, "")
    fitting = [frame for frame in GUESSED_PX if width <= frame[0] and height <= frame[1]]
    if not fitting:
        found, hint = f"columns up to {width - 1}, rows up to {height - 1}", "give the frame with --frame-size"
        raise InputError("the addresses do not fit a DVS128 or DAVIS", where=where, found=found, hint=hint)
    return DAVIS, fitting[0]


def _words(path: Path, start: int) -> Iterator[NDArray[Any]]:
    with path.open("rb") as handle:
        handle.seek(start)
        while block := handle.read(BATCH_WORDS * WORD.itemsize):
            yield np.frombuffer(block[: len(block) // WORD.itemsize * WORD.itemsize], WORD)


def _field(address: NDArray[Any], place: tuple[int, int]) -> NDArray[np.int32]:
    shift, mask = place
    return ((address >> shift) & mask).astype(np.int32)


def _batches(path: Path, start: int, count: int, chip: Chip, source: EventSource) -> Iterator[EventColumns]:
    """Yield the events in blocks; at the end add left-out data and notes to `source`."""
    width, height = source.frame_px
    clock, done = Clock((BITS_32,), edges=(BITS_31,)), 0
    left_out = dict.fromkeys(("frame samples", "IMU values", "external events"), 0)
    for words in _words(path, start):
        times = clock.continuous(words["t"].astype(np.int64), partial(at_index, done))
        address = words["address"].astype(np.uint32)
        pixel = (address & np.uint32(chip.no_pixel)) == 0
        others = address[~pixel]
        sampled = (others & NO_PIXEL) > 0 if chip is DAVIS else np.zeros(len(others), bool)
        imu = sampled & ((others & IMU) == IMU)
        left_out["frame samples"] += int(np.count_nonzero(sampled & ~imu))
        left_out["IMU values"] += int(np.count_nonzero(imu))
        left_out["external events"] += int(np.count_nonzero(~sampled))
        t = times[pixel]
        x = width - 1 - _field(address[pixel], chip.x)
        y = height - 1 - _field(address[pixel], chip.y)
        p = (_field(address[pixel], (chip.polarity[0], 1)) == chip.polarity[1]).astype(np.uint8)
        rows = np.flatnonzero(pixel) + done
        yield EventColumns(t, x, y, p, partial(_place, rows))
        done += len(words)
    source.left_out |= {name: number for name, number in left_out.items() if number}
    source.notes += clock.notes


def _place(rows: NDArray[np.intp], row: int) -> str:
    return at_index(int(rows[row]), 0)


FORMAT = ImportFormat((b"#!AER-DAT2",), open_aedat2)
