"""Read events from AEDAT 2 files, of jAER and v2e: lines that begin with `#`, then words, big-endian.

    uint32 address, uint32 time in us
    DVS128    address bits 1-7 column, 8-14 row, 0 polarity (0 is brighter); above that: no pixel
    DAVIS     12-21 column, 22-30 row, 11 polarity (1 is brighter), 10 external input; bit 31: frame or IMU

Columns count from the right and rows from the bottom, as jAER's extractors and v2e's writer have it; here both are
turned round, so that (0, 0) is at the top left. The chip is the one that the line `AEChip` names, or else the one whose
addresses fit. iniVation's page says the opposite of the polarity of DVS128; jAER and dv-processing read it as here.
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
from evetac_cli.formats.read.event_validation import EventColumns, Foreign, at_index, checked_frame, choose_frame

SIGN = b"#!AER-DAT2"
WORD = np.dtype([("address", ">u4"), ("t", ">u4")])
BATCH_WORDS = 1 << 18
LINE_LIMIT_BYTES = 1 << 16
HEAD_LIMIT_BYTES = 1 << 24  # jAER writes all its settings there
NOT_TEXT = re.compile(rb"[^\t\r\n\x20-\xff]")
LAST_LINE = b"#End Of ASCII Header"
# DAVIS: words with bit 31 are samples of frames, or of the IMU where both of these bits are set
NO_PIXEL, EXTERNAL, IMU = 1 << 31, 1 << 10, 0b11 << 10


class Chip(NamedTuple):
    """How an address is read: shift and mask of column and row, shift of the polarity, and what it is when brighter."""

    name: str
    x: tuple[int, int]
    y: tuple[int, int]
    polarity: tuple[int, int]
    no_pixel: int  # bits that say that a word is no pixel


DVS128 = Chip("DVS128", (1, 0x7F), (8, 0x7F), (0, 0), 0xFFFF8000)
DAVIS = Chip("DAVIS", (12, 0x3FF), (22, 0x1FF), (11, 1), NO_PIXEL | EXTERNAL)
DVS128_PX = (128, 128)
DAVIS_PX = {"240": (240, 180), "346": (346, 260), "128": (128, 128), "208": (208, 192), "640": (640, 480)}
GUESSED_PX = (DAVIS_PX["240"], DAVIS_PX["346"], DAVIS_PX["640"])


def open_aedat2(path: Path, frame_px: tuple[int, int] | None) -> Foreign:
    """Events of an AEDAT 2 file; frame_px only for files that name no chip."""
    where = str(path)
    with path.open("rb") as handle:
        named, start = _head(handle, where)
    size = path.stat().st_size
    count, rest = divmod(size - start, WORD.itemsize)
    if named is None:
        chip, own_px = _guess_chip(path, start, frame_px, where)
    else:
        chip, own_px = named
    frame = choose_frame(own_px if named else None, frame_px or own_px, where)
    foreign = Foreign("aedat2", frame, ())
    foreign.assumed = ("" if named else f"a {chip.name} of {frame[0]}x{frame[1]}, by its addresses; ") + (
        f"columns from the right, rows from the bottom, polarity bit {chip.polarity[1]} brighter, time in microseconds"
    )
    if rest:
        foreign.notes.append(f"cut short: the last {rest} bytes are no whole event")
        foreign.cut_short = True
    foreign.batches = _batches(path, start, count, chip, foreign)
    return foreign


def _head(handle: BinaryIO, where: str) -> tuple[tuple[Chip, tuple[int, int]] | None, int]:
    """The chip that the head names, and where the words begin."""
    named = None
    start = 0
    while start <= HEAD_LIMIT_BYTES:
        line = handle.readline(LINE_LIMIT_BYTES)
        # Words may begin with the byte of `#`; lines of text hold no control characters.
        if not line.startswith(b"#") or NOT_TEXT.search(line):
            return named, start
        start += len(line)
        key, _, value = line.decode("latin-1").strip("# \t\r\n").partition(":")
        if key.strip() == "AEChip":
            named = _chip(value.strip(), where)
        if line.startswith(LAST_LINE):
            return named, start
    raise InputError("the head of the file does not end", where=where, found=f"more than {HEAD_LIMIT_BYTES:,} bytes")


def _chip(name: str, where: str) -> tuple[Chip, tuple[int, int]]:
    """The chip by the name of its Java class: `eu.seebetter.ini.chips.davis.DAVIS240C`."""
    last = name.rpartition(".")[2]
    davis = re.match("davis([0-9]{3})", last, re.IGNORECASE)
    if davis and davis[1] in DAVIS_PX:
        return DAVIS, DAVIS_PX[davis[1]]
    if re.match("dvs128|tmpdiff128", last, re.IGNORECASE):
        return DVS128, DVS128_PX
    known = ", ".join(["DVS128", *(f"DAVIS{size}" for size in DAVIS_PX)])
    raise InputError("recorded with a chip that is not read here", where=where, expected=known, found=last[:60])


def _guess_chip(path: Path, start: int, frame_px: tuple[int, int] | None, where: str) -> tuple[Chip, tuple[int, int]]:
    """The chip whose addresses are those of the file, and the frame that is asked for or the smallest that fits."""
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
        raise InputError(
            "addresses that no chip has which is read here",
            where=where,
            expected="a DVS128, or a DAVIS of up to 640x480",
            found=f"columns up to {width - 1}, rows up to {height - 1}",
            hint="--frame-size says the frame of another DAVIS",
        )
    return DAVIS, fitting[0]


def _words(path: Path, start: int) -> Iterator[NDArray[Any]]:
    with path.open("rb") as handle:
        handle.seek(start)
        while block := handle.read(BATCH_WORDS * WORD.itemsize):
            yield np.frombuffer(block[: len(block) // WORD.itemsize * WORD.itemsize], WORD)


def _field(address: NDArray[Any], place: tuple[int, int]) -> NDArray[np.int32]:
    shift, mask = place
    return ((address >> shift) & mask).astype(np.int32)


def _batches(path: Path, start: int, count: int, chip: Chip, foreign: Foreign) -> Iterator[EventColumns]:
    """The events in blocks; at the end `foreign` says what was left out."""
    width, height = foreign.frame_px
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
    foreign.left_out |= {name: number for name, number in left_out.items() if number}
    foreign.notes += clock.notes


def _place(rows: NDArray[np.intp], row: int) -> str:
    return at_index(int(rows[row]), 0)
