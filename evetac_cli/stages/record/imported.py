"""Import a foreign event file as a recording."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.jobs import Job, Outcome, Progress, outcome
from evetac_cli.params.recording import Record
from evetac_cli.stages.trials import OUTPUT
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.disk import existing_folder
from evetac_cli.store.files import up_to_date, write_stage
from evetac_cli.store.provenance import ContentDigest, Recipe
from evetac_cli.store.read import UNKNOWN_SENSOR

if TYPE_CHECKING:  # with the libraries of its format
    from evetac_cli.formats.imports import Imported

METHOD = 2


@dataclass(frozen=True)
class ImportJob(Job):
    """One recording to make of a foreign event file, its only input."""


def run(job: ImportJob, params: Record, *, force: bool, progress: Progress) -> Outcome:
    """Import an event file of another program as a recording."""
    from evetac_cli.formats.imports import left_out_text, read_events  # with the libraries of its format

    imported = read_events(
        job.inputs[0],
        frame_px=_frame(params.frame_size),
        sort=params.sort,
        stream=params.stream,
        frames=params.frames,
        folder=existing_folder(job.output.parent),
        progress=progress,
    )
    digest = ContentDigest()
    counts = np.zeros(imported.slices, np.int64)
    for block in _blocks(imported, progress, "events checked"):
        for name, rows in block.items():
            digest.update(name, rows)
        t = block.get("events/t", ())
        if len(t):
            first, last = int(t[0]) // SLICE_US, int(t[-1]) // SLICE_US
            ends = np.searchsorted(t, np.arange(first + 1, last + 2) * SLICE_US)
            counts[first : last + 1] += np.diff(ends, prepend=0)
    arrays: dict[str, Any] = {
        "ms_to_idx": np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        "t_offset": np.int64(imported.t_offset_us),
        "sensor/frame_px": np.array(imported.frame_px, np.int32),
        "sensor/name": UNKNOWN_SENSOR,
        **{path: text for stream in imported.streams for path, text in stream.texts().items()},
    }
    if params.calibration is not None:
        arrays |= read_calibration(params.calibration, imported.frame_px).arrays()
    for name, value in arrays.items():
        digest.update(name, value)
    notes = list(imported.notes)
    lost = sum(imported.counts.values())
    parameters = {
        "source": job.inputs[0].name,
        "format": imported.format,
        "sorted": params.sort,
        "dropped": dict(imported.counts),
        "left_out": dict(imported.left_out),
        "notes": notes,
    }
    recipe = Recipe(OUTPUT, METHOD, parameters, content=digest.hexdigest(), simulated_source=imported.simulated)
    made = not up_to_date(job.output, recipe, force=force)
    if made:
        lengths = dict.fromkeys((f"events/{column}" for column in Events._fields), imported.stored.size)
        for stream in imported.streams:
            lengths |= stream.lengths()
        write_stage(job.output, recipe, arrays, _blocks(imported, progress, "events written"), lengths)
    return outcome(
        job,
        made=made,
        simulated=imported.simulated,
        slices=imported.slices,
        events=imported.stored.size,
        dropped=lost,
        streams=" ".join(stream.name for stream in imported.streams) or None,
        left_out=left_out_text(imported.left_out) or None,
        notes="; ".join(notes) or None,
    )


def _blocks(imported: "Imported", progress: Progress, doing: str) -> Iterator[dict[str, Any]]:
    """The events in blocks, and then the other streams, as the datasets of a recording."""
    done = 0
    for events in imported.stored.blocks():
        yield {f"events/{column}": getattr(events, column) for column in Events._fields}
        done += events.size
        progress(done, imported.stored.size, doing)
    for stream in imported.streams:
        yield from stream.blocks()


def _frame(text: str | None) -> tuple[int, int] | None:
    """Width and height of --frame-size; InputError if it is not two numbers."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not re.fullmatch("[1-9][0-9]{0,4}x[1-9][0-9]{0,4}", text.lower()):
        raise InputError("not a frame size", where="--frame-size", expected="as in 640x480", found=text)
    return int(width), int(height)
