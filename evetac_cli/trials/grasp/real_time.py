"""A grasp in real time, with real or virtual devices: checked, started, recorded, and reported at the end.

Three processes run: the detector (detector_process.py) at 1000 Hz, the controller (controller_process.py) at 500 Hz,
and this one, which records (recorder.py). With a camera at each finger, there is one detector per camera. Detectors and
law are those of a simulated grasp.

Latency is counted from the first event of the slice with slip to the last byte of the command. The event has the
camera's time; the host's clock is matched to it by the fastest delivery within 5 s. So the latency does not include the
minimum time of words from sensor to program (about 0.1 ms over USB). It may include the clocks' drift in 5 s, 0.25 ms
at 50 ppm.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np

from evetac_cli import console, interrupts
from evetac_cli.commands.grasp import Grasp
from evetac_cli.devices.cameras import NamedCamera
from evetac_cli.devices.grippers import VIRTUAL_WATCHDOG_FACTOR, NamedGripper
from evetac_cli.devices.opening import open_peers, require_arm
from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import ANSWER_MS
from evetac_cli.errors import InputError
from evetac_cli.jobs import Outcome, Progress
from evetac_cli.names import Capability
from evetac_cli.realtime.processes import raised_priority, set_realtime_priority
from evetac_cli.realtime.shared_time import HOST_TIME
from evetac_cli.sim.setup import scene_file
from evetac_cli.store.calibration import MAKE_GRID, read_calibrations
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.store.recordings.segments import RecordingWriter
from evetac_cli.trials import live_view, session
from evetac_cli.trials.grasp import replay
from evetac_cli.trials.grasp.controller_process import ControllerSettings
from evetac_cli.trials.grasp.detector_process import CameraReady, DetectorSettings
from evetac_cli.trials.grasp.grasp_processes import GraspProcesses
from evetac_cli.trials.grasp.loop import Timing
from evetac_cli.trials.grasp.recorded_grasp import RecordedGrasp, result_of
from evetac_cli.trials.grasp.recorder import PRIORITY as WATCHING_PRIORITY
from evetac_cli.trials.grasp.recorder import GraspRecorder
from evetac_cli.trials.grasp.settings import DeviceGrasp, GraspSettings, ReplayGrasp
from evetac_cli.trials.trial import device_trials

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.gripper import VirtualGripper
    from evetac_cli.devices.virtual.world import VirtualWorld
    from evetac_cli.trials.listen.trial_requests import TrialRequests

METHOD = 4  # method version of grasps in real time
KINDS = ("lift",)  # kinds of scenes for grasps
WATCHDOG_MS = 60  # default
UNTIL_STOPPED = 2**62  # a number of slices that is never reached
EVENTS_S = 500_000  # event rate that the disk must have room for
SLOWEST_HZ = 100.0  # slowest control rate at which hangs are still detected in time
SERVO_PRIORITY = 40  # real hardware does not wait for a scheduler, so its virtual replacement should not either
# Niceness of the writing thread: below the detector, or with virtual devices, which need as much CPU, below everything.
WRITING_NICE, BESIDE_VIRTUAL = -5, 15
NO_OFFSET = {"t_offset": np.int64(0)}
LAST_TICK = 740  # closed; the law's own limit
FALLS = "torque is switched off at the end, and at once if detector, camera or bus fail: a held object then falls"


def jobs(
    cameras: tuple[NamedCamera, ...], gripper: NamedGripper, params: Grasp, settings: GraspSettings, out: Path | None
) -> Sequence[DeviceGrasp | ReplayGrasp]:
    """Return one job per trial; InputError for what is impossible, or not allowed without --arm."""
    scene = params.scene if cameras[0].has(Capability.SCENE) else Grasp.scene
    touch_s = scene_file.load_of_kind(scene, KINDS).time.touch_s
    watchdog_ms = WATCHDOG_MS if params.watchdog_ms is None else params.watchdog_ms
    driver = _driver(params, gripper, watchdog_ms)
    timing = settings.timing(touch_s)
    _check_timing(timing, params)
    plan = (
        f"{params.controller} at {params.control_hz:g} Hz for {timing.end_ms * 1e-3:g} s, with at most"
        f" {params.max_current_ma} mA; {FALLS}"
    )
    require_arm(gripper, armed=params.arm or params.dry_run, plan=plan)
    replayed = gripper.has(Capability.STEPPED)  # a replay makes one file: the decisions, with the first finger's events
    trials = device_trials(KINDS, cameras[:1] if replayed else cameras, gripper, params, out, prefix="grasp-")
    if replayed:
        files = tuple(path for camera in cameras for path in camera.files)
        return [replay.grasp_of(each, files, settings, touch_s) for each in trials]
    frames_px = [] if params.calibration is None else [camera.frame_px() for camera in cameras]
    calibrations = read_calibrations(params.calibration, frames_px)
    view = settings.view(params)
    return [
        DeviceGrasp(
            **vars(each) | {"view": view},
            settings=settings,
            timing=timing,
            driver=driver,
            watchdog_ms=watchdog_ms,
            most_s=params.max_seconds,
            calibrations=calibrations,
            armed=params.arm,
        )
        for each in trials
    ]


def _check_timing(timing: Timing, params: Grasp) -> None:
    """Raise InputError for a timing that devices cannot keep."""
    if timing.every_ms > 1000 / SLOWEST_HZ:
        expected = f"at least {SLOWEST_HZ:g} Hz in real time"
        raise InputError(
            "too slow to detect hangs in time", where="--control-hz", expected=expected, found=str(params.control_hz)
        )
    if timing.end_ms > 1000 * params.max_seconds:
        raise InputError(
            "the grasp would take too long",
            where="--max-seconds",
            expected=f"at least the {timing.end_ms * 1e-3:g} s of contact, --lift-s and --balance-s",
            found=f"{params.max_seconds:g}",
        )


def _driver(params: Grasp, gripper: NamedGripper, watchdog_ms: int) -> RhP12RnSettings:
    """Return the gripper's settings; the answer timeout is short enough for two tries within the watchdog's time."""
    try:
        return gripper.settings(
            max_current_ma=params.max_current_ma,
            watchdog_ms=watchdog_ms,
            answer_ms=min(ANSWER_MS, watchdog_ms / 3),
            last_tick=LAST_TICK,
        )
    except ValueError as error:
        raise InputError(str(error), where="--watchdog-ms") from None


def check(trial: DeviceGrasp, *, force: bool) -> None:
    """Raise InputError for every fault of a grasp that can be found before a device is touched."""
    again, hint = "a grasp in real time", "--force replaces it, -o NAME writes to another file"
    session.refuse_taken(trial, again=again, hint=hint, force=force)
    session.check_room(trial, EVENTS_S, trial.timing.end_ms * 1e-3, "a shorter --balance-s")
    if trial.plan is not None and not trial.calibrations:
        return  # its scene provides the dot positions
    for finger in range(len(trial.cameras)):
        sensor = _sensor(trial, None, finger)
        if trial.settings.detector is not None:
            trial.settings.detector.require_dots(sensor["sensor/dot_xy_px"])


def dry_run(trials: Sequence[DeviceGrasp | ReplayGrasp], *, force: bool = False) -> Outcome:
    """Return what would be opened and done, checked as in a run; no device is touched, and no file written."""
    for trial in trials:
        if isinstance(trial, ReplayGrasp):
            replay.check(trial, force=force)
        else:
            check(trial, force=force)
    first = trials[0]
    settings = first.settings
    steps = f"{settings.control_hz:g} Hz, {settings.controller}"
    cameras: Sequence[NamedCamera]
    if isinstance(first, ReplayGrasp):
        cameras = (first.camera,)
        moves = [("gripper", "sim", f"{steps}, moves nothing")]
        watched = []
    else:
        cameras = first.cameras
        moves = [("gripper", str(first.gripper), f"{steps}, at most {first.driver.max_current_ma} mA")]
        watched = [("watchdog", f"{first.driver.watchdog_ms} ms", "without a command switch torque off")]
    detector = "no slip detector"
    if settings.detector is not None:
        detector = f"slip detected 1000 times per second by {settings.detector.path}"
    ends = ("end", f"after {first.timing.end_ms * 1e-3:g} s", FALLS)
    parts = [*(("camera", str(camera), detector) for camera in cameras), *moves, ends, *watched]
    return session.plan_shown(trials, parts, simulated=any(camera.shows_simulation() for camera in cameras))


def run(
    trial: DeviceGrasp,
    *,
    force: bool,
    progress: Progress,
    say: Callable[[str], None] = console.say,
    requests: "TrialRequests | None" = None,
) -> Outcome:
    """Grasp once, in real time, and record everything. say: receives a line if the computer was too slow.

    requests: a robot's program started the grasp, and may mark and end it.
    """
    check(trial, force=force)
    cameras, gripper, seeds = trial.cameras, trial.gripper, trial.seeds()
    settings, timing = trial.settings, trial.timing
    is_hardware = gripper.has(Capability.HARDWARE)
    if is_hardware and requests is None:
        session.wait_for_object(trial)
    with ExitStack() as opened:
        received = opened.enter_context(interrupts.signals_interrupt())
        view = opened.enter_context(live_view.opened(trial, f"grasp {trial.output.name}", moves=True))
        durations = {"lift_s": settings.lift_s, "balance_s": settings.balance_s}
        world, servo = open_peers(
            cameras[0], gripper, trial.plan, seeds, opened, armed=trial.armed, sends_truth=True, **durations
        )
        signals = opened.enter_context(interrupts.signals_counted(received))  # until here Ctrl-C aborts
        if requests is not None:
            opened.callback(requests.record_signals, signals)
        sensors = [_sensor(trial, world, finger) for finger in range(len(cameras))]
        parents = (*settings.parents(), *(header for camera in cameras for header in camera.parents()))
        detectors, controller = _process_settings(trial, sensors, world, servo)
        processes = GraspProcesses(detectors, controller, world)
        opened.callback(processes.close)
        if servo is not None and servo.pid is not None:
            set_realtime_priority(SERVO_PRIORITY, servo.pid)
        cameras_ready, gripper_ready = processes.begin(signals)
        with raised_priority(WATCHING_PRIORITY):  # the camera runs: time before `go` is lost to the grasp
            for note in (note for ready in cameras_ready for note in ready.notes):
                console.say(note)
            described = {"gripper": {"name": gripper.name, **gripper_ready.setup}}
            writers, recipes = _begin_files(trial, cameras_ready, described, sensors, parents)
            if view is not None:
                view.begin({**cameras_ready[0].sensor, **sensors[0], **NO_OFFSET})
            if is_hardware and not signals:
                console.say(f"{gripper} moves now; {FALLS}")
            key = opened.enter_context(session.gripper_key(moves=not signals))
        recorder = GraspRecorder(
            *(processes, world, writers, timing.end_ms, signals, key),
            lambda done: progress(done, timing.end_ms),
            view,
            WRITING_NICE if is_hardware else BESIDE_VIRTUAL,
            requests,
        )
        recorded = _record(recorder, gripper)
        processes.close()
        if view is not None:
            view.end(recorded.ended)
        if recorded.ended == session.ABORTED:
            for writer in writers:
                writer.discard()
            return Outcome([], recipes[0].simulated, made=False)
        datasets = {
            **recorded.datasets(),
            "capture/scheduling": f"detector {cameras_ready[0].scheduling}, controller {gripper_ready.scheduling}",
        }
        if world is not None:
            datasets |= session.lost_datasets({f"world.{why}": count for why, count in world.counted.items()})
        grasp_outcome, saved = _finish(writers, trial, recipes, recorded, datasets, world)
    return result_of(trial, recipes[0], recorded, datasets, grasp_outcome, saved, say, interrupted=any(signals))


def _process_settings(
    trial: DeviceGrasp,
    sensors: Sequence[dict[str, Any]],
    world: "VirtualWorld | None",
    servo: "VirtualGripper | None",
) -> tuple[list[DetectorSettings], ControllerSettings]:
    """Return the settings of the detectors and of the controller."""
    settings, timing, seeds = trial.settings, trial.timing, trial.seeds()
    of_finger = seeds, np.random.SeedSequence(seeds.entropy, spawn_key=(1,))  # of the prepared words of its camera
    detectors = [
        DetectorSettings(
            *(camera, of_finger[finger], sensors[finger], settings.detector),
            *(UNTIL_STOPPED if finger else timing.end_ms, finger),
        )
        for finger, camera in enumerate(trial.cameras)
    ]
    controller = ControllerSettings(
        trial.gripper,
        servo.port if servo is not None else trial.gripper.port,
        trial.driver,
        settings.law,
        timing,
        # same as the servo's watchdog: without real motion, a busy computer gets more time
        (VIRTUAL_WATCHDOG_FACTOR if servo is not None else 1) * trial.watchdog_ms,
        trial.most_s,
        HOST_TIME if world is None else world.time,
        settings.controller,
    )
    return detectors, controller


def _begin_files(
    trial: DeviceGrasp,
    cameras: Sequence[CameraReady],
    described: Mapping[str, Any],
    sensors: Sequence[Mapping[str, Any]],
    parents: tuple[Header, ...],
) -> tuple[list[RecordingWriter], list[Recipe]]:
    """Begin a file per finger; return their writers and recipes, whose content digests replace the rest at the end.

    described: the gripper, for the first file; parents: headers of the model and of replayed recordings, read earlier
    because reading is slow and the camera now runs.
    """
    writers, recipes = [], []
    parameters = trial.settings.parameters(trial)
    if len(cameras) > 1:
        parameters["trajectory"] = uuid4().hex
    for finger, ready in enumerate(cameras):
        sensor = {**ready.sensor, **sensors[finger], **NO_OFFSET}
        devices = {"camera": dict(ready.setup), **({} if finger else described)}
        recipe = session.make_recipe(
            *(METHOD, parameters, devices, sensor, {"watchdog_ms": trial.watchdog_ms}),
            parents=parents,
            simulated=trial.cameras[0].has(Capability.SIMULATED),
        )
        recipes.append(recipe)
        writers.append(RecordingWriter(trial.outputs[finger], sensor, recipe=recipe))
    return writers, recipes


def _record(recorder: GraspRecorder, gripper: NamedGripper) -> RecordedGrasp:
    """Let the gripper move and record until the end; after an error, say the torque state and leave the segments."""
    try:
        if not recorder.signals and (recorder.requests is None or not recorder.requests.end_reason):
            recorder.processes.go()
        return recorder.record()
    except BaseException as error:
        for writer in recorder.writers:
            writer.leave()
        recorder.processes.close()
        console.say(f"{gripper}: {recorder.processes.torque_words()}")
        raise session.with_hint(error, recorder.writers[0]) from None


def _sensor(trial: DeviceGrasp, world: "VirtualWorld | None", finger: int) -> dict[str, Any]:
    """Return the dot grid, which must be known before the camera is opened; InputError if it is not."""
    camera = trial.cameras[finger]
    if trial.calibrations:
        known = trial.calibrations[finger]
        sensor: Mapping[str, Any] = {"sensor/frame_px": np.array(known.frame_px, np.int32), **known.recorded()}
    elif world is not None:
        sensor = world.sensors[finger]
    else:
        sensor = camera.known_sensor()
    if "sensor/dot_xy_px" not in sensor:
        raise InputError(
            "the dot positions of this gel are unknown",
            where=str(camera),
            expected="a dot grid",
            hint=MAKE_GRID,
        )
    return dict(sensor)


def _finish(
    writers: Sequence[RecordingWriter],
    trial: DeviceGrasp,
    recipes: Sequence[Recipe],
    recorded: RecordedGrasp,
    datasets: Mapping[str, Any],
    world: "VirtualWorld | None",
) -> tuple[dict[str, Any], Path | None]:
    """Write the files; return the outcome of the grasp, if ground truth is known, and the file or the remaining folder.

    No file is written for a grasp without a step, nor for a second finger without a slice. If the first file cannot be
    written, the segments of the second stay too.
    """
    if not recorded.has_steps:
        for writer in writers:
            writer.discard()
        return {}, None
    late = [dict(datasets), *([recorded.second_datasets()] if recorded.second is not None else [])]
    grasp_outcome = None
    if world is not None and trial.plan is not None:
        for rows, truth in zip(late, recorded.truth_arrays(), strict=True):
            if truth:
                rows |= {**truth, "truth/sampled_parameters": world.sampled}
        grasp_outcome = recorded.outcome(trial.plan.sensor.mm_per_px)
    if grasp_outcome is not None:
        late[0]["control/outcome"] = json.dumps(grasp_outcome)
    try:
        saved = session.finish(writers[0], recipes[0], late[0], ended=recorded.ended)
    except BaseException:
        for writer in writers[1:]:
            writer.leave()
        raise
    for writer, recipe, rows, finger in zip(writers[1:], recipes[1:], late[1:], recorded.fingers[1:], strict=True):
        if finger.slices:
            session.finish(writer, recipe, rows, ended=recorded.ended)
        else:
            writer.discard()
    return grasp_outcome or {}, saved
