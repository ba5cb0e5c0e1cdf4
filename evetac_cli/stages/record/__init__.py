"""record: events of one trial into a file, from a simulated scene, from devices or from a foreign event file.

Where the scene has a gripper, the object is held by motor current, which is lowered at random until the object slips
out (paper, "Experimental Setup and Data Collection Procedure"). With devices stages/record/capture.py does this.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.devices import Gripper, Rig
from evetac_cli.devices.naming import CameraName
from evetac_cli.errors import InputError
from evetac_cli.events import Events, slice_starts
from evetac_cli.formats.read.read_rosbag import is_bag_folder
from evetac_cli.jobs import Job, Outcome, Progress, outcome, silent
from evetac_cli.params import Record, Trials
from evetac_cli.sim import scene
from evetac_cli.stages import one_file
from evetac_cli.stages.record import capture, capture_plan, live
from evetac_cli.stages.record.capture_series import as_series
from evetac_cli.stages.record.current_ramp import COMMAND_MS, RAMP_MA
from evetac_cli.stages.unused_options import refuse_unused_options
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.files import output_path, up_to_date, write_stage
from evetac_cli.store.provenance import Recipe, content_digest
from evetac_cli.store.segments import RecordingWriter

OUTPUT = "recording"
METHOD = 2
DRY_SLICES = 200
CLOSING_TICKS = 3  # how far ahead of the finger the goal is while it closes: one more than just moves it


def jobs(files: list[Path], params: Record, out: Path | None) -> list[Job]:
    """One recording for every object and trajectory, or for the imported file; InputError for options of another."""
    refuse_unused_options(params)
    if params.source is not None:
        if params.source.is_dir() and not is_bag_folder(params.source):
            raise InputError("this is a folder", where=str(params.source), expected="an event file")
        return [Job((params.source,), output_path(params.source, OUTPUT, out))]
    if params.camera != "sim" or params.gripper not in (None, "sim"):
        return _from_devices(params, out)
    return trials(("ramp", "hold", "press", "rub", "tone"), params, out, params.tones)


def _from_devices(params: Record, out: Path | None) -> list[Job]:
    """`count` trials with the devices that are named; a virtual world is simulated as the flags of a scene say."""
    cameras, _ = capture_plan.names(params)
    if cameras[0].kind == "virtual" and cameras[0].prepared_events_s is None:
        found = trials(("ramp", "hold"), params, out, prefix="virtual-")
        found = [job._replace(choice={**job.choice, "outputs": (job.output,)}) for job in found]
    else:
        inputs = tuple(Path(camera.which) for camera in cameras if camera.kind == "replay" and camera.which)
        named = [_outputs(cameras, params.seed, trial, out) for trial in range(params.count)]
        one_file([output for outputs in named for output in outputs], out)
        found = [Job(inputs, outputs[0], {"trial": trial, "outputs": outputs}) for trial, outputs in enumerate(named)]
    return as_series(found)


def _outputs(cameras: Sequence[CameraName], seed: int, trial: int, out: Path | None) -> tuple[Path, ...]:
    """A file for each camera of a trial: <kind>[-<which>][-<number>]-s<seed>-<trial>.recording.h5."""
    if out is not None and out.suffix == ".h5":
        return (out,) * len(cameras)
    names = ["-".join(filter(None, (camera.kind, _stem(camera.which)))) for camera in cameras]
    numbered = [
        f"{name}-{names[:at].count(name) + 1}" if names.count(name) > 1 else name for at, name in enumerate(names)
    ]
    return tuple((out or Path()) / f"{name}-s{seed}-{trial:03d}.{OUTPUT}.h5" for name in numbered)


def _stem(which: str | None) -> str:
    """Serial number, or the name of a recording without its ending."""
    return Path(which).name.split(".")[0] if which else ""


def trials(
    kinds: tuple[str, ...], params: Trials, out: Path | None, tones: str | None = None, prefix: str = ""
) -> list[Job]:
    """`count` trials of every object or tone in a scene of a kind.

    They are named <prefix><scene>[-obj<number>][-<tone>hz]-s<seed>-<trial>.recording.h5.
    """
    found = []
    for plan in scene.plan(params.scene, params.objects, params.sensor, kinds, params.gel, params.readout, tones):
        object_params = "" if plan["object"] is None else f"-obj{plan['object']:02d}"
        object_params += f"-{plan['tone_hz']:g}hz" if "tone_hz" in plan else ""
        for trial in range(params.count):
            name = f"{prefix}{plan['scene']['name']}{object_params}-s{params.seed}-{trial:03d}.{OUTPUT}.h5"
            output = out if out is not None and out.suffix == ".h5" else (out or Path()) / name
            built = scene.for_trial(plan, (params.seed, plan["object"] or 0, trial))
            found.append(Job((), output, {"plan": built, "trial": trial}))
    one_file(found, out)
    return found


def seeds(params: Trials, job: Job) -> np.random.SeedSequence:
    """The seeds of one trial: reproducible alone, whatever else is recorded."""
    if "plan" not in job.choice:
        return np.random.SeedSequence([params.seed, job.choice["trial"]])
    plan = job.choice["plan"]
    tone_mhz = [round(1000 * plan["tone_hz"])] if "tone_hz" in plan else []
    return np.random.SeedSequence([params.seed, plan["object"] or 0, job.choice["trial"], *tone_mhz])


def dry_run(jobs: list[Job], params: Record, *, force: bool = False) -> Outcome:
    """What would be built or done, and what that costs; refused what a run refuses."""
    if "series" in jobs[0].choice:
        return capture_plan.dry_run(jobs, params, force=force)
    if "plan" not in jobs[0].choice:
        raise InputError("an import has no plan to show", where="--dry-run", hint="leave out --from, or --dry-run")
    for job in jobs:
        if not params.live:
            up_to_date(job.output, _recipe(job, params), force=force)
    return what_is_built(jobs, params)


def what_is_built(jobs: list[Job], params: Trials) -> Outcome:
    """What the first trial builds and leaves out, and what its slices cost here: measured on 0.2 s of it."""
    from time import perf_counter

    from evetac_cli.devices.simulated import rig

    plan = jobs[0].choice["plan"]
    devices = rig(plan, seeds(params, jobs[0]))
    devices.camera.read()  # compiles, or loads what was compiled
    started = perf_counter()
    for _ in range(DRY_SLICES):
        devices.camera.read()
    us = (perf_counter() - started) / DRY_SLICES * 1e6
    devices.close()
    summary = {
        "files": len(jobs),
        "first_file": str(jobs[0].output),
        "time_us_a_slice_at_rest": us,
        "times_real_time_at_rest": 1000 / us,
    }
    return Outcome(scene.parts(plan), True, summary, made=False)


def run(job: Job, params: Record, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Record one trial, or import one file."""
    if params.source is not None:
        return _import(job, params, force)
    if params.live:
        return live.run(job, params, seeds(params, job), progress)
    if "series" in job.choice:
        return capture.run(job, params, seeds(params, job), force=force, progress=progress)
    recipe = _recipe(job, params)
    if up_to_date(job.output, recipe, force=force):
        return outcome(job, made=False, simulated=True)
    from evetac_cli.devices.simulated import rig  # builds on numba: only when there is something to simulate

    drawing = seeds(params, job)
    ramp = np.random.default_rng(drawing.spawn(1)[0])
    devices = rig(recipe.parameters, drawing)
    scene_ = recipe.parameters["scene"]
    longest_ms = round(1000 * _longest_s(scene_["time"]))
    known = {**devices.camera.sensor, "t_offset": np.int64(0), "truth/sampled_parameters": devices.drawn}
    writer = RecordingWriter(job.output, known, discard_leftover=True)
    try:
        slices, events = _follow(devices, writer, Handling.of(scene_), ramp, lambda done: progress(done, longest_ms))
        writer.finish(recipe)
    except BaseException:
        writer.discard()  # a simulation can be made again
        raise
    finally:
        devices.close()
    return outcome(job, made=True, simulated=True, slices=slices, events=events)


