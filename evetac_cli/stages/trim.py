"""trim: a range of slices out of a recording, as a recording of its own.

Every group is cut: rows of slices by their index, rows of gripper and controller by their time. Times begin anew at 0,
and `t_offset` says by how much. Datasets without time are copied, but of `capture` only the lost slices and why it
ended, because its counts are those of the whole recording.

Tracks and features of a piece from slice 0 on are the first rows of those of the whole, bit for bit, because a slice's
depend on no later slice. In a piece that begins later the tracker starts with dots at rest, as in every recording.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US
from evetac_cli.jobs import Job, Outcome, Progress, outcome, silent
from evetac_cli.params import Trim
from evetac_cli.stages import one_file
from evetac_cli.store import schema
from evetac_cli.store.files import stem, up_to_date, write_stage
from evetac_cli.store.provenance import Recipe
from evetac_cli.store.read import Recording, open_recording

OUTPUT = "recording"
METHOD = 1
CLOCKS = {"commands": "gripper/t_us", "control_steps": "control/t_us"}  # dims whose rows have times of their own


def jobs(files: list[Path], params: Trim, out: Path | None) -> list[Job]:
    """One piece of every recording, named <name>-<from>-<to>ms."""
    if params.to_ms is not None and params.to_ms <= params.from_ms:
        raise InputError(
            "the piece ends before it begins",
            where="--to-ms",
            expected=f"more than --from-ms {params.from_ms}",
            found=f"{params.to_ms}",
        )
    one_file(files, out)
    if out is not None and out.suffix == ".h5":
        return [Job((file,), out) for file in files]
    to = "end" if params.to_ms is None else f"{params.to_ms}"
    named = [(file, f"{stem(file)}-{params.from_ms}-{to}ms.{OUTPUT}.h5") for file in files]
    return [Job((file,), (out or file.parent) / name) for file, name in named]


def run(job: Job, params: Trim, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Write the slices [from_ms, to_ms) of a recording; InputError if it has no such slices."""
    with open_recording(job.inputs[0]) as recording:
        first = params.from_ms
        end = len(recording) if params.to_ms is None else params.to_ms
        if not first < end <= len(recording):
            raise InputError(
                "slices out of range",
                where=str(job.inputs[0]),
                expected=f"--from-ms and --to-ms within 0 and {len(recording)}",
                found=f"{first} to {end}",
            )
        header = recording.header
        simulated = bool(header["simulated"])
        parameters = {**header["parameters"], "trimmed": {"from_ms": first, "to_ms": end}}
        recipe = Recipe(OUTPUT, METHOD, parameters, seed=header["seed"], parents=(header,))
        if up_to_date(job.output, recipe, force=force):
            return outcome(job, made=False, simulated=simulated)
        arrays = _piece(recording, first, end)
        progress(end - first, end - first)
    write_stage(job.output, recipe, arrays)
    events = int(arrays["ms_to_idx"][-1])
    return outcome(job, made=True, simulated=simulated, slices=end - first, events=events)


def _piece(recording: Recording, first: int, end: int) -> dict[str, Any]:
    """The datasets of a recording, cut to the slices [first, end)."""
    shift_us = first * SLICE_US
    begin, stop = int(recording.starts[first]), int(recording.starts[end])
    rows = {dim: _rows(recording.read(clock), first, end) for dim, clock in CLOCKS.items() if recording.has(clock)}
    piece: dict[str, Any] = {
        "ms_to_idx": recording.starts[first : end + 1] - begin,
        "t_offset": np.int64(recording.read("t_offset") + shift_us),
    }
    table = schema.load(OUTPUT)
    for name in recording.contents():
        described = table.find(name)
        dim = described.dims[0] if described is not None and described.dims else ""
        if name in piece or (name.startswith("capture/") and name != "capture/ended"):
            continue
        if dim == "events":
            piece[name] = recording.read(name, begin, stop)
        elif dim == "slices":
            piece[name] = recording.read(name, first, end)
        elif dim in rows:
            piece[name] = recording.read(name)[rows[str(dim)]]
        else:
            piece[name] = recording.read(name)
        if name == "events/t" or name in CLOCKS.values():
            piece[name] = piece[name] - shift_us
    return piece | _lost(recording, first, end)


def _rows(t_us: NDArray[np.int64], first: int, end: int) -> NDArray[np.bool_]:
    """Which times lie within the slices [first, end)."""
    return (t_us >= first * SLICE_US) & (t_us < end * SLICE_US)


def _lost(recording: Recording, first: int, end: int) -> dict[str, Any]:
    """The lost slices within [first, end), counted from first."""
    if not recording.has("capture/lost_slices"):
        return {}
    gaps = np.clip(recording.read("capture/lost_slices"), first, end) - first
    gaps = gaps[gaps[:, 0] < gaps[:, 1]]
    return {"capture/lost_slices": gaps} if len(gaps) else {}
