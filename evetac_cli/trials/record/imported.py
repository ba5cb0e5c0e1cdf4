"""Import a foreign event file as a recording."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evetac_cli.commands.record import Record
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.events import Events, SliceStarts, empty
from evetac_cli.jobs import Job, Outcome, Progress, outcome
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.files import writing
from evetac_cli.store.hdf5.disk import existing_folder, missing_folders, remove_empty
from evetac_cli.store.layout.provenance import ContentDigest, Recipe
from evetac_cli.store.recordings.read import UNKNOWN_SENSOR
from evetac_cli.trials.trial import OUTPUT

if TYPE_CHECKING:  # needs the libraries of the file's format
    from evetac_cli.formats.imports import Imported

METHOD = 3
# Properties of a file that the user may specify; stored in the header if specified.
OPTIONS = ("drop_late", "from_restart", "columns", "time_unit")


@dataclass(frozen=True)
class ImportJob(Job):
    """One recording to make from a foreign event file, its only input."""


def run(job: ImportJob, params: Record, *, force: bool, progress: Progress) -> Outcome:
    """Import an event file of another program as a recording.

    The events are written once, as they are read. Their properties, and whether they are usable, are known at the end.
    """
    from evetac_cli.formats.imports import (  # needs the libraries of the file's format
        EventFile,
        ImportOptions,
        left_out_text,
    )
    from evetac_cli.formats.read.time_order import OrderOptions

    options = ImportOptions(
        _frame(params.frame_size),
        OrderOptions(params.sort, params.drop_late, params.from_restart),
        params.stream,
        params.columns,
        params.time_unit,
        params.frames,
    )
    file = EventFile(job.inputs[0], options, existing_folder(job.output.parent), progress)
    datasets: dict[str, Any] = {"sensor/frame_px": np.array(file.frame_px, np.int32), "sensor/name": UNKNOWN_SENSOR}
    if params.calibration is not None:
        datasets |= read_calibration(params.calibration, file.frame_px).recorded()
    digest, starts = ContentDigest(), SliceStarts()
    folders = missing_folders(job.output.parent)
    with _removed_if_refused(folders), writing(job.output, OUTPUT, datasets, force=force) as recording:
        for events in chain([empty()], file.blocks()):
            block = {f"events/{column}": getattr(events, column) for column in Events._fields}
            recording.append(block)
            digest.update_all(block)
            starts.add(events.t)
        facts = file.finish()
        for block in chain.from_iterable(stream.blocks() for stream in facts.streams):
            recording.append(block)
            digest.update_all(block)
        late: dict[str, Any] = {
            "ms_to_idx": starts.finish(facts.slices),
            "t_offset": np.int64(facts.t_offset_us),
            **{path: text for stream in facts.streams for path, text in stream.texts().items()},
        }
        digest.update_all(datasets | late)
        recording.finish(_recipe(job, params, facts, digest), late)
    return outcome(
        job,
        made=recording.made,
        simulated=facts.simulated,
        slices=facts.slices,
        events=facts.size,
        dropped=sum(facts.counts.values()),
        streams=" ".join(stream.name for stream in facts.streams) or None,
        left_out=left_out_text(facts.left_out) or None,
        notes="; ".join(facts.notes) or None,
    )


def _recipe(job: ImportJob, params: Record, facts: "Imported", digest: ContentDigest) -> Recipe:
    parameters = {
        "source": job.inputs[0].name,
        "format": facts.format,
        "sorted": params.sort,
        **{name: getattr(params, name) for name in OPTIONS if getattr(params, name) not in (None, False)},
        "dropped": dict(facts.counts),
        "left_out": dict(facts.left_out),
        "notes": list(facts.notes),
    }
    return Recipe(OUTPUT, METHOD, parameters, content=digest.hexdigest(), simulated_source=facts.simulated)


@contextmanager
def _removed_if_refused(folders: list[Path]) -> Iterator[None]:
    """Remove folders created for a recording if its source file turns out to be unusable; no other job uses them."""
    try:
        yield
    except EvetacError:
        remove_empty(folders)
        raise


def _frame(text: str | None) -> tuple[int, int] | None:
    """Return width and height of --frame-size; InputError if it is not two numbers."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not re.fullmatch("[1-9][0-9]{0,4}x[1-9][0-9]{0,4}", text.lower()):
        raise InputError(
            "not a frame size", where="--frame-size", expected="WIDTHxHEIGHT, for example 640x480", found=text
        )
    return int(width), int(height)