def _recipe(job: Job, params: Record) -> Recipe:
    parameters = {**job.choice["plan"], "trial": job.choice["trial"]}
    return Recipe(OUTPUT, METHOD, parameters, seed=params.seed, simulated_source=True)


def _longest_s(time: Mapping[str, float]) -> float:
    """How long a scene takes at most, for the progress shown."""
    return time["tone_at_s"] + time["tone_s"] + time["after_s"] if "tone_s" in time else time.get("longest_s", 100.0)


@dataclass(frozen=True)
class Handling:
    """When the gripper does what, in slices: closes to touch, grips with the holding current, lowers it."""

    close_ms: int
    grip_ms: int
    ramp_ms: int

    @classmethod
    def of(cls, scene_: Mapping[str, Any]) -> "Handling":
        """As the scene says; in a ramp scene the object is held from the start."""
        if scene_["kind"] == "ramp":
            time = scene_["time"]
            return cls(0, 0, round(1000 * (time["rest_s"] + time["load_s"] + time["hold_s"])))
        return cls(
            *(round(1000 * scene_.get("gripper", {}).get(name, 0.0)) for name in ("close_s", "grip_s", "ramp_s"))
        )


def _follow(
    devices: Rig, writer: RecordingWriter, handling: Handling, rng: np.random.Generator, progress: Any
) -> tuple[int, int]:
    """Write every slice, and command the gripper, if there is one, every 2 ms, until the scene has ended."""
    slices = events = 0
    target_ma = devices.holding_ma
    while (piece := devices.camera.read()) is not None:
        rows: dict[str, Any] = dict(devices.truth()) if devices.truth else {}
        if devices.gripper is not None and slices % COMMAND_MS == 0:
            if slices > handling.ramp_ms:
                target_ma += rng.uniform(*RAMP_MA)
            now_us = devices.clock.now_us()
            rows |= _command(devices.gripper, now_us, target_ma, slices, handling)
        writer.append(piece, rows)
        slices += 1
        events += piece.size
        if slices % 100 == 0:
            progress(slices)
    return slices, events


def _command(gripper: Gripper, now_us: int, target_ma: float, now_ms: int, handling: Handling) -> dict[str, Any]:
    """One command to the gripper, and its row: position mode until it grips, current mode from then on."""
    reading = gripper.read()
    gripping = now_ms >= handling.grip_ms
    if gripping:
        gripper.write_current(round(target_ma))
    else:
        gripper.write_position(reading.position_ticks + (CLOSING_TICKS if now_ms >= handling.close_ms else 0))
    return {
        "gripper/t_us": now_us,
        "gripper/current_target_ma": target_ma if gripping else float("nan"),
        "gripper/current_written_ma": round(target_ma) if gripping else 0,
        "gripper/current_ma": reading.current_ma,
        "gripper/position_ticks": reading.position_ticks,
    }


def _import(job: Job, params: Record, force: bool) -> Outcome:
    """Import an event file of another program as a recording."""
    from evetac_cli.formats.imports import read_events

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
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not re.fullmatch("[1-9][0-9]{0,4}x[1-9][0-9]{0,4}", text.lower()):
        raise InputError("not a frame size", where="--frame-size", expected="as in 640x480", found=text)
    return int(width), int(height)
