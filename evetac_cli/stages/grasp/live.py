"""A grasp in real time, on devices or their virtual twins: what is named, refused, started, and told of it at the end.

Three processes: the detector (detector_process.py) at 1000 Hz, the controller (controller_process.py) at 500 Hz, and this
one, which records (recorder.py). The detector and the law are those of a simulated grasp.

Latency is counted from the first event of the slice with slip to the last byte of the command. The event has the
camera's time; the host's clock is matched to it by the fastest delivery within 5 s. So the shortest way of words from
sensor to program (some 0.1 ms over USB) is not in it, and the clocks' drift in 5 s, 0.25 ms at 50 ppm, may be.
"""

import json
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evetac_cli import console
from evetac_cli.devices.naming import VIRTUAL_ANSWER_MS, CameraName, GripperName, camera_name, gripper_name
from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import ANSWER_MS
from evetac_cli.errors import DeviceError, EvetacError, InputError, attach_outcome
from evetac_cli.jobs import Job, Outcome, Progress, outcome
from evetac_cli.kernels.grip.control import Control
from evetac_cli.params import Grasp
from evetac_cli.realtime.processes import set_realtime_priority
from evetac_cli.realtime.shared_time import HOST_TIME
from evetac_cli.sim import scene
from evetac_cli.stages import one_file
from evetac_cli.stages.grasp import replay
from evetac_cli.stages.grasp import setup as grasp_setup
from evetac_cli.stages.grasp.controller_process import Commanding
from evetac_cli.stages.grasp.detector_process import Feeling
from evetac_cli.stages.grasp.loop import Timing
from evetac_cli.stages.grasp.online_detector import dots_for
from evetac_cli.stages.grasp.recorder import Loops, Recorded, record
from evetac_cli.stages.record import trials
from evetac_cli.stages.record.capture import INTERRUPTED, LOST, finish, signals_counted, with_hint
from evetac_cli.stages.record.capture_plan import BYTES_AN_EVENT
from evetac_cli.stages.record.capture_series import as_series, refuse_taken, without_nan
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.disk import require_room
from evetac_cli.store.files import StageFile
from evetac_cli.store.provenance import Header, Recipe
from evetac_cli.store.read import open_recording
from evetac_cli.store.segments import RecordingWriter

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.gripper import VirtualGripper
    from evetac_cli.devices.virtual.world import VirtualWorld

OUTPUT = "recording"
METHOD = 1  # of grasps in real time
EVENTS_S = 500_000  # that the disk must have room for
SLOWEST_HZ = 100.0  # below, the watchdog would be blind
SERVO_RANK = 40  # of urgency: hardware does not wait for a scheduler
VIRTUAL_PATIENCE = 5
LAST_TICK = 740  # closed; the law's own limit
FALLS = "torque is switched off at the end, and at once if detector, camera or bus fail: what is held then falls"


def names(params: Grasp) -> tuple[CameraName, GripperName]:
    """The devices that are named; InputError for names that there are not, and for pairs that make no grasp."""
    camera = camera_name(params.camera)
    text = "sim" if params.gripper is None and camera.kind == "replay" else params.gripper
    gripper = gripper_name(text, camera)
    if gripper.kind == "none" or (gripper.kind == "sim" and camera.kind != "replay") or camera.kind == "sim":
        raise InputError(
            "a grasp needs a camera and a gripper that belong together",
            where="--camera, --gripper",
            expected="both sim; or a gripper that is virtual or at a PORT; or replay:RECORDING with sim",
            found=f"{camera}, {gripper}",
        )
    return camera, gripper


