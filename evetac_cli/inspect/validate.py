"""validate: check stage files against their schema, their own numbers, their header and their recipe id."""

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np

from evetac_cli.console import print_table
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US
from evetac_cli.jobs import Outcome
from evetac_cli.resources import schemas
from evetac_cli.store.files import StageFile
from evetac_cli.store.provenance import ContentDigest, recompute_id
from evetac_cli.store.read import Recording

BLOCK = 2_000_000  # events that are read together
MAY_BE_NAN = (
    "relative_flow_px",
    "confidence",
    "gripper/current_target_ma",
    "control/x_ref_ticks",
    "control/probability",
    "control/latency_us",
    "sensor/dot_xy_px",
    "dot_xy_px",
)


def run(files: list[Path]) -> Outcome:
    """A row for every file: whether it is valid, and its faults."""
    rows: list[dict[str, Any]] = []
    simulated = False
    for path in files:
        try:
            with StageFile(path) as file:
                faults = _faults(file)
                kind = file.kind
                simulated |= bool(file.header["simulated"])
        except InputError as error:
            kind, faults = None, [" ".join(str(error).split())]
        rows.append({"file": str(path), "kind": kind, "valid": not faults, "faults": "; ".join(faults) or None})
    return Outcome(rows, simulated, {"files": len(rows), "invalid": sum(not row["valid"] for row in rows)})


def show(result: Outcome) -> None:
    """Print the rows as a table."""
    print_table("validate", result.rows, result.summary, simulated=result.simulated)


def _faults(file: StageFile) -> list[str]:
    """All faults of a file that could be opened, and so has the right datasets, dtypes and shapes."""
    faults = []
    rules = json.loads((schemas() / "header.v1.json").read_text())
    violation = jsonschema.exceptions.best_match(jsonschema.Draft202012Validator(rules).iter_errors(file.header))
    if violation is not None:
        return [f"header: {violation.message}"]
    for id_, ancestor in file.header["history"].items():
        if ancestor.get("id") != id_ or recompute_id(ancestor) != id_:
            faults.append(f"the history of {id_[:12]} was edited")
    missing = [parent[:12] for parent in file.header["parents"] if parent not in file.header["history"]]
    if missing:
        faults.append(f"the history lacks the parents {', '.join(missing)}")
    for name, (dtype, _) in file.contents().items():
        floats = dtype != "utf8" and np.dtype(dtype).kind == "f"
        if floats and name not in MAY_BE_NAN and not all(np.isfinite(part).all() for part in _parts(file, name)):
            faults.append(f"{name} holds values that are not finite")
    check = _CHECKS.get(file.kind)
    try:
        return faults + (check(file) if check else [])
    except InputError as error:
        return [*faults, " ".join(str(error).split())]


def _parts(file: StageFile, name: str) -> Iterator[Any]:
    """A dataset in parts of some BLOCK numbers."""
    _, shape = file.contents()[name]
    if not shape:
        yield file.read(name)
        return
    rows = max(BLOCK // max(math.prod(shape[1:]), 1), 1)
    for first in range(0, max(shape[0], 1), rows):
        yield file.read(name, first, first + rows)


def _recording(file: StageFile) -> list[str]:
    faults = []
    with Recording(file.path) as recording:
        starts = recording.starts
        width, height = recording.frame_px
        previous = 0
        for first in range(0, recording.event_count, BLOCK):
            last = min(first + BLOCK, recording.event_count)
            t, x, y, p = (recording.read(f"events/{column}", first, last) for column in "txyp")
            if t[0] < previous or (np.diff(t) < 0).any():
                faults.append("events/t goes backwards")
            in_slice = np.searchsorted(starts, np.arange(first, last), side="right") - 1
            if (t // SLICE_US != in_slice).any():
                faults.append("ms_to_idx does not fit events/t")
            if (x >= width).any() or (y >= height).any():
                faults.append("events lie outside the frame")
            if (p > 1).any():
                faults.append("events/p is neither 0 nor 1")
            previous = int(t[-1])
            if faults:
                break
        if file.header["content"] is not None and not faults:
            digest = ContentDigest()
            for name in recording.contents():
                for part in _parts(recording, name):
                    digest.update(name, part)
            if digest.hexdigest() != file.header["content"]:
                faults.append("the arrays are not those that the header was made for")
    return faults


def _labels(file: StageFile) -> list[str]:
    label, onset = file.read("label"), int(file.read("onset_slice"))
    faults = []
    if not np.isin(label, (-1, 0, 1)).all():
        faults.append("label holds values other than -1, 0, 1")
    slips = np.flatnonzero(label == 1)
    if onset != (int(slips[0]) if len(slips) else -1):
        faults.append("onset_slice is not the first slice of slip")
    return faults


def _model(file: StageFile) -> list[str]:
    from evetac_cli.kernels.slip.architectures import ARCHITECTURES
    from evetac_cli.kernels.slip.detector import Detector

    name = file.read("architecture")
    if name not in ARCHITECTURES:
        return [f"unknown architecture {name}"]
    try:
        Detector(file.read("onnx").tobytes(), ARCHITECTURES[name])
    except ValueError as error:
        return [str(error)]
    return []


def _report(file: StageFile) -> list[str]:
    try:
        json.loads(file.read("rows"))
        json.loads(file.read("summary"))
    except ValueError:
        return ["rows or summary is not JSON"]
    return []


_CHECKS: dict[str, Callable[[StageFile], list[str]]] = {
    "recording": _recording,
    "labels": _labels,
    "model": _model,
    "report": _report,
}
