"""What a recording that broke off left in NAME.part/: which segments are whole, and where the gaps are.

Why so: the slice index is the clock, so a segment that cannot be read stays a gap in time. Its slices are empty and
are named in `capture/lost_slices`; everything after it keeps its moment. Only a recording with the truth of a
simulation ends before its first gap, because a truth has no empty value, and such a recording can be made again.
"""

import fcntl
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.store import schema
from evetac_cli.store.provenance import Recipe
from evetac_cli.store.segments import (
    COUNTS,
    CRC,
    FIRST_SLICE,
    JOINED,
    RECIPE,
    SEGMENTS,
    STATIC,
    checksum,
    dataset_paths,
)

SUFFIX = ".part"
LEFTOVER = f"a folder NAME.recording{SUFFIX}, or one that holds some"


@dataclass
class Leftover:
    """The segments in a folder that can be joined, and what is lost between them."""

    recipe: Recipe
    parts: list[Path | int] = field(default_factory=list)  # segments, and so many lost slices between them
    lost: list[tuple[int, int]] = field(default_factory=list)  # slices [first, end) of the gaps
    slices: int = 0  # gaps included
    events: int = 0
    gripper_rows: int = 0
    unreadable: list[str] = field(default_factory=list)  # segments, and what is wrong with each
    left_out: int = 0  # whole segments after a gap that could not be bridged


def check_folder(path: Path) -> None:
    """InputError unless the path is a folder."""
    if not path.exists():
        raise InputError("no such file", where=str(path), expected=LEFTOVER)
    if not path.is_dir():
        raise InputError("not what a recording left", where=str(path), expected=LEFTOVER)


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keep a recorder away from the folder; InputError if one is at work in it."""
    check_folder(folder)
    try:
        lock = open(folder / "lock", "a")  # noqa: SIM115 - held until the block ends
    except OSError as error:
        raise InputError(f"cannot be written to: {error.strerror}", where=str(folder)) from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise InputError("a recording is in progress here", where=str(folder), hint="end it first") from None
    else:
        yield
    finally:
        lock.close()


def recording_path(folder: Path) -> Path:
    """The file that a left-over folder was to become."""
    return folder.with_name(folder.name.removesuffix(SUFFIX) + ".h5")


def was_joined(folder: Path) -> bool:
    """Whether the recording is complete, and only its folder was not removed."""
    return (folder / JOINED).exists()


def read_leftover(folder: Path) -> Leftover:
    """Check every segment; InputError if what was known at the start cannot be read, and nothing can be made."""
    leftover = Leftover(_recipe(folder))
    frame = _frame(folder)
    numbered = {int(path.stem): path for path in folder.glob(SEGMENTS)}
    late = {int(path.stem): path for path in folder.glob("[0-9]*.tmp")}  # closed, perhaps, but not yet renamed
    bridging = True
    for number in range(max([*numbered, *late], default=-1) + 1):
        path = numbered.get(number, late.get(number))
        try:
            if path is None:
                raise ValueError("is missing")
            segment = _checked(path, frame)
            if segment.first < leftover.slices:
                raise ValueError(f"starts at slice {segment.first}, before the end of the one before it")
        except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
            leftover.unreadable.append(f"{number:06d}: {error}")
            continue
        gap = segment.first - leftover.slices
        bridging &= not gap or segment.may_follow_a_gap
        if not bridging:
            leftover.left_out += 1
            continue
        if gap:
            leftover.parts.append(gap)
            leftover.lost.append((leftover.slices, segment.first))
        leftover.parts.append(segment.path)
        leftover.slices = segment.first + segment.slices
        leftover.events += segment.events
        leftover.gripper_rows += segment.gripper_rows
    return leftover


@dataclass(frozen=True)
class _Segment:
    path: Path
    first: int
    slices: int
    events: int
    gripper_rows: int
    may_follow_a_gap: bool


def _recipe(folder: Path) -> Recipe:
    try:
        with h5py.File(folder / STATIC, "r") as static:
            names = list(_check_bytes(static))
            text = static.attrs.get(RECIPE)
        if text is None:
            raise InputError(
                "it does not say what was recorded",
                where=str(folder),
                hint="it was a simulation: run it again",
            )
        unknown = [name for name in names if schema.load("recording").find(name) is None]
        if unknown:
            raise InputError(
                "recorded by another version of evetac and cannot be joined",
                where=str(folder),
                expected=f"datasets of recording version {schema.load('recording').version}",
                found=", ".join(unknown),
                hint="the segments are plain HDF5 files: events/t, x, y, p, events_per_slice",
            )
        recipe = json.loads(str(text))
        return Recipe(**{**recipe, "parents": tuple(recipe["parents"])})
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise InputError(
            f"what was known at the start cannot be read: {error}",
            where=str(folder / STATIC),
            hint="the segments beside it are plain HDF5 files: events/t, x, y, p, events_per_slice",
        ) from None


def _frame(folder: Path) -> tuple[int, int]:
    with h5py.File(folder / STATIC, "r") as static:
        width, height = static["sensor/frame_px"][()].tolist()
    return int(width), int(height)


def _check_bytes(h5: h5py.File) -> dict[str, Any]:
    """All arrays of a file; ValueError if the bytes of one are not those that were written."""
    arrays = {}
    for name in dataset_paths(h5):
        value = h5[name][()]
        if CRC in h5[name].attrs and checksum(value) != int(h5[name].attrs[CRC]):
            raise ValueError(f"{name} was damaged")
        arrays[name] = value
    return arrays


def _checked(path: Path, frame: tuple[int, int]) -> _Segment:
    """Read a segment whole; ValueError if it is not what a recorder wrote."""
    with h5py.File(path, "r") as h5:
        first = int(h5.attrs[FIRST_SLICE])
        arrays = _check_bytes(h5)
    counts = arrays[COUNTS]
    columns = [arrays[f"events/{name}"] for name in Events._fields]
    t, x, y, p = columns
    if {len(column) for column in columns} != {int(counts.sum())}:
        raise ValueError("its columns are not as long as it says")
    in_slice = np.repeat(np.arange(first, first + len(counts)), counts)
    if (np.diff(t) < 0).any() or (t // SLICE_US != in_slice).any():
        raise ValueError("its events do not lie in its slices")
    if (x >= frame[0]).any() or (y >= frame[1]).any() or (p > 1).any():
        raise ValueError("it holds impossible events")
    table = schema.load("recording")
    described = {name: table.find(name) for name in arrays if name != COUNTS}
    every_slice = [name for name, row in described.items() if row is not None and row.dims and row.dims[0] == "slices"]
    if any(len(arrays[name]) != len(counts) for name in every_slice):
        raise ValueError("its rows are not as many as its slices")
    return _Segment(
        path,
        first,
        len(counts),
        len(t),
        len(arrays.get("gripper/t_us", ())),
        all(name == "control/probability" for name in every_slice),
    )
