"""validate: check stage files against their schema, their own numbers, their header and their recipe id."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from evetac_cli.console import print_table
from evetac_cli.errors import EvetacError, InputError, UnavailableError
from evetac_cli.jobs import Outcome, Progress, silent
from evetac_cli.store.files import StageFile, header_of
from evetac_cli.store.layout import contents, rules
from evetac_cli.store.layout.provenance import ContentDigest, history_fault
from evetac_cli.store.recordings.read import Recording

OF_A_TRIAL = ("labels", "tracks", "features", "touch")  # kinds stored beside their recording, under its name
EVENTS = 1 << 18  # read at once


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


def show(result: Outcome) -> None:
    """Print the rows as a table."""
    print_table("validate", result.rows, result.summary, simulated=result.simulated)


def _faults(file: StageFile) -> list[str]:
    """Return all faults of a file that could be opened, and so has the right datasets, dtypes and shapes."""
    if fault := history_fault(file.stored_header):
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
