"""attach: add other streams of a trial, such as an arm's pose or a camera's images, to a copy of its recording.

It is a separate command because such streams come from other programs, often later, and can be added to any recording:
imported, simulated or from devices. It writes a new file because a recording never changes after it is written: labels
and tracks refer to the recording that they were made from. As for an import, the hash of all arrays is part of the
recipe.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from evetac_cli.commands.attach import Attach
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US
from evetac_cli.formats.streams import aligned, on_clock_of_events, read_stream
from evetac_cli.jobs import Job, Outcome, Progress, Stage, outcome, silent
from evetac_cli.stages import output_in
from evetac_cli.store.files import stem, up_to_date, write_stage
from evetac_cli.store.hdf5.disk import existing_folder
from evetac_cli.store.layout import rules
from evetac_cli.store.layout.provenance import ContentDigest, Recipe
from evetac_cli.store.recordings import streams
from evetac_cli.store.recordings.read import Recording, open_recording
from evetac_cli.store.recordings.streams import Stream

OUTPUT = "recording"
METHOD = 1


def jobs(files: list[Path], params: Attach, out: Path | None) -> list[Job]:
    """Return a job for every recording, whose output is named <name>-streams."""
    sources = _by_name(params.stream, "--stream", "NAME=FILE")
    unknown = [name for name in _offsets(params) if name not in sources]
    if unknown:
        raise InputError("no such stream", where="--offset", expected=", ".join(sources), found=unknown[0])
    if not sources:
        raise InputError("no stream to add", where="--stream", expected="NAME=FILE, e.g. arm=pose.csv")
    return [Job((file,), output_in(out, file.parent, f"{stem(file)}-streams.{OUTPUT}.h5")) for file in files]


def run(job: Job, params: Attach, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Write a recording with all data of the input and the streams; InputError if a stream does not fit it."""
    sources, offsets = _by_name(params.stream, "--stream", "NAME=FILE"), _offsets(params)
    folder = existing_folder(job.output.parent)
    notes: list[str] = []
    added: list[Stream] = []
    with open_recording(job.inputs[0]) as recording:
        taken = streams.names(recording.contents())
        twice = next((name for name in sources if name in taken), None)
        if twice:
            raise InputError(f"already has a stream {twice}", where=str(job.inputs[0]))
        for number, (name, source) in enumerate(sources.items()):
            progress(number, len(sources), "streams read")
            start_us, slices = int(recording.read("t_offset")), len(recording)
            stream, remarks = read_stream(source, name, folder, slices * SLICE_US / 1e6)
            if name not in offsets:
                stream, brought = on_clock_of_events(stream, source, (start_us, start_us + slices * SLICE_US))
                remarks = [*remarks, brought] if brought else remarks
            stream = aligned(stream, offsets.get(name, 0.0), start_us, slices, source)
            notes += [f"{name}: {note}" for note in (f"times by {stream.clock}", *remarks)]
            added.append(stream)
        digest = ContentDigest()
        for path, values in _whole(recording, added).items():
            digest.update(path, values)
        for block in _blocks(recording, added, partial(progress, doing="slices checked")):
            for path, values in block.items():
                digest.update(path, values)
        header = recording.header
        about = {one.name: {"source": one.source, "offset_s": one.offset_s} for one in added}
        parameters = {**header["parameters"], "attached": {**header["parameters"].get("attached", {}), **about}}
        recipe = Recipe(OUTPUT, METHOD, parameters, seed=header["seed"], parents=(header,), content=digest.hexdigest())
        made = not up_to_date(job.output, recipe, force=force)
        if made:
            lengths = {path: shape[0] for path, shape in _with_rows(recording).items()}
            for one in added:
                lengths |= one.lengths()
            whole, blocks = _whole(recording, added), _blocks(recording, added, progress)
            made = write_stage(job.output, recipe, whole, blocks, lengths, force=force) is not None
    return outcome(
        job,
        made=made,
        simulated=bool(header["simulated"]),
        streams=len(added),
        samples=sum(len(one.t_us) for one in added),
        left_out=sum(one.left_out for one in added),
        notes="; ".join(notes),
    )


def _whole(recording: Recording, added: Sequence[Stream]) -> dict[str, Any]:
    """Return the datasets without rows: numbers, texts, and those of the sensor, whose frame is needed for checks."""
    rows = _with_rows(recording)
    whole = {path: recording.read(path) for path in recording.contents() if path not in rows}
    return whole | {path: text for one in added for path, text in one.texts().items()}


def _with_rows(recording: Recording) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the datasets that may be long."""
    shapes = {path: shape for path, (_, shape) in recording.contents().items()}
    return {path: shape for path, shape in shapes.items() if shape and not path.startswith("sensor/")}


def _blocks(
    recording: Recording, added: Sequence[Stream], progress: Callable[[float, float], None]
) -> Iterator[dict[str, Any]]:
    """Yield all datasets with rows, one after the other, in blocks that fit in memory; progress counts slices."""
    old = _with_rows(recording)
    done, total = 0, sum(shape[0] for shape in old.values()) + sum(sum(one.lengths().values()) for one in added)
    pieces = ({path: rows} for path, shape in old.items() for rows in rules.blocks(recording, path, shape))
    for block in chain(pieces, *(one.blocks() for one in added)):
        yield block
        done += sum(map(len, block.values()))
        progress(done * len(recording) // max(1, total), len(recording))


def _by_name(texts: Sequence[str] | None, flag: str, form: str) -> dict[str, str]:
    """Return the values of NAME=VALUE flags by name; InputError for anything else, or for an invalid name."""
    values: dict[str, str] = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not equals or not value or not streams.NAME.fullmatch(name):
            expected = f"{form}; names have letters, digits, _ . and -"
            raise InputError("cannot be read", where=flag, expected=expected, found=text)
        if name in values:
            raise InputError(f"{name} is given twice", where=flag, found=text)
        values[name] = value
    return values


def _offsets(params: Attach) -> dict[str, float]:
    """Return the offsets of the streams, in s."""
    offsets = {}
    for name, text in _by_name(params.offset, "--offset", "NAME=SECONDS").items():
        try:
            offsets[name] = float(text)
        except ValueError:
            offsets[name] = math.nan
        if not abs(offsets[name]) < streams.MOST_OFFSET_S:
            expected = f"NAME=SECONDS, less than {streams.MOST_OFFSET_S:g}"
            raise InputError("not an offset", where="--offset", expected=expected, found=f"{name}={text}")
    return offsets


STAGE = Stage(jobs, run)
