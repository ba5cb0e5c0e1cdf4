"""A grasp in real time, with devices or their virtual twins: checked, started, recorded, and reported at the end.

Three processes: the detector (detector_process.py) at 1000 Hz, the controller (controller_process.py) at 500 Hz, and
this one, which records (recorder.py). The detector and the law are those of a simulated grasp.

Latency is counted from the first event of the slice with slip to the last byte of the command. The event has the
camera's time; the host's clock is matched to it by the fastest delivery within 5 s. So the shortest time of words from
sensor to program (some 0.1 ms over USB) is not in it, and the clocks' drift in 5 s, 0.25 ms at 50 ppm, may be.
"""

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evetac_cli import console
from evetac_cli.devices.cameras import NamedCamera
from evetac_cli.devices.grippers import VIRTUAL_WATCHDOG_FACTOR, NamedGripper
from evetac_cli.devices.opening import open_peers, require_arm
from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import ANSWER_MS
from evetac_cli.errors import DeviceError, InputError
from evetac_cli.jobs import Outcome, Progress, outcome
from evetac_cli.kernels.grip.control import Control
from evetac_cli.params.grasp import Grasp
from evetac_cli.realtime.processes import at_niceness, set_realtime_priority
from evetac_cli.realtime.shared_time import HOST_TIME
from evetac_cli.stages import session
from evetac_cli.stages.grasp import replay, setup
from evetac_cli.stages.grasp.controller_process import ControllerSettings
from evetac_cli.stages.grasp.detector_process import DetectorSettings
from evetac_cli.stages.grasp.online_detector import dots_for
from evetac_cli.stages.grasp.recorder import GraspProcesses, RecordedGrasp, record
from evetac_cli.stages.trials import DeviceTrial, ReplayTrial, device_trials
from evetac_cli.store.calibration import MAKE_GRID, read_calibration
from evetac_cli.store.files import StageFile
from evetac_cli.store.provenance import Header, Recipe
from evetac_cli.store.segments import RecordingWriter

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.world import VirtualWorld

METHOD = 2  # of grasps in real time
EVENTS_S = 500_000  # that the disk must have room for
SLOWEST_HZ = 100.0  # below, the watchdog would be blind
SERVO_PRIORITY = 40  # hardware does not wait for a scheduler
RECORDER_NICE, BESIDE_VIRTUAL = -5, 15  # behind the detector; beside devices that take as much, behind all
LAST_TICK = 740  # closed; the law's own limit
FALLS = "torque is switched off at the end, and at once if detector, camera or bus fail: what is held then falls"


def jobs(
    camera: NamedCamera, gripper: NamedGripper, params: Grasp, out: Path | None
) -> Sequence[DeviceTrial | ReplayTrial]:
    """One recording for every trial; InputError for what cannot be done, or must not without --arm."""
    timing = setup.make_timing(params, None)
    if timing.latency_ms and not gripper.is_stepped:
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
        gripper_settings(params, gripper)
    except ValueError as error:
        raise InputError(str(error), where="--watchdog-ms") from None
    plan = (
        f"{params.controller} at {params.control_hz:g} Hz for {timing.end_ms * 1e-3:g} s, with at most"
        f" {params.max_current_ma} mA; {FALLS}"
    )
    require_arm(gripper, armed=params.arm or params.dry_run, plan=plan)
    trials = device_trials(("lift",), (camera,), gripper, params, out, prefix="grasp-")
    if gripper.is_stepped:
        return [ReplayTrial(each.inputs, each.output, each.number, each.seed, None, camera) for each in trials]
    return trials


def gripper_settings(params: Grasp, gripper: NamedGripper) -> RhP12RnSettings:
    """How the gripper is set up: an answer is waited for so long that two tries fit into the watchdog's time."""
    return gripper.settings(
        max_current_ma=params.max_current_ma,
        watchdog_ms=params.watchdog_ms,
        answer_ms=min(ANSWER_MS, params.watchdog_ms / 3),
        last_tick=LAST_TICK,
    )


def check(trial: DeviceTrial, params: Grasp, *, force: bool) -> None:
    """InputError for whatever can be known to be wrong with a grasp before a device is touched."""
    again, hint = "a grasp in real time", "--force replaces it, -o NAME writes elsewhere"
    session.refuse_taken(trial, again=again, hint=hint, force=force)
    session.check_room(trial, EVENTS_S, setup.make_timing(params, trial.plan).end_ms * 1e-3, "a shorter --balance-s")
    model_path = setup.model_path_for(params)
    setup.model_headers(model_path)
    if trial.plan is not None and params.calibration is None:
        return  # its scene will say where the dots are
    sensor = _sensor(trial, params, None)
    if model_path is not None:
        with StageFile(model_path, "model") as model:
            dots_for(model, sensor["sensor/dot_xy_px"])


