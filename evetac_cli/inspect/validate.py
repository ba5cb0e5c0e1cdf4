"""validate: check stage files against their schema, their own numbers, their header and their recipe id.

With --repair: make valid recordings from the segments that interrupted ones left.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.console import print_table
from evetac_cli.errors import EvetacError, InputError, UnavailableError
from evetac_cli.jobs import LookCall, Outcome, Progress, silent
from evetac_cli.store.files import StageFile, header_of
from evetac_cli.store.hdf5.checked_hdf5 import DAMAGE
from evetac_cli.store.hdf5.disk import remove_unfinished
from evetac_cli.store.layout import contents, rules
from evetac_cli.store.layout.provenance import ContentDigest, history_fault
from evetac_cli.store.recordings.read import Recording
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

OF_A_TRIAL = ("labels", "tracks", "features", "touch")  # kinds stored beside their recording, under its name
EVENTS = 1 << 18  # read at once
ENDED = "broke off, and was repaired"


def look(call: LookCall) -> Outcome:
    """Check files, or repair folders of interrupted recordings."""
    if call.params.repair:
        return repair(call.paths, call.progress)
    return run(call.files(), call.progress)


def run(files: list[Path], progress: Progress = silent) -> Outcome:
    """Return a row for every file: whether it is valid, and its faults; both None if it cannot be read now."""
    rows: list[dict[str, Any]] = []
    simulated = False
    for number, path in enumerate(files):
        progress(number, len(files))
        kind, faults, why_not = None, list[str](), None
        try:
            with StageFile(path) as file:
                file.check()
                faults = _faults(file)
                kind = file.kind
                simulated |= bool(file.header["simulated"])
                faults += _relation_faults(file, files)
        except InputError as error:
            faults = [" ".join(str(error).split())]
        except UnavailableError as error:
            why_not = " ".join(str(error).split())
        valid = None if why_not else not faults
        faulty = "; ".join(faults) or None
        rows.append({"file": str(path), "kind": kind, "valid": valid, "faults": faulty, "not_checked": why_not})
    invalid, not_checked = (sum(row["valid"] is verdict for row in rows) for verdict in (False, None))
    return Outcome(rows, simulated, {"files": len(rows), "invalid": invalid, "not_checked": not_checked})


def show(result: Outcome, **_: Any) -> None:
    """Print the rows as a table."""
    print_table("validate", result.rows, result.summary, simulated=result.simulated)


def _faults(file: StageFile) -> list[str]:
    """Return all faults of a file that could be opened, and so has the right datasets, dtypes and shapes."""
    if fault := history_fault(file.header):
        return [fault]
    faults = list(contents.faults(file))
    if faults:
        return faults  # the checks below read the same values again
    check = _CHECKS.get(file.kind)
    try:
        return check(file) if check else []
    except InputError as error:
        return [" ".join(str(error).split())]


def _relation_faults(file: StageFile, files: list[Path]) -> list[str]:
    """Return a fault if a file was made from another recording than the one of its name among the files.

    A recording that was made from that one, for example by attaching a stream, is the same trial.
    """
    name, _, _ = file.path.name.rpartition(f".{file.kind}.")
    beside = file.path.with_name(f"{name}.recording.h5")
    if file.kind not in OF_A_TRIAL or beside not in files:
        return []
    try:
        header = header_of(beside, "recording")
    except EvetacError:  # reported in its own row
        return []
    if file.header["history"].keys() & {header["id"], *header["history"]}:
        return []
    return [f"made from another recording than {beside.name}: were files renamed, or was it recorded again?"]


def _recording(file: StageFile) -> list[str]:
    with Recording(file.path) as recording:
        for first in range(0, recording.event_count, EVENTS):
            last = min(first + EVENTS, recording.event_count)
            recording.check_slices(recording.read("events/t", first, last), first, last)
        if file.header["content"] is None:
            return []
        digest = ContentDigest()
        for name, (_, shape) in recording.contents().items():
            for values in rules.blocks(recording, name, shape):
                digest.update(name, values)
        fits = digest.hexdigest() == file.header["content"]
        return [] if fits else ["the arrays were changed: their digest is not the one in the header"]


def _model(file: StageFile) -> list[str]:
    from evetac_cli.stages.slip_detectors import check_checkpoints, load_detector

    load_detector(file)
    check_checkpoints(file)
    return []


_CHECKS: dict[str, Callable[[StageFile], list[str]]] = {
    "recording": _recording,
    "model": _model,
}


# Interrupted recordings


def repair(folders: list[Path], progress: Progress = silent) -> Outcome:
    """Repair every left-over folder; return a row for each with what was kept and lost, or its fault.

    Folders are removed last.
    """
    rows: list[dict[str, Any]] = []
    simulated = False
    leftovers = _leftovers(folders)
    for number, folder in enumerate(leftovers):
        progress(number, len(leftovers))
        try:
            row, from_simulation = _join_segments(folder)
        except (InputError, UnavailableError, *DAMAGE) as error:  # for example a disk that fails during joining
            fault = " ".join(str(error).split()) or type(error).__name__
            row, from_simulation = _row(folder, "not repaired", fault=fault), False
        rows.append(row)
        simulated |= from_simulation
    return Outcome(rows, simulated, {"folders": len(rows), "invalid": sum(row["fault"] is not None for row in rows)})


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


def _join_segments(folder: Path) -> tuple[dict[str, Any], bool]:
    """Join the readable segments, validate the result, and only then remove the folder."""
    output = recording_path(folder)
    with lock_folder(folder):
        if was_joined(folder):
            _require_valid(output)
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
            _require_valid(output)
        except InputError:
            output.unlink()
            raise
        remove_unfinished(output)  # left by a recorder that was killed while it joined segments
        unexpected = remove_parts(folder)
    return _row(folder, "repaired", left, unexpected=unexpected), left.recipe.simulated


def _require_valid(output: Path) -> None:
    """Validate the result like `evetac validate`; raise InputError with its faults, UnavailableError if impossible."""
    (row,) = run([output]).rows
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