def jobs(params: Grasp, out: Path | None) -> list[Job]:
    """One recording for every trial; InputError for what cannot be done, or must not without --arm."""
    camera, gripper = names(params)
    timing = make_timing(params)
    if timing.latency_ms and gripper.kind != "sim":
        raise InputError("latency is added in simulation alone", where="--latency-ms", found=str(timing.latency_ms))
    if timing.every_ms > 1000 / SLOWEST_HZ:
        expected = f"at least {SLOWEST_HZ:g} Hz in real time"
        raise InputError(
            "too slow to be watched", where="--control-hz", expected=expected, found=str(params.control_hz)
        )
    if timing.end_ms > 1000 * params.max_seconds:
        raise InputError(
            "the grasp would take too long",
            where="--max-seconds",
            expected=f"at least the {timing.end_ms * 1e-3:g} s of contact, --lift-s and --balance-s",
            found=f"{params.max_seconds:g}",
        )
    try:
        settings_of(params, gripper)
    except ValueError as error:
        raise InputError(str(error), where="--watchdog-ms") from None
    if gripper.kind == "port" and not (params.arm or params.dry_run):
        console.say(
            f"{camera} and {gripper}: {params.controller} at {params.control_hz:g} Hz for {timing.end_ms * 1e-3:g} s,"
            f" with at most {params.max_current_ma} mA; {FALLS}"
        )
        raise InputError(
            "this would move a real gripper",
            where=str(gripper),
            expected="--arm, once nothing is between the fingers that must not be",
            hint="--dry-run shows all of the plan",
        )
    if camera.kind == "virtual" and camera.prepared_events_s is None:
        return as_series(trials(("lift",), params, out, prefix="virtual-"))
    which = Path(camera.which).name.split(".")[0] if camera.which else ""
    name = "-".join(filter(None, ("grasp", camera.kind, which)))
    folder = out if out is not None and out.suffix != ".h5" else Path()
    inputs = (Path(camera.which),) if camera.kind == "replay" and camera.which else ()
    outputs = [folder / f"{name}-s{params.seed}-{trial:03d}.{OUTPUT}.h5" for trial in range(params.count)]
    if out is not None and out.suffix == ".h5":
        outputs = [out] * params.count
    one_file(outputs, out)
    return as_series([Job(inputs, output, {"trial": trial}) for trial, output in enumerate(outputs)])


def make_timing(params: Grasp) -> Timing:
    """When phases end, by the scene that is named."""
    planned = scene.plan(params.scene, params.objects, params.sensor, ("lift",), params.gel, params.readout)
    return grasp_setup.make_timing(params, planned[0]["scene"])


def settings_of(params: Grasp, gripper: GripperName) -> RhP12RnSettings:
    """How the gripper is set up: an answer is waited for so long that two tries fit into the watchdog's time.

    A virtual servo is stopped at times by the computer that simulates it, as is who commands it: it gets more time.
    """
    asked = RhP12RnSettings(
        max_current_ma=params.max_current_ma,
        watchdog_ms=params.watchdog_ms,
        answer_ms=min(ANSWER_MS, params.watchdog_ms / 3),
        last_tick=LAST_TICK,
    )
    if gripper.kind != "virtual":
        return asked
    return replace(asked, watchdog_ms=VIRTUAL_PATIENCE * asked.watchdog_ms, answer_ms=VIRTUAL_ANSWER_MS)


def check(job: Job, params: Grasp, *, force: bool) -> None:
    """InputError for whatever can be known to be wrong with a grasp before a device is touched."""
    refuse_taken(job, again="a grasp in real time", hint="--force replaces it, -o NAME writes elsewhere", force=force)
    timing = make_timing(params)
    require_room(job.output.parent, EVENTS_S * timing.end_ms * 1e-3 * BYTES_AN_EVENT, "a shorter --balance-s")
    model_path = grasp_setup.model_path_for(params)
    grasp_setup.model_headers(model_path)
    if "plan" in job.choice and params.calibration is None:
        return  # its world will say where the dots are
    sensor = _sensor(params, names(params)[0], None)
    if model_path is not None:
        with StageFile(model_path, "model") as model:
            dots_for(model, sensor["sensor/dot_xy_px"])


def dry_run(jobs: list[Job], params: Grasp, *, force: bool = False) -> Outcome:
    """What would be opened and done, checked as by a run; no device is touched, and no file written."""
    for job in jobs:
        refuse = replay.check if names(params)[1].kind == "sim" else check
        refuse(job, params, force=force)
    camera, gripper = names(params)
    timing = make_timing(params)
    moved = "moves nothing" if gripper.kind == "sim" else f"at most {params.max_current_ma} mA"
    rows = [
        {
            "part": "camera",
            "what": str(camera),
            "detail": f"slip felt 1000 times a second by {grasp_setup.model_path_for(params)}",
        },
        {"part": "gripper", "what": str(gripper), "detail": f"{params.control_hz:g} Hz, {params.controller}, {moved}"},
        {"part": "end", "what": f"after {timing.end_ms * 1e-3:g} s", "detail": FALLS},
        {"part": "watchdog", "what": f"{params.watchdog_ms} ms", "detail": "of silence, and torque is off"},
        *({"part": "file", "what": str(job.output), "detail": f"trial {job.choice['trial']}"} for job in jobs),
    ]
    return Outcome(rows, camera.kind in ("virtual", "replay"), {"files": len(jobs)}, made=False)