def dry_run(trials: Sequence[DeviceTrial | ReplayTrial], params: Grasp, *, force: bool = False) -> Outcome:
    """What would be opened and done, checked as by a run; no device is touched, and no file written."""
    for trial in trials:
        if isinstance(trial, ReplayTrial):
            replay.check(trial, params, force=force)
        else:
            check(trial, params, force=force)
    first = trials[0]
    if isinstance(first, ReplayTrial):
        camera, gripper, current = first.camera, "sim", "moves nothing"
    else:
        camera, gripper = first.cameras[0], str(first.gripper)
        current = f"at most {params.max_current_ma} mA"
    model_path = setup.model_path_for(params)
    detector = "no slip detector" if model_path is None else f"slip detected 1000 times a second by {model_path}"
    parts = [
        ("camera", str(camera), detector),
        ("gripper", gripper, f"{params.control_hz:g} Hz, {params.controller}, {current}"),
        ("end", f"after {setup.make_timing(params, first.plan).end_ms * 1e-3:g} s", FALLS),
        ("watchdog", f"{params.watchdog_ms} ms", "of silence, and torque is off"),
    ]
    return session.plan_shown(trials, parts, simulated=camera.shows_simulation())


def run(trial: DeviceTrial, params: Grasp, *, force: bool, progress: Progress) -> Outcome:
    """Grasp once, in real time, and record everything."""
    check(trial, params, force=force)
    (camera,), gripper, seeds = trial.cameras, trial.gripper, trial.seeds()
    timing = setup.make_timing(params, trial.plan)
    if gripper.is_hardware:
        session.wait_for_object(trial)
    with ExitStack() as opened:
        came = opened.enter_context(session.signals_interrupt())
        view = opened.enter_context(setup.view_of(trial, params))
        durations = {"lift_s": params.lift_s, "balance_s": params.balance_s}
        world, servo = open_peers(
            camera, gripper, trial.plan, seeds, opened, armed=params.arm, tells_truth=True, **durations
        )
        signals = opened.enter_context(session.signals_counted(came))  # until here Ctrl-C breaks off
        sensor = _sensor(trial, params, world)
        parents = (*setup.model_headers(setup.model_path_for(params)), *camera.parents())
        detector = DetectorSettings(
            camera,
            seeds,
            sensor,
            setup.model_path_for(params),
            params.tracker,
            params.slip_threshold,
            timing.end_ms,
        )
        controller = ControllerSettings(
            servo.port if servo is not None else gripper.port,
            gripper.baud,
            gripper_settings(params, gripper),
            setup.make_law(params),
            timing,
            # as the servo's own: where nothing real moves, a busy computer is forgiven
            (VIRTUAL_WATCHDOG_FACTOR if servo is not None else 1) * params.watchdog_ms,
            params.max_seconds,
            HOST_TIME if world is None else world.time,
        )
        processes = GraspProcesses(detector, controller, world)
        opened.callback(processes.close)
        if servo is not None and servo.pid is not None:
            set_realtime_priority(SERVO_PRIORITY, servo.pid)
        camera_ready, gripper_ready = processes.begin(signals)
        for note in camera_ready.notes:
            console.say(note)
        sensor = {**camera_ready.sensor, **sensor, "t_offset": np.int64(0)}
        described = {"camera": dict(camera_ready.setup), "gripper": {"name": gripper.name, **gripper_ready.setup}}
        if view is not None:
            view.begin(sensor)
        recipe = _recipe(trial, params, described, sensor, parents)
        writer = RecordingWriter(trial.output, sensor, recipe=recipe)
        if gripper.is_hardware and not signals:
            console.say(f"{gripper} moves now; {FALLS}")
        key = opened.enter_context(session.gripper_key(moves=not signals))
        try:
            if not signals:
                processes.go()
            # A grasp lasts while its recorder is alive.
            with at_niceness(RECORDER_NICE if gripper.is_hardware else BESIDE_VIRTUAL):
                recorded = record(
                    *(processes, world, writer, timing.end_ms, signals, key),
                    lambda done: progress(done, timing.end_ms),
                    view,
                )
        except BaseException as error:
            writer.leave()
            processes.close()
            console.say(f"{gripper}: {processes.last_words()}")
            raise session.with_hint(error, writer) from None
        processes.close()
        if view is not None:
            view.end(recorded.ended)
        datasets = {
            **recorded.datasets(),
            "capture/scheduling": f"detector {camera_ready.scheduling}, controller {gripper_ready.scheduling}",
        }
        if world is not None:
            datasets |= session.lost_datasets({f"world.{why}": count for why, count in world.counted.items()})
        grasp_outcome, saved = _finish(writer, trial, recipe, recorded, datasets, world)
    return _result(trial, recipe, recorded, datasets, grasp_outcome, saved)


