"""The plan of a recording from devices: shown, and refused if it would fail, before a device is touched."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

from evetac_cli.commands.parameter import flag_of
from evetac_cli.commands.record import Record
from evetac_cli.devices.cameras import CameraSettings
from evetac_cli.errors import InputError
from evetac_cli.jobs import Outcome
from evetac_cli.names import Capability
from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.held import GripperCurrent
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.store.calibration import Calibration, read_calibrations
from evetac_cli.trials import session
from evetac_cli.trials.record.current_ramp import Hold
from evetac_cli.trials.trial import DeviceTrial

HOLDING_MA = 50.0  # default holding current
SECONDS = 60.0  # duration for the disk space check, if no duration is known
INSTEAD = ("closing_ma", "holding_ma", "hold_s", "lowest_ma")  # options that a followed current replaces
TAKEN = "--resume continues a series, --force replaces it, -o NAME writes to another file"
NAME_TAKEN = "start a trial with another name; record --listen --force replaces this one"


@dataclass(frozen=True)
class DeviceRecording(DeviceTrial):
    """A trial that is recorded from devices.

    settings: of the cameras; hold: None if no gripper moves; calibrations: of each camera, to store with it.

    seconds: the longest duration; events_per_s: the event rate that the disk must have room for.

    resume: continue a series; armed: whether a real gripper may be moved.
    """

    settings: CameraSettings
    hold: Hold | None
    calibrations: tuple[Calibration, ...]
    seconds: float | None
    events_per_s: float
    resume: bool
    armed: bool

    @classmethod
    def of(cls, trial: DeviceTrial, params: Record) -> "DeviceRecording":
        """Return a trial with the settings of the flags; InputError for settings that do not fit together."""
        frames_px = [] if params.calibration is None else [camera.frame_px() for camera in trial.cameras]
        return cls(
            **vars(trial),
            settings=camera_settings(params),
            hold=_hold(params, trial.plan) if trial.gripper.has(Capability.MOVED) else None,
            calibrations=read_calibrations(params.calibration, frames_px),
            seconds=params.seconds,
            events_per_s=params.expected_event_rate,
            resume=params.resume,
            armed=params.arm,
        )

    @property
    def expected_s(self) -> float:
        """The duration assumed for the disk space check, in s."""
        if self.seconds is not None:
            return self.seconds
        course = None if self.hold is None else self.hold.course
        return SECONDS if course is None else course.ends_s


def camera_settings(params: Record) -> CameraSettings:
    """Return thresholds and readout rate of the camera from the flags."""
    return CameraSettings(params.threshold_on, params.threshold_off, params.readout_rate)


def _hold(params: Record, plan: Plan | None) -> Hold:
    """Return how the flags and the scene handle the object; InputError for unused options."""
    holding_ma = HOLDING_MA if plan is None else None
    if params.holding_ma is not None:
        holding_ma = params.holding_ma
    return Hold(params.closing_ma, holding_ma, params.hold_s, params.lowest_ma, _course(params, plan))


def _course(params: Record, plan: Plan | None) -> GripperCurrent | None:
    """Return the current that the gripper follows: that of --current-of, or of the scene, if it names one.

    InputError if the scene of --current-of names none, or for an option without effect.
    """
    if params.current_of is not None:
        flag = f"--current-of {params.current_of}"
        course = scene_file.load(params.current_of).gripper.current
        if course is None:
            raise InputError(
                "this scene defines no current for the gripper",
                where="--current-of",
                expected="a scene with gripper.current, for example grip-steps",
                found=params.current_of,
            )
    else:
        flag = f"--scene {params.scene}"
        course = None if plan is None else plan.scene.gripper.current
    for item in fields(params) if course is not None else ():
        if item.name in INSTEAD and getattr(params, item.name) != item.default:
            expected = "only one of them: the gripper follows the scene's current from the first command to the last"
            raise InputError(f"has no effect with {flag}", where=flag_of(item), expected=expected)
    return course


def check(trial: DeviceRecording, *, force: bool, taken: str = TAKEN) -> None:
    """Raise InputError for every fault of a trial's outputs that can be found before a device is touched.

    taken: the hint if an output exists.
    """
    for camera in trial.cameras:
        camera.frame_px()  # for a replay, this checks that the recording can be read
    session.refuse_taken(trial, again="a recording from a device", hint=taken, force=force, resume=trial.resume)
    hint = "--expected-event-rate and --seconds set the room that is needed"
    session.check_room(trial, trial.events_per_s, trial.expected_s, hint)


def is_done(trial: DeviceRecording, *, force: bool) -> bool:
    """Return whether the trial of a resumed series was recorded before."""
    return trial.resume and not force and all(output.exists() for output in trial.outputs)


def dry_run(trials: Sequence[DeviceRecording], *, force: bool, writes: bool) -> Outcome:
    """Return what would be opened and done, checked as in a run; no device is touched, and no file written.

    writes: whether a run would write files; a preview does not.
    """
    for trial in trials:
        if writes and not is_done(trial, force=force):
            check(trial, force=force)
    first = trials[0]
    settings = ", ".join(f"{name} {value}" for name, value in first.settings.explicit_values().items())
    room_mb = session.needed_bytes(first.events_per_s, first.expected_s) / 1e6
    rate = f"{first.events_per_s:,.0f} events/s for {first.expected_s:g} s"
    parts = [
        *(("camera", str(camera), settings or "the driver's settings") for camera in first.cameras),
        ("gripper", str(first.gripper), "not moved" if first.hold is None else str(first.hold)),
        ("end", _end(first), f"needs room for {room_mb:,.0f} MB, {rate}"),
    ]
    return session.plan_shown(trials, parts, simulated=any(camera.shows_simulation() for camera in first.cameras))


def _end(trial: DeviceRecording) -> str:
    """Return a phrase on what ends a recording."""
    if trial.seconds is not None:
        return f"after {trial.seconds:g} s"
    ends = []
    if trial.hold is not None:
        course = trial.hold.course
        ends.append(
            "the gripper lets go" if course is None else f"the gripper has followed its current, {course.ends_s:g} s"
        )
    if trial.cameras[0].has(Capability.REPLAY):
        ends.append("the recording is over")
    return "until " + ", or ".join([*ends, "Ctrl-C"])
