"""Import a foreign event file as a recording."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.events import Events, slice_starts
from evetac_cli.jobs import Job, Outcome, outcome
from evetac_cli.params import Record
from evetac_cli.stages.trials import OUTPUT
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.files import up_to_date, write_stage
from evetac_cli.store.provenance import Recipe, content_digest

METHOD = 2


@dataclass(frozen=True)
class ImportJob(Job):
    """One recording to make of a foreign event file, its only input."""


def run(job: ImportJob, params: Record, *, force: bool) -> Outcome:
    """Import an event file of another program as a recording."""
    from evetac_cli.formats.imports import read_events  # with the libraries of its format

    imported = read_events(job.inputs[0], frame_px=_frame(params.frame_size), sort=params.sort, stream=params.stream)
    events = imported.events
    arrays: dict[str, Any] = {
        **{f"events/{column}": getattr(events, column) for column in Events._fields},
        "ms_to_idx": slice_starts(events.t, imported.slices),
        "t_offset": np.int64(imported.t_offset_us),
        "sensor/frame_px": np.array(imported.frame_px, np.int32),
        "sensor/name": "unknown",
    }
    if params.calibration is not None:
        arrays |= read_calibration(params.calibration, imported.frame_px).arrays()
    notes = list(imported.notes)
    lost = sum(imported.counts.values())
    parameters = {
        "source": job.inputs[0].name,
        "format": imported.format,
        "sorted": params.sort,
        "dropped": dict(imported.counts),
        "notes": notes,
    }
    recipe = Recipe(OUTPUT, METHOD, parameters, content=content_digest(arrays), simulated_source=imported.simulated)
    made = not up_to_date(job.output, recipe, force=force)
    if made:
        write_stage(job.output, recipe, arrays)
    return outcome(
        job,
        made=made,
        simulated=imported.simulated,
        slices=imported.slices,
        events=events.size,
        dropped=lost,
        notes="; ".join(notes) or None,
    )


def _frame(text: str | None) -> tuple[int, int] | None:
    """Width and height of --frame-size; InputError if it is not two numbers."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not re.fullmatch("[1-9][0-9]{0,4}x[1-9][0-9]{0,4}", text.lower()):
        raise InputError("not a frame size", where="--frame-size", expected="as in 640x480", found=text)
    return int(width), int(height)