def _sensor(trial: DeviceTrial, params: Grasp, world: "VirtualWorld | None") -> dict[str, Any]:
    """The dot grid, which has to be known before the camera is opened; InputError if it is not."""
    (camera,) = trial.cameras
    if params.calibration is not None:
        sensor: Mapping[str, Any] = read_calibration(params.calibration, (640, 480)).arrays()
    elif world is not None:
        sensor = world.sensor
    else:
        sensor = camera.known_sensor()
    if "sensor/dot_xy_px" not in sensor:
        raise InputError(
            "it is not known where the dots of this gel are",
            where=str(camera),
            expected="a dot grid",
            hint=MAKE_GRID,
        )
    return dict(sensor)


def _recipe(
    trial: DeviceTrial,
    params: Grasp,
    described: Mapping[str, Any],
    sensor: Mapping[str, Any],
    parents: tuple[Header, ...],
) -> Recipe:
    """What is known of a grasp beforehand; its content stands in for the rest.

    parents: headers of the model and of what the camera plays. They take long to read, and now the camera runs.
    """
    (camera,) = trial.cameras
    control = Control(setup.make_law(params), params.control_hz)
    return session.make_recipe(
        METHOD,
        setup.grasp_parameters(trial, params, control),
        described,
        sensor,
        {"watchdog_ms": params.watchdog_ms},
        parents=parents,
        simulated=camera.is_simulated,
    )


def _finish(
    writer: RecordingWriter,
    trial: DeviceTrial,
    recipe: Recipe,
    recorded: RecordedGrasp,
    datasets: Mapping[str, Any],
    world: "VirtualWorld | None",
) -> tuple[dict[str, Any], Path | None]:
    """Make the file; returns what became of the grasp, where truth is known, and the file, or the folder that is left.

    No file is made of one without a step.
    """
    if not recorded.has_steps:
        writer.discard()
        return {}, None
    late = dict(datasets)
    grasp_outcome = None
    if world is not None and trial.plan is not None and (truth := recorded.truth_arrays()):
        late |= {**truth, "truth/sampled_parameters": world.sampled}
        grasp_outcome = recorded.outcome(trial.plan.sensor.mm_per_px)
    if grasp_outcome is not None:
        late["control/outcome"] = json.dumps(grasp_outcome)
    saved = session.finish(writer, recipe, late, ended=recorded.ended)
    return grasp_outcome or {}, saved


def _result(
    trial: DeviceTrial,
    recipe: Recipe,
    recorded: RecordedGrasp,
    datasets: Mapping[str, Any],
    grasp_outcome: Mapping[str, Any],
    saved: Path | None,
) -> Outcome:
    """The row of a grasp; an error or Ctrl-C goes on from here, and says what was saved."""
    result = None
    if recorded.has_steps:
        result = _row(trial, recipe, recorded, datasets, grasp_outcome)
    words = f"{recorded.slices:,} slices in {session.place(saved)}" if saved else "nothing was recorded"
    session.raise_end(recorded.error, recorded.ended, words, result, recorded.torque)
    if result is None:
        raise DeviceError("the grasp ended before its first step", found=recorded.ended)
    return result


def _row(
    trial: DeviceTrial,
    recipe: Recipe,
    recorded: RecordedGrasp,
    datasets: Mapping[str, Any],
    grasp_outcome: Mapping[str, Any],
) -> Outcome:
    """The figures of a grasp of which there is a file."""
    timing: dict[str, float | None] = {}
    for name, path, index in (
        ("latency_us_median", "latency_us", 0),
        ("latency_us_p99", "latency_us", 1),
        ("step_late_us_p99", "step_late_us", 1),
        ("command_us_median", "command_us", 0),
    ):
        values = datasets.get(f"capture/{path}")
        timing[name] = None if values is None else float(values[index])
    for name in ("slices_per_s", "commands_per_s"):
        timing[name] = float(datasets[f"capture/{name}"]) if f"capture/{name}" in datasets else None
    late, commands = recorded.late_slices, len(recorded.step_late_us)
    too_slow = session.too_slow(datasets, recorded.slices, late, commands, recorded.behind_s)
    if too_slow is not None:
        console.say(too_slow)
    return outcome(
        trial,
        made=True,
        simulated=recipe.simulated,
        slices=recorded.slices,
        ended=recorded.ended,
        **timing,
        command_misses=_whole(datasets.get("capture/command_misses")),
        latencies=len(recorded.latency_us),
        late_slices=late.count,
        too_slow=too_slow,
        scheduling=datasets["capture/scheduling"],
        **session.lost_columns(datasets),
        **grasp_outcome,
    )


def _whole(value: Any) -> int | None:
    return None if value is None else int(value)
