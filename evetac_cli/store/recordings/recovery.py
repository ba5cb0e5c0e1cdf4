"""Recovery of an interrupted recording from NAME.part/: which segments are whole, and where the gaps are.

The slice index is the clock, so an unreadable segment becomes a gap in time. Its slices are empty and are listed in
`capture/lost_slices`; everything after it keeps its time. Only a recording with a simulation's truth ends before its
first gap, because truth has no empty value, and such a recording can be simulated again.
"""

import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.events import SLICES_PER_S
from evetac_cli.store.hdf5.checked_hdf5 import DAMAGE, CheckedHdf5, row_blocks
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.segments import (
    COUNTS,
    CRC,
    FIRST_SLICE,
    JOINED,
    LATE,
    RECIPE,
    SEGMENT,
    STATIC,
    locked_part,
    whole_datasets,
)
from evetac_cli.text_files import SEED_BITS, parse_json

SUFFIX = ".part"
# `record` lasts at most a day. Every slice has a row, so a damaged number must not cause billions of empty rows.
LONGEST_SLICES = 25 * 3600 * SLICES_PER_S
PLAIN = "the segments next to it are plain HDF5 files with events/t, x, y, p, events_per_slice"
LEFTOVER = f"a folder NAME.recording{SUFFIX}, or one that contains some"


@dataclass
class Leftover:
    """The segments in a folder that can be joined, and the slices lost between them."""

    recipe: Recipe
    parts: list[Path | int] = field(default_factory=list)  # segments, and numbers of lost slices between them
    lost: list[tuple[int, int]] = field(default_factory=list)  # slices [first, end) of the gaps
    slices: int = 0  # including gaps
    events: int = 0
    gripper_rows: int = 0
    unreadable: list[str] = field(default_factory=list)  # segments, with the fault of each
    left_out: int = 0  # whole segments after a gap that could not be bridged
    late: dict[str, Any] = field(default_factory=dict)  # datasets known only at the end, if nothing is missing


def check_folder(path: Path) -> None:
    """Raise InputError unless the path is a folder."""
    if not path.is_dir():
        message = "not the folder of an interrupted recording" if path.exists() else "no such file"
        raise InputError(message, where=str(path), expected=LEFTOVER)


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock the folder against recorders; InputError if one is using it."""
    check_folder(folder)
    try:
        lock = locked_part(folder)
    except OSError as error:
        raise InputError(f"cannot be written to: {error.strerror}", where=str(folder)) from None
    with lock:
        yield


def recording_path(folder: Path) -> Path:
    """Return the path of the recording for a left-over folder."""
    return folder.with_name(folder.name.removesuffix(SUFFIX) + ".h5")


def was_joined(folder: Path) -> bool:
    """Whether the recording is complete and only its folder was not removed."""
    return (folder / JOINED).exists()


def read_leftover(folder: Path) -> Leftover:
    """Check every segment; InputError if the data from the start cannot be read, so that nothing can be recovered."""
    leftover = Leftover(_recipe_at_start(folder / STATIC))
    numbered = _segments(folder, leftover)
    bridging = True
    following = 0
    for number, path in sorted(numbered.items()):
        if number > following:
            several = f" to {number - 1:06d} are" if number > following + 1 else ": is"
            leftover.unreadable.append(f"{following:06d}{several} missing")
        following = number + 1
        try:
            segment = _checked(path)
            if segment.first < leftover.slices:
                raise ValueError(f"starts at slice {segment.first}, before the end of the one before it")
        except (InputError, *DAMAGE) as error:
            leftover.unreadable.append(f"{number:06d}: {_reason(error)}")
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
    if not leftover.unreadable and not leftover.lost and (folder / LATE).exists():
        leftover.late = _known_at_end(folder / LATE)
    return leftover


def _known_at_end(path: Path) -> dict[str, Any]:
    """Return the datasets from the end of a recording that is to be joined later; empty if they cannot be read."""
    try:
        with CheckedHdf5(path) as file:
            _check_bytes(file)
            return whole_datasets(file)
    except (InputError, *DAMAGE):
        return {}


@dataclass(frozen=True)
class _Segment:
    path: Path
    first: int
    slices: int
    events: int
    gripper_rows: int
    may_follow_a_gap: bool


def _segments(folder: Path, leftover: Leftover) -> dict[int, Path]:
    """Return the segments by their number; files with similar names are listed as unreadable."""
    numbered: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):  # .h5 before .tmp
        match = re.fullmatch(SEGMENT, path.name)
        if match and path.stem == f"{int(match[1]):06d}":
            numbered.setdefault(int(match[1]), path)
        elif path.name[0].isdigit():
            leftover.unreadable.append(f"{path.name}: is not the name of a segment")
    return numbered


def _reason(error: Exception) -> str:
    """Return the fault of a segment, in one line and without its path, which follows from its number."""
    if isinstance(error, InputError):
        return ", ".join([error.message, *([f"found {error.found}"] if error.found else [])])
    return str(error)


def _recipe_at_start(path: Path) -> Recipe:
    """Return the recipe with which the recording began; InputError if it, or the data known then, cannot be read."""
    try:
        with CheckedHdf5(path) as static:
            _check_bytes(static)
            text = static.text_attribute(RECIPE)
        if text is None:
            raise ValueError("it has no recipe of the recording")
        recipe = parse_json(text, whole_bits=SEED_BITS)
        start_recipe = Recipe(**{**recipe, "parents": tuple(recipe["parents"])})
        start_recipe.header()  # checks that one can be made
    except (InputError, *DAMAGE, AttributeError) as error:
        message = f"the data from the start of the recording cannot be read: {_reason(error)}"
        raise InputError(message, where=str(path), hint=PLAIN) from None
    return start_recipe


def _check_bytes(file: CheckedHdf5) -> dict[str, h5py.Dataset]:
    """Return the datasets of a file; ValueError if the bytes of one are not those that were written."""
    datasets = file.datasets()
    for name, dataset in datasets.items():
        if schema.describe_stored(dataset) == "utf8":
            continue
        now = 0
        for rows in row_blocks(dataset) if dataset.shape else [dataset[()]]:
            now = zlib.crc32(np.ascontiguousarray(rows).tobytes(), now)
        if now != file.number_attribute(CRC, name):
            raise ValueError(f"{name} was damaged")
    return datasets


def _checked(path: Path) -> _Segment:
    """Check a segment, block by block; ValueError if it is not as a recorder wrote it."""
    with CheckedHdf5(path) as file:
        datasets = _check_bytes(file)
        first, slices = file.number_attribute(FIRST_SLICE), len(datasets[COUNTS])
        if first is None or first < 0 or first + slices > LONGEST_SLICES:
            raise ValueError(f"its first slice is {first}, and it has {slices}")
        described = {name: schema.load("recording").find(name) for name in datasets if name != COUNTS}
        every_slice = [name for name, row in described.items() if row and (row.dims or ())[:1] == ("slices",)]
        return _Segment(
            path,
            first,
            slices,
            len(datasets["events/t"]),
            len(datasets["gripper/t_us"]) if "gripper/t_us" in datasets else 0,
            all(name == "control/probability" for name in every_slice),
        )
