"""repair: make a valid recording from the segments that an interrupted recording left."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.console import print_table
from evetac_cli.errors import InputError, UnavailableError
from evetac_cli.inspect import validate
from evetac_cli.jobs import Outcome, Progress, silent
from evetac_cli.store.hdf5.checked_hdf5 import DAMAGE
from evetac_cli.store.hdf5.disk import remove_unfinished
from evetac_cli.store.recordings.recovery import (
    SUFFIX,
    Leftover,
    check_folder,
    lock_folder,
    read_leftover,
    recording_path,
    was_joined,
)
from evetac_cli.store.recordings.segments import join, remove_parts

ENDED = "broke off, and was repaired"


def run(folders: list[Path], progress: Progress = silent) -> Outcome:
    """Repair every left-over folder; return a row for each with what was kept and lost, or its fault.

    Folders are removed last.
    """
    rows: list[dict[str, Any]] = []
    simulated = False
    leftovers = _leftovers(folders)
    for number, folder in enumerate(leftovers):
        progress(number, len(leftovers))
        try:
            row, from_simulation = _repair(folder)
        except (InputError, UnavailableError, *DAMAGE) as error:  # for example a disk that fails during joining
            fault = " ".join(str(error).split()) or type(error).__name__
            row, from_simulation = _row(folder, "not repaired", fault=fault), False
        rows.append(row)
        simulated |= from_simulation
    return Outcome(rows, simulated, {"folders": len(rows), "invalid": sum(row["fault"] is not None for row in rows)})


def show(result: Outcome) -> None:
    """Print the rows as a table."""
    print_table("repair", result.rows, result.summary, simulated=result.simulated)


def _leftovers(folders: list[Path]) -> list[Path]:
    """Return the folders NAME.recording.part among the given folders, or inside them."""
    leftovers = []
    for folder in folders:
        if folder.name.endswith(SUFFIX):  # a missing folder gets its own row, like the others
            leftovers.append(folder)
        else:
            check_folder(folder)
            leftovers += sorted(path for path in folder.glob(f"*{SUFFIX}") if path.is_dir())
    return leftovers


def _repair(folder: Path) -> tuple[dict[str, Any], bool]:
    """Join the readable segments, validate the result, and only then remove the folder."""
    output = recording_path(folder)
    with lock_folder(folder):
        if was_joined(folder):
            _check(output)
            return _row(folder, "was complete", unexpected=remove_parts(folder)), False
        left = read_leftover(folder)
        if not left.parts:
            raise InputError(
                "no slice of this recording can be read",
                where=str(folder),
                found="; ".join(left.unreadable) or "no segment",
            )
        if output.exists():
            raise InputError(
                "the recording already exists, so its segments were not joined",
                where=str(output),
                hint=f"move {output.name} away and repair again, or remove {folder.name}",
            )
        late: dict[str, Any] = {"capture/ended": ENDED, **left.late}
        if left.lost:
            late["capture/lost_slices"] = np.array(left.lost, np.int64)
        join(folder, output, left.recipe, late, left.parts)
        try:
            _check(output)
        except InputError:
            output.unlink()
            raise
        remove_unfinished(output)  # left by a recorder that was killed while it joined segments
        unexpected = remove_parts(folder)
    return _row(folder, "repaired", left, unexpected=unexpected), left.recipe.simulated


def _check(output: Path) -> None:
    """Validate the result like `evetac validate`; raise InputError with its faults, UnavailableError if impossible."""
    (row,) = validate.run([output]).rows
    if row["not_checked"] is not None:
        raise UnavailableError(
            "the repaired recording could not be checked", where=str(output), found=str(row["not_checked"])
        )
    if row["faults"] is not None:
        raise InputError("the repaired recording is not valid", where=str(output), found=str(row["faults"]))


def _row(
    folder: Path, status: str, left: Leftover | None = None, *, fault: str | None = None, unexpected: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the row of one folder; the amount missing at the end of the recording is unknown.

    unexpected: files that no recorder wrote, which were left in the folder.
    """
    return {
        "output": str(recording_path(folder)),
        "status": status,
        "slices_kept": None if left is None else left.slices - sum(end - first for first, end in left.lost),
        "slices_lost": None if left is None else sum(end - first for first, end in left.lost),
        "events_kept": None if left is None else left.events,
        "gripper_rows_kept": None if left is None else left.gripper_rows,
        "segments_unreadable": None if left is None else len(left.unreadable),
        "segments_left_out": None if left is None else left.left_out,
        "unreadable": None if left is None else "; ".join(left.unreadable) or None,
        "left_in_folder": ", ".join(unexpected) or None,
        "fault": fault,
    }