def run(job: Job, params: Grasp, seeds: np.random.SeedSequence, *, force: bool, progress: Progress) -> Outcome:
    """Grasp once, in real time, and record everything."""
    camera, gripper = names(params)
    if gripper.kind == "sim":
        return replay.run(job, params, force=force, progress=progress)
    check(job, params, force=force)
    timing = make_timing(params)
    if gripper.kind == "port" and job.choice["trial"]:
        console.wait_for_enter(f"trial {job.choice['trial']}: put the object in place, then press Enter")
    with ExitStack() as opened:
        world, servo = _virtual_peers(job, params, camera, gripper, seeds, opened)  # Ctrl-C breaks this off
        came = opened.enter_context(signals_counted())
        sensor = _sensor(params, camera, world)
        feeling = Feeling(camera, seeds, sensor, grasp_setup.model_path_for(params), params.tracker, timing.end_ms)
        commanding = Commanding(
            servo.port if servo is not None else gripper.port,
            gripper.baud,
            settings_of(params, gripper),
            grasp_setup.make_law(params),
            timing,
            (VIRTUAL_PATIENCE if world is not None else 1) * params.watchdog_ms,  # a late world holds up its camera
            params.max_seconds,
            HOST_TIME if world is None else world.time,
        )
        loops = Loops(feeling, commanding, world)
        opened.callback(loops.close)
        if servo is not None and servo.pid is not None:
            set_realtime_priority(SERVO_RANK, servo.pid)
        seen, ready = loops.begin(came)
        for note in seen.notes:
            console.say(note)
        setup = {"camera": dict(seen.setup), "gripper": {"name": gripper.kind, **ready.setup}}
        sensor = {**seen.sensor, **sensor, "t_offset": np.int64(0)}
        recipe = _recipe(job, params, camera, setup, sensor)
        writer = RecordingWriter(job.output, sensor, discard_leftover=False, recipe=recipe)
        if gripper.kind == "port" and not came:
            console.say(f"{gripper} moves now; {FALLS}")
        try:
            if not came:
                loops.go()
            recorded = record(loops, world, writer, timing.end_ms, came, lambda done: progress(done, timing.end_ms))
        except BaseException as error:
            writer.leave()
            raise with_hint(error, writer) from None
        loops.close()
        figures = {
            **recorded.figures(),
            "capture/scheduling": f"detector {seen.scheduling}, controller {ready.scheduling}",
        }
        if world is not None:
            figures |= {f"{LOST}world.{why}": np.int64(count) for why, count in world.counted.items()}
        became = _keep(writer, recipe, recorded, figures, world)
    return _tell(job, recipe, recorded, figures, became)


def _virtual_peers(
    job: Job,
    params: Grasp,
    camera: CameraName,
    gripper: GripperName,
    seeds: np.random.SeedSequence,
    opened: ExitStack,
) -> tuple["VirtualWorld | None", "VirtualGripper | None"]:
    """What is behind virtual devices; closed with `opened`."""
    world = servo = None
    if "plan" in job.choice:
        from evetac_cli.devices.virtual.world import VirtualWorld

        durations = {"lift_s": params.lift_s, "balance_s": params.balance_s}
        world = VirtualWorld(job.choice["plan"], seeds, tells_truth=True, **durations)
        opened.callback(world.close)
    if gripper.kind == "virtual":
        from evetac_cli.devices.virtual.gripper import VirtualGripper

        servo = VirtualGripper(world.plant if world is not None else None, gripper.faults)
        opened.callback(servo.close)
    return world, servo


