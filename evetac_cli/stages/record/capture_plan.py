"""What a recording from devices is about to do: shown, and refused where it would fail, before a device is touched."""

from collections.abc import Sequence
from dataclasses import asdict, fields

from evetac_cli.devices.cameras import CameraSettings
from evetac_cli.errors import InputError
from evetac_cli.jobs import Outcome
from evetac_cli.params.parameter import flag_of
from evetac_cli.params.recording import Record
from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.held import GripperCurrent
from evetac_cli.stages import session
from evetac_cli.stages.record.current_ramp import Hold
from evetac_cli.stages.trials import DeviceTrial
from evetac_cli.store.calibration import read_calibration

HOLDING_MA = 50.0  # where no current is asked for
SECONDS = 60.0  # room on the disk for so long, where nothing says how long it will take
INSTEAD = ("closing_ma", "holding_ma", "hold_s", "lowest_ma")  # what a current to follow stands in place of
TAKEN = "--resume goes on with a series, --force replaces it, -o NAME writes elsewhere"


def check(trial: DeviceTrial, params: Record, *, force: bool) -> None:
    """InputError for whatever can be known to be wrong with a trial before a device is touched."""
    for camera in trial.cameras:
        frame_px = camera.frame_px()
        if params.calibration is not None:
            read_calibration(params.calibration, frame_px)
    if trial.gripper.is_moved and asked_holding_ma(trial, params) is not None:
        make_hold(trial, params, 0.0)
    if params.preview:
        return
    session.refuse_taken(trial, again="a recording from a device", hint=TAKEN, force=force, resume=params.resume)
    hint = "--expected-event-rate and --seconds say what is needed"
    session.check_room(trial, params.expected_event_rate, _seconds(trial, params), hint)


def is_done(trial: DeviceTrial, params: Record, *, force: bool) -> bool:
    """Whether the trial of a series that goes on was recorded before."""
    return params.resume and not force and all(output.exists() for output in trial.outputs)


def asked_holding_ma(trial: DeviceTrial, params: Record) -> float | None:
    """The holding current that is set up; None where a simulated scene draws one for each trial."""
    return params.holding_ma if params.holding_ma is not None or trial.plan is not None else HOLDING_MA


def make_hold(trial: DeviceTrial, params: Record, sampled_ma: float) -> Hold:
    """How the object is handled; sampled_ma: what a scene draws. InputError for a current that cannot fall."""
    asked_ma = asked_holding_ma(trial, params)
    holding_ma = sampled_ma if asked_ma is None else asked_ma
    course = asked_course(trial, params)
    if course is not None:
        return Hold(params.closing_ma, holding_ma, params.hold_s, params.lowest_ma, course)
    if params.lowest_ma >= holding_ma:
        raise InputError(
            "the current would not fall",
            where="--lowest-ma",
            expected=f"less than the holding current, {holding_ma:g} mA (--holding-ma)",
            found=f"{params.lowest_ma:g} mA",
        )
    return Hold(params.closing_ma, holding_ma, params.hold_s, params.lowest_ma)


def asked_course(trial: DeviceTrial, params: Record) -> GripperCurrent | None:
    """The current that the gripper follows: that of --current-of, else of the scene, if it names one.

    InputError if the scene of --current-of names none, or for an option that then has no effect.
    """
    if params.current_of is not None:
        named = f"--current-of {params.current_of}"
        course = scene_file.load(params.current_of).gripper.current
        if course is None:
            raise InputError(
                "this scene names no current for the gripper",
                where="--current-of",
                expected="a scene with gripper.current, as grip-steps",
                found=params.current_of,
            )
    else:
        named = f"--scene {params.scene}"
        course = None if trial.plan is None else trial.plan.scene.gripper.current
    for item in fields(params) if course is not None else ():
        if item.name in INSTEAD and getattr(params, item.name) != item.default:
            expected = "one of the two: the gripper follows the scene's current from the first command to the last"
            raise InputError(f"has no effect with {named}", where=flag_of(item), expected=expected)
    return course


def dry_run(trials: Sequence[DeviceTrial], params: Record, *, force: bool = False) -> Outcome:
    """What would be opened and done, checked as by a run; no device is touched, and no file written."""
    for trial in trials:
        if not is_done(trial, params, force=force):
            check(trial, params, force=force)
    first = trials[0]
    given = ", ".join(f"{name} {value}" for name, value in asdict(settings(params)).items() if value is not None)
    seconds = _seconds(first, params)
    room_mb = session.needed_bytes(params.expected_event_rate, seconds) / 1e6
    rate = f"{params.expected_event_rate:,.0f} events/s for {seconds:g} s"
    parts = [
        *(("camera", str(camera), given or "the driver's settings") for camera in first.cameras),
        ("gripper", str(first.gripper), _ramp_words(first, params) if first.gripper.is_moved else "not moved"),
        ("end", _end(first, params), f"room for {room_mb:,.0f} MB is asked for, {rate}"),
    ]
    return session.plan_shown(trials, parts, simulated=any(camera.shows_simulation() for camera in first.cameras))


def _seconds(trial: DeviceTrial, params: Record) -> float:
    """How long a recording is taken to be where room on the disk is asked for."""
    if params.seconds is not None:
        return params.seconds
    course = _followed(trial, params)
    return SECONDS if course is None else course.ends_s


def _followed(trial: DeviceTrial, params: Record) -> GripperCurrent | None:
    """The current that the gripper follows, if it is moved at all."""
    return asked_course(trial, params) if trial.gripper.is_moved else None


def _end(trial: DeviceTrial, params: Record) -> str:
    """What ends a recording, in words."""
    if params.seconds is not None:
        return f"after {params.seconds:g} s"
    course = _followed(trial, params)
    lets_go = "it lets go" if course is None else f"the gripper has followed its current, {course.ends_s:g} s"
    ends = [lets_go] * trial.gripper.is_moved + ["the recording is over"] * trial.cameras[0].is_replay
    return "until " + ", or ".join([*ends, "Ctrl-C"])


def _ramp_words(trial: DeviceTrial, params: Record) -> str:
    """What the gripper does, in words."""
    course = asked_course(trial, params)
    if course is not None:
        highest, lowest = max(course.ma), min(course.ma)
        return f"follows a current of {lowest:g} to {highest:g} mA for {course.ends_s:g} s"
    asked_ma = asked_holding_ma(trial, params)
    holding = f"{asked_ma} mA" if asked_ma is not None else "the current of its scene"
    return (
        f"closes with {params.closing_ma:g} mA until contact, holds with {holding} for {params.hold_s:g} s,"
        f" lets the current fall to {params.lowest_ma:g} mA"
    )


def settings(params: Record) -> CameraSettings:
    """Thresholds and readout rate of the camera, as the flags say."""
    return CameraSettings(params.threshold_on, params.threshold_off, params.readout_rate)
