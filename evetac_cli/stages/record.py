"""record: events of one trial into a file, from a simulated scene or from a foreign event file.

In a ramp scene the object is held by motor current, which is lowered at random until the object slips out
(paper, "Experimental Setup and Data Collection Procedure").
"""

from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.devices import Rig
from evetac_cli.errors import InputError
from evetac_cli.events import Events, slice_starts
from evetac_cli.params import Record
from evetac_cli.sim import scene
from evetac_cli.stages import Job, Outcome, Progress, one_file, outcome, silent
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.files import output_path, up_to_date, write_stage
from evetac_cli.store.provenance import Recipe, content_digest
from evetac_cli.store.segments import RecordingWriter

INPUTS = ()
OUTPUT = "recording"
METHOD = 1
COMMAND_MS = 2  # the gripper is commanded at 500 Hz
RAMP_MA = (-0.025, -0.0025)  # change of the target current a command (paper)


def jobs(files: list[Path], params: Record, out: Path | None) -> list[Job]:
    """One recording for every object and trajectory, or for the imported file."""
    if params.source is not None:
        if params.source.is_dir():
            raise InputError("this is a folder", where=str(params.source), expected="an event file")
        return [Job((params.source,), output_path(params.source, OUTPUT, out))]
    return trials("ramp", params, out)


def trials(kind: str, params: Any, out: Path | None) -> list[Job]:
    """`count` trials of every object in a scene of a kind: <scene>-obj<number>-s<seed>-<trial>.recording.h5."""
    found = []
    for number in scene.numbers(params.objects):
        plan = scene.plan(params.scene, number, params.individual, kind)
        for trial in range(params.count):
            name = f"{plan['scene']['name']}-obj{number:02d}-s{params.seed}-{trial:03d}.{OUTPUT}.h5"
            output = out if out is not None and out.suffix == ".h5" else (out or Path()) / name
            found.append(Job((), output, {"plan": plan, "trial": trial}))
    one_file(found, out)
    return found


def seeds(params: Any, job: Job) -> np.random.SeedSequence:
    """The seeds of one trial: reproducible alone, whatever else is recorded."""
    return np.random.SeedSequence([params.seed, job.choice["plan"]["object"], job.choice["trial"]])


def run(job: Job, params: Record, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Record one trial, or import one file."""
    if params.source is not None:
        return _import(job, params, force)
    parameters = {**job.choice["plan"], "trial": job.choice["trial"]}
    recipe = Recipe(OUTPUT, METHOD, parameters, seed=params.seed, simulated_source=True)
    if up_to_date(job.output, recipe, force=force):
        return outcome(job, made=False, simulated=True)
    from evetac_cli.devices.simulated import rig  # builds on numba: only when there is something to simulate

    drawing = seeds(params, job)
    ramp = np.random.default_rng(drawing.spawn(1)[0])
    devices = rig(parameters, drawing)
    time = parameters["scene"]["time"]
    still_ms = round(1000 * (time["rest_s"] + time["load_s"] + time["hold_s"]))
    longest_ms = round(1000 * time["longest_s"])
    writer = RecordingWriter(job.output, {**devices.camera.sensor, "t_offset": np.int64(0)}, discard_leftover=True)
    try:
        slices, events = _ramp_down(devices, writer, ramp, still_ms, lambda done: progress(done, longest_ms))
        writer.finish(recipe, {"truth/drawn": devices.drawn})
    except BaseException:
        writer.discard()  # a simulation can be made again
        raise
    finally:
        devices.close()
    return outcome(job, made=True, simulated=True, slices=slices, events=events)


def _ramp_down(
    devices: Rig, writer: RecordingWriter, rng: np.random.Generator, still_ms: int, progress: Any
) -> tuple[int, int]:
    """Hold for a while, then lower the target current by a random step every 2 ms, until the scene has ended."""
    gripper = devices.gripper
    assert gripper is not None
    target_ma = 0.0
    slices = events = 0
    while (piece := devices.camera.read()) is not None:
        rows: dict[str, Any] = dict(devices.truth()) if devices.truth else {}
        if slices % COMMAND_MS == 0:
            reading = gripper.read()
            if slices == 0:
                target_ma = reading.current_ma  # whatever holds the object stably is where the ramp starts
            elif slices >= still_ms:
                target_ma += rng.uniform(*RAMP_MA)
            written_ma = round(target_ma)
            gripper.write_current(written_ma)
            rows |= {
                "gripper/t_us": devices.clock.now_us(),
                "gripper/current_target_ma": target_ma,
                "gripper/current_written_ma": written_ma,
                "gripper/current_ma": reading.current_ma,
                "gripper/position_ticks": reading.position_ticks,
            }
        writer.append(piece, rows)
        slices += 1
        events += piece.size
        if slices % 100 == 0:
            progress(slices)
    return slices, events


def _import(job: Job, params: Record, force: bool) -> Outcome:
    """Read a foreign event file through the one door of store.imports."""
    from evetac_cli.store.imports import read_events

    imported = read_events(job.inputs[0], frame_px=_frame(params.frame_size), sort=params.sort, stream=params.stream)
    events = imported.events
    arrays: dict[str, Any] = {
        **{f"events/{column}": getattr(events, column) for column in Events._fields},
        "ms_to_idx": slice_starts(events.t, imported.slices),
        "t_offset": np.int64(imported.t_offset_us),
        "sensor/frame_px": np.array(imported.frame_px, np.int32),
        "sensor/individual": "unknown",
    }
    if params.calibration is not None:
        calibration = read_calibration(params.calibration)
        if calibration.frame_px != imported.frame_px:
            raise InputError(
                "the calibration is for another frame",
                where=str(params.calibration),
                expected="{} x {} px".format(*imported.frame_px),
                found="{} x {} px".format(*calibration.frame_px),
            )
        arrays |= calibration.arrays()
    parameters = {
        "source": job.inputs[0].name,
        "format": imported.format,
        "sorted": params.sort,
        "dropped": dict(imported.counts),
        "notes": list(imported.notes),
    }
    recipe = Recipe(OUTPUT, METHOD, parameters, content=content_digest(arrays))
    made = not up_to_date(job.output, recipe, force=force)
    if made:
        write_stage(job.output, recipe, arrays)
    return outcome(
        job,
        made=made,
        simulated=False,
        slices=imported.slices,
        events=events.size,
        dropped=sum(imported.counts.values()),
        notes="; ".join(imported.notes) or None,
    )


def _frame(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise InputError("not a frame size", where="--frame-size", expected="as in 640x480", found=text)
    return int(width), int(height)