def _sensor(params: Grasp, camera: CameraName, world: "VirtualWorld | None") -> dict[str, Any]:
    """The dot grid, which has to be known before the camera is opened; InputError if nobody knows it."""
    if params.calibration is not None:
        found: Mapping[str, Any] = read_calibration(params.calibration, (640, 480)).arrays()
    elif world is not None:
        found = world.sensor
    elif camera.kind == "replay":
        with open_recording(Path(camera.which or "")) as recording:
            found = recording.sensor_datasets()
    else:
        found = {}
    if "sensor/dot_xy_px" not in found:
        raise InputError(
            "nobody knows where the dots of this gel are",
            where=str(camera),
            expected="--calibration FILE",
            hint="evetac calibrate makes one from a recording in which every dot is pressed",
        )
    return dict(found)


def _recipe(job: Job, params: Grasp, camera: CameraName, setup: Mapping[str, Any], sensor: Mapping[str, Any]) -> Recipe:
    """What is known of a grasp beforehand; its content stands in for the rest."""
    calibrated = {name: np.asarray(value).tolist() for name, value in sensor.items() if name.startswith("sensor/")}
    parameters = {
        **grasp_setup.grasp_parameters(job, params, Control(grasp_setup.make_law(params), params.control_hz)),
        "setup": dict(setup),
        "sensor": without_nan(calibrated),
        "watchdog_ms": params.watchdog_ms,
    }
    parents: tuple[Header, ...] = grasp_setup.model_headers(grasp_setup.model_path_for(params))
    if camera.kind == "replay":
        with open_recording(Path(camera.which or "")) as recording:
            parents += (recording.header,)
    return Recipe(OUTPUT, METHOD, parameters, parents=parents, simulated_source=camera.kind == "virtual")


def _keep(
    writer: RecordingWriter, recipe: Recipe, recorded: Recorded, figures: dict[str, Any], world: "VirtualWorld | None"
) -> dict[str, Any]:
    """Make the file; what became of the grasp, where truth is known. Nothing is kept of a grasp without a step."""
    if not recorded.slices or not recorded.steps.rows:
        writer.discard()
        return {}
    late = dict(figures)
    became = None
    if world is not None and (truth := recorded.truth_arrays()):
        late |= {**truth, "truth/sampled_parameters": world.drawn}
        became = recorded.what_became(recipe.parameters["sensor_row"]["mm_per_px"])
    if became is not None:
        late["control/outcome"] = json.dumps(became)
    finish(writer, recipe, late)
    return became or {}


def _tell(
    job: Job, recipe: Recipe, recorded: Recorded, figures: Mapping[str, Any], became: Mapping[str, Any]
) -> Outcome:
    """The row of a grasp; an error or Ctrl-C goes on from here, and says what there is."""
    kept = bool(recorded.slices and recorded.steps.rows)
    what = f"{recorded.slices:,} slices in {job.output}" if kept else "nothing was recorded"
    result = _row(job, recipe, recorded, figures, became) if kept else None
    if recorded.ended == INTERRUPTED:
        raise attach_outcome(KeyboardInterrupt(f"interrupted, torque is off: {what}"), result)
    if recorded.error is not None:
        error = recorded.error if isinstance(recorded.error, EvetacError) else DeviceError(str(recorded.error))
        error.kept = what
        raise attach_outcome(error, result)
    if result is None:
        raise DeviceError("the grasp ended before its first step", found=recorded.ended)
    return result


def _row(
    job: Job, recipe: Recipe, recorded: Recorded, figures: Mapping[str, Any], became: Mapping[str, Any]
) -> Outcome:
    """The figures of a grasp whose file there is."""
    lost = {name.removeprefix(LOST): int(count) for name, count in figures.items() if name.startswith(LOST) and count}
    timing: dict[str, float | int | None] = {}
    for name, path, index in (
        ("latency_us_median", "latency_us", 0),
        ("latency_us_p99", "latency_us", 1),
        ("step_late_us_p99", "step_late_us", 1),
        ("command_us_median", "command_us", 0),
    ):
        values = figures.get(f"capture/{path}")
        timing[name] = None if values is None else float(values[index])
    for name in ("slices_per_s", "commands_per_s"):
        timing[name] = float(figures[f"capture/{name}"]) if f"capture/{name}" in figures else None
    return outcome(
        job,
        made=True,
        simulated=recipe.simulated,
        slices=recorded.slices,
        ended=recorded.ended,
        **timing,
        command_misses=int(figures["capture/command_misses"]),
        latencies=len(recorded.latency_us),
        scheduling=figures["capture/scheduling"],
        lost="; ".join(f"{name} {count}" for name, count in lost.items()) or None,
        **became,
    )
