"""Recovery of an interrupted recording from NAME.part/: which segments are whole, and where the gaps are.

The slice index is the clock, so an unreadable segment becomes a gap in time. Its slices are empty and are listed in
`capture/lost_slices`; everything after it keeps its time. Only a recording with a simulation's truth ends before its
first gap, because truth has no empty value, and such a recording can be simulated again.
"""

import fcntl
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, SLICES_PER_S, Events
from evetac_cli.store.hdf5.checked_hdf5 import DAMAGE, CheckedHdf5, row_blocks
from evetac_cli.store.hdf5.disk import open_lock
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.part_folder import JOINED, LATE, LOCK, SEGMENT, STATIC
from evetac_cli.store.recordings.segments import COUNTS, CRC, FIRST_SLICE, RECIPE
from evetac_cli.text_files import SEED_BITS, parse_json

SUFFIX = ".part"
# `record` lasts at most a day. Every slice has a row, so a damaged number must not cause billions of empty rows.
LONGEST_SLICES = 25 * 3600 * SLICES_PER_S
LARGEST_PX = 65535  # largest value of an event's uint16
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
    if not path.exists():
        raise InputError("no such file", where=str(path), expected=LEFTOVER)
    if not path.is_dir():
        raise InputError("not the folder of an interrupted recording", where=str(path), expected=LEFTOVER)
    if path.is_symlink():
        raise InputError("this is a link", where=str(path), expected="the folder itself")


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock the folder against recorders; InputError if one is using it."""
    check_folder(folder)
    try:
        lock = open_lock(folder / LOCK)
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
    """Return the path of the recording for a left-over folder."""
    return folder.with_name(folder.name.removesuffix(SUFFIX) + ".h5")


def was_joined(folder: Path) -> bool:
    """Whether the recording is complete and only its folder was not removed."""
    return (folder / JOINED).exists()


def read_leftover(folder: Path) -> Leftover:
    """Check every segment; InputError if the data from the start cannot be read, so that nothing can be recovered."""
    recipe, frame = _known_at_start(folder)
    leftover = Leftover(recipe)
    numbered = _segments(folder, leftover)
    row_shapes: dict[str, tuple[int, ...]] = {}
    bridging = True
    following = 0
    for number, path in sorted(numbered.items()):
        if number > following:
            several = f" to {number - 1:06d} are" if number > following + 1 else ": is"
            leftover.unreadable.append(f"{following:06d}{several} missing")
        following = number + 1
        try:
            segment = _checked(path, frame, row_shapes)
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
    recording_schema = schema.load("recording")
    late: dict[str, Any] = {}
    try:
        with _opened(path) as file:
            for name, dataset in file.datasets().items():
                _check_bytes(file, name, dataset)
                if recording_schema.find(name) is None:
                    raise ValueError(f"{name} is unknown")
                is_text = schema.describe_stored(dataset) == "utf8"
                late[name] = file.text(name, dataset.id) if is_text else dataset[()]
    except (InputError, *DAMAGE):
        return {}
    return late


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


def _known_at_start(folder: Path) -> tuple[Recipe, tuple[int, int]]:
    """Return the recipe with which the recording began, and its frame in px; InputError if they cannot be read."""
    path = folder / STATIC
    try:
        try:
            with _opened(path) as static:
                text = static.text_attribute(RECIPE)
                datasets = static.datasets()
                for name, dataset in datasets.items():
                    _check_bytes(static, name, dataset)
                frame = datasets["sensor/frame_px"][:2].tolist() if "sensor/frame_px" in datasets else []
        except InputError as error:
            raise ValueError(_reason(error)) from None
        if text is None:
            raise InputError(
                "it has no recipe of the recording",
                where=str(folder),
                hint=PLAIN,
            )
        recording_schema = schema.load("recording")
        unknown = [name for name in datasets if recording_schema.find(name) is None]
        if unknown:
            raise InputError(
                "recorded by another version of evetac and cannot be joined",
                where=str(folder),
                expected=f"datasets of recording version {recording_schema.version}",
                found=", ".join(unknown)[:200],
                hint=PLAIN,
            )
        if len(frame) != 2 or not all(1 <= size <= LARGEST_PX for size in frame):
            raise ValueError(f"sensor/frame_px is {frame or 'missing'}")
        recipe = parse_json(text, whole_bits=SEED_BITS)
        start_recipe = Recipe(**{**recipe, "parents": tuple(recipe["parents"])})
        if (
            start_recipe.kind != "recording" or start_recipe.header()["kind"] != "recording"
        ):  # also checks that a header can be made
            raise ValueError(f"the recipe is of another kind, {str(start_recipe.kind)[:60]!r}")
    except (*DAMAGE, AttributeError) as error:
        message = f"the data from the start of the recording cannot be read: {error}"
        raise InputError(message, where=str(path), hint=PLAIN) from None
    return start_recipe, (frame[0], frame[1])


@contextmanager
def _opened(path: Path) -> Iterator[CheckedHdf5]:
    """Open a file of the folder; ValueError for a link, since a recorder writes only regular files."""
    if path.is_symlink():
        raise ValueError("is a link, which no recorder writes")
    with CheckedHdf5(path) as file:
        yield file


def _check_bytes(file: CheckedHdf5, name: str, dataset: h5py.Dataset) -> None:
    """Raise ValueError if the bytes of a dataset are not those that were written."""
    stored = file.number_attribute(CRC, name)
    if stored is None or schema.describe_stored(dataset) == "utf8":
        return
    now = 0
    for rows in row_blocks(dataset) if dataset.shape else [dataset[()]]:
        now = zlib.crc32(np.ascontiguousarray(rows).tobytes(), now)
    if now != stored:
        raise ValueError(f"{name} was damaged")


def _checked(path: Path, frame: tuple[int, int], row_shapes: dict[str, tuple[int, ...]]) -> _Segment:
    """Check a segment, block by block; ValueError if it is not as a recorder writes it.

    row_shapes: shapes of rows of each dataset in earlier segments; those of this one are added.
    """
    with _opened(path) as file:
        first = file.number_attribute(FIRST_SLICE)
        datasets = file.datasets()
        shapes = _row_shapes(datasets, row_shapes)
        for name, dataset in datasets.items():
            _check_bytes(file, name, dataset)
        counts = datasets[COUNTS][()]
        if first is None or first < 0 or first + len(counts) > LONGEST_SLICES:
            raise ValueError(f"its first slice is {first}, and it has {len(counts)}")
        _check_events([datasets[f"events/{name}"] for name in Events._fields], counts, first, frame)
        table = schema.load("recording")
        described = {name: table.find(name) for name in datasets if name != COUNTS}
        every_slice = [
            name for name, row in described.items() if row is not None and (row.dims or ())[:1] == ("slices",)
        ]
        if any(len(datasets[name]) != len(counts) for name in every_slice):
            raise ValueError("the number of its rows differs from that of its slices")
        gripper_rows = len(datasets["gripper/t_us"]) if "gripper/t_us" in datasets else 0
        row_shapes.update(shapes)
        return _Segment(
            path,
            first,
            len(counts),
            len(datasets["events/t"]),
            gripper_rows,
            all(name == "control/probability" for name in every_slice),
        )


def _row_shapes(datasets: dict[str, h5py.Dataset], before: dict[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
    """Return the shape of a row of each dataset; ValueError for a dataset that does not fit a recording."""
    missing = [name for name in (COUNTS, *(f"events/{name}" for name in Events._fields)) if name not in datasets]
    if missing:
        raise ValueError(f"{missing[0]} is missing, or is not a dataset")
    table = schema.load("recording")
    shapes = {}
    for name, dataset in datasets.items():
        row = table.find(name)
        dtype, dims = ("int64", 1) if name == COUNTS else (row.dtype, len(row.dims or ())) if row else ("", 0)
        shape = dataset.shape
        if not dims or schema.describe_stored(dataset) != dtype or shape is None or len(shape) != dims:
            raise ValueError(f"{name} does not fit a recording: {schema.describe_stored(dataset)} of shape {shape}")
        shapes[name] = shape[1:]
        if before.get(name, shape[1:]) != shape[1:]:
            raise ValueError(f"{name} has rows of shape {shape[1:]}, but earlier rows have {before[name]}")
    return shapes


def _check_events(columns: list[h5py.Dataset], counts: NDArray[np.int64], first: int, frame: tuple[int, int]) -> None:
    """Raise ValueError unless the columns have the counted length, and each event is in its slice and in the frame."""
    events = len(columns[0])
    fits = not len(counts) or (counts.min() >= 0 and counts.max() <= events)
    if not fits or {len(column) for column in columns} != {int(counts.sum())}:
        raise ValueError("the length of its columns differs from its counts")
    ends = np.cumsum(counts)
    done, last = 0, -1
    for t in row_blocks(columns[0]):
        rows = slice(done, done + len(t))
        x, y, p = (column[rows] for column in columns[1:])
        in_slice = first + np.searchsorted(ends, np.arange(rows.start, rows.stop), side="right")
        if len(t) and (t[0] < last or (np.diff(t) < 0).any() or (t // SLICE_US != in_slice).any()):
            raise ValueError("its events are not in its slices")
        if (x >= frame[0]).any() or (y >= frame[1]).any() or (p > 1).any():
            raise ValueError("it has impossible events")
        done, last = rows.stop, int(t[-1]) if len(t) else last
