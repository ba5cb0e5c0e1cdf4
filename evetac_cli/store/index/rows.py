"""The rows of the index: the properties of a file."""

import json
import os
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.errors import EvetacError, ForeignFile, shortened
from evetac_cli.store.layout.ancestry import recording_of, scene_words
from evetac_cli.text_files import as_utf8


class Seen(NamedTuple):
    """File status that identifies an unchanged file; zeros for a missing file.

    Two files of a folder have different inodes, and the time of change (ctime) cannot be set. So a file with the same
    three values is unchanged. The only exception is a change in place, to the same size, within the tick of the
    storage's clock (4 ms on Linux) in which the status was read.
    """

    size_bytes: int
    changed_ns: int
    inode: int

    @classmethod
    def of(cls, status: os.stat_result) -> "Seen":
        """Return the part of a file status that identifies an unchanged file."""
        return cls(status.st_size, status.st_ctime_ns, status.st_ino)


NOT_THERE = Seen(0, 0, 0)


class IndexRow(NamedTuple):
    """The row of a file; a value is None if it does not exist for this kind of file, or if it is unknown."""

    path: str  # relative to the folder
    size_bytes: int
    changed_ns: int
    inode: int
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
    dot_radius_px: float | None = None  # of a recording's grid of dots
    grid: str | None = None  # hash of that grid, as in a recipe
    error: str | None = None  # reason why the file cannot be read

    @property
    def seen(self) -> Seen:
        """The status of the file when it was read."""
        return Seen(self.size_bytes, self.changed_ns, self.inode)


def describe(folder: Path, name: str, size_bytes: int, changed_ns: int, inode: int) -> IndexRow:
    """Return the row of a file; an unreadable file has its reason, one of another program neither kind nor reason.

    The whole file is checked, because a row is later trusted without another check.
    """
    from evetac_cli.store.files import StageFile

    seen = Seen(size_bytes, changed_ns, inode)
    try:
        with StageFile(folder / name) as file:
            file.check()
            return IndexRow(name, *seen, **_figures(file))
    except ForeignFile:
        return IndexRow(name, *seen)
    except EvetacError as error:
        reason = f"{error.message}: {error.found}" if error.found else error.message
        return IndexRow(name, *seen, error=reason)
    except (OSError, MemoryError) as error:
        return IndexRow(name, *seen, error=str(error) or type(error).__name__)


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
        **_dots(file),
    }


def _dots(file: Any) -> dict[str, Any]:
    """Return the values of a recording's dots that are part of the recipe of tracks, if it has dots."""
    if file.kind != "recording" or not file.has("sensor/dot_xy_px"):
        return {}
    from evetac_cli.store.calibration import stored_calibration

    calibration = stored_calibration(file)
    return {"dot_radius_px": calibration.dot_radius_px, "grid": calibration.digest()}


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
