"""The stage files of a folder and its subfolders, a row for each, read from their headers.

Damaged files have the reason in their row; HDF5 files of other programs have no kind. A row takes some 3 ms.
"""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.errors import EvetacError, ForeignFile, InputError, shortened
from evetac_cli.store.layout.ancestry import recording_of, scene_words
from evetac_cli.text_files import as_utf8


class FileRow(NamedTuple):
    """The row of a file; a value is None if it does not exist for this kind of file, or if it is unknown."""

    path: str  # relative to the folder
    size_bytes: int = 0
    kind: str | None = None  # None for an unreadable file, or one of another program
    recipe_id: str | None = None
    recording: str | None = None  # recipe id of the only recording from which it was made, or which it is
    object: int | str | None = None
    sensor: str | None = None
    seed: int | str | None = None
    trial: int | None = None
    scene: str | None = None
    outcome: str | None = None  # slips, held; for a grasp: dropped, lifted, balanced
    slices: int | None = None
    simulated: bool | None = None
    error: str | None = None  # reason why the file cannot be read


Progress = Callable[[int, int], None]


def read_data_set(folder: Path, progress: Progress = lambda done, total: None) -> list[FileRow]:
    """Return the rows of all stage files in a folder, sorted by path; InputError if it is not a folder."""
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder), expected="a folder of stage files")
    names = sorted(_stage_files(folder))
    rows = []
    for number, name in enumerate(names):
        progress(number, len(names))
        rows.append(describe(folder, name))
    return rows


def foreign_files(rows: list[FileRow]) -> list[str]:
    """Return the paths of the HDF5 files of other programs, which are skipped."""
    return [row.path for row in rows if row.kind is None and row.error is None]


def foreign_note(rows: list[FileRow]) -> str:
    """Return a note with the number of files of other programs; empty if there are none."""
    names = foreign_files(rows)
    if not names:
        return ""
    several = f"s of other programs ({names[0]}, ...)" if len(names) > 1 else f" of another program ({names[0]})"
    return f"skipped: {len(names):,} HDF5 file{several}"


def _stage_files(folder: Path) -> list[str]:
    """Return the paths of all stage files below a folder, without hidden ones and recordings in progress."""
    found = []
    for place, folders, files in os.walk(folder):
        folders[:] = [
            name
            for name in folders
            if not name.startswith(".") and not name.endswith(".part") and not Path(place, name).is_symlink()
        ]
        names = [name for name in files if name.endswith(".h5") and not name.startswith(".")]
        found += [str(Path(place, name).relative_to(folder)) for name in names]
    return found


def describe(folder: Path, name: str) -> FileRow:
    """Return the row of a file; an unreadable file has its reason, one of another program neither kind nor reason."""
    from evetac_cli.store.files import StageFile

    size_bytes = 0
    try:
        size_bytes = (folder / name).stat().st_size
        with StageFile(folder / name) as file:
            return FileRow(name, size_bytes, **_figures(file))
    except ForeignFile:
        return FileRow(name, size_bytes)
    except EvetacError as error:
        reason = f"{error.message}: {error.found}" if error.found else error.message
        return FileRow(name, size_bytes, error=reason)
    except (OSError, MemoryError) as error:
        return FileRow(name, size_bytes, error=str(error) or type(error).__name__)


def _figures(file: Any) -> dict[str, Any]:
    header = file.header
    recording: dict[str, Any] = recording_of(header, header["history"]) or {}
    parameters = recording.get("parameters", {})
    seed = recording.get("seed") if recording else header["seed"]
    trial = _plain(parameters.get("trial"))
    return {
        "kind": file.kind,
        "recipe_id": header["id"],
        "recording": _plain(recording.get("id")),
        "object": _plain(parameters.get("object")),
        "sensor": _plain(parameters.get("sensor")) or _sensor_name(file),
        "seed": _plain(seed),
        "trial": trial if isinstance(trial, int) else None,
        "scene": _plain(scene_words(parameters, "name")),
        "outcome": _outcome(file),
        "slices": _slices(file),
        "simulated": header["simulated"],
    }


def _plain(value: Any) -> Any:
    """Return a whole number or a text; None for anything else. Tables cannot hold numbers of more than 64 bits."""
    if isinstance(value, int) and not isinstance(value, bool):
        return value if abs(value) < 2**63 else str(value)
    return shortened(as_utf8(value)) if isinstance(value, str) else None


def _sensor_name(file: Any) -> str | None:
    return _plain(file.read("sensor/name")) if file.kind == "recording" else None


def _outcome(file: Any) -> str | None:
    """Return whether the object slipped, by labels or a simulation's truth, or the outcome of a grasp."""
    if file.has("control/outcome"):
        try:
            figures = json.loads(file.read("control/outcome"))
            return "balanced" if figures["balanced"] else "lifted" if figures["lifted"] else "dropped"
        except (ValueError, KeyError, TypeError):
            return None
    if file.has("onset_slice"):
        return "slips" if int(file.read("onset_slice")) >= 0 else "held"
    if file.has("truth/slip"):
        return "slips" if file.read("truth/slip").any() else "held"
    return None


_BY_SLICE = {"recording": "ms_to_idx", "labels": "label", "tracks": "dot_xy_px", "features": "events_total"}


def _slices(file: Any) -> int | None:
    if file.kind not in _BY_SLICE:
        return None
    rows: int = file.length(_BY_SLICE[file.kind])
    return rows - 1 if file.kind == "recording" else rows
