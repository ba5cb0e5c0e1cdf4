"""What a recording from devices is about to do: shown, and refused where it would fail, before a device is touched."""

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

HOLDING_MA = 50.0  # where no current is asked for
SECONDS = 60.0  # room on the disk for so long, where nothing says how long it will take
INSTEAD = ("closing_ma", "holding_ma", "hold_s", "lowest_ma")  # what a current to follow stands in place of
TAKEN = "--resume goes on with a series, --force replaces it, -o NAME writes elsewhere"
NAME_TAKEN = "start another name; record --listen --force replaces it"


@dataclass(frozen=True)
class HoldRequest:
    """How the object is to be handled; holding_ma: None where a simulated scene draws it for each trial."""

    closing_ma: int
    holding_ma: float | None
    hold_s: float
    lowest_ma: float
    course: GripperCurrent | None  # that the gripper follows instead of closing, holding and letting the current fall

    @classmethod
    def of(cls, params: Record, plan: Plan | None) -> "HoldRequest":
        """As the flags and the scene say; InputError for a current that cannot fall, and for options without effect."""
        asked_ma = params.holding_ma if params.holding_ma is not None or plan is not None else HOLDING_MA
        request = cls(params.closing_ma, asked_ma, params.hold_s, params.lowest_ma, _course(params, plan))
        if asked_ma is not None:
            request.hold(asked_ma)
        return request

    def hold(self, sampled_ma: float, fall_factor: float = 1.0) -> Hold:
        """The hold of one trial; both are what its scene draws. InputError for a current that cannot fall."""
        holding_ma = sampled_ma if self.holding_ma is None else self.holding_ma
        if self.course is None and self.lowest_ma >= holding_ma:
            raise InputError(
                "the current would not fall",
                where="--lowest-ma",
                expected=f"less than the holding current, {holding_ma:g} mA (--holding-ma)",
                found=f"{self.lowest_ma:g} mA",
            )
        return Hold(self.closing_ma, holding_ma, self.hold_s, self.lowest_ma, self.course, fall_factor)

    def __str__(self) -> str:
        if self.course is not None:
            lowest, highest = min(self.course.ma), max(self.course.ma)
            return f"follows a current of {lowest:g} to {highest:g} mA for {self.course.ends_s:g} s"
        holding = f"{self.holding_ma} mA" if self.holding_ma is not None else "the current of its scene"
        return (
            f"closes with {self.closing_ma:g} mA until contact, holds with {holding} for {self.hold_s:g} s,"
            f" lets the current fall to {self.lowest_ma:g} mA"
        )


@dataclass(frozen=True)
class DeviceRecording(DeviceTrial):
    """A trial that is recorded from devices.

    settings: of the cameras; hold: None where no gripper is moved; calibrations: of each camera, to store with it;
    seconds: after which it ends, if anything else does not; events_per_s: that the disk must have room for; resume: go
    on with a series; armed: whether real fingers may be moved.
    """

    settings: CameraSettings
    hold: HoldRequest | None
    calibrations: tuple[Calibration, ...]
    seconds: float | None
    events_per_s: float
    resume: bool
    armed: bool

    @classmethod
    def of(cls, trial: DeviceTrial, params: Record) -> "DeviceRecording":
        """A trial as the flags say; InputError for what does not fit together."""
        frames_px = [] if params.calibration is None else [camera.frame_px() for camera in trial.cameras]
        return cls(
            **vars(trial),
            settings=camera_settings(params),
            hold=HoldRequest.of(params, trial.plan) if trial.gripper.has(Capability.MOVED) else None,
            calibrations=read_calibrations(params.calibration, frames_px),
            seconds=params.seconds,
            events_per_s=params.expected_event_rate,
            resume=params.resume,
            armed=params.arm,
        )

    @property
    def expected_s(self) -> float:
        """How long it is taken to be where room on the disk is asked for."""
        if self.seconds is not None:
            return self.seconds
        course = None if self.hold is None else self.hold.course
        return SECONDS if course is None else course.ends_s


def camera_settings(params: Record) -> CameraSettings:
    """Thresholds and readout rate of the camera, as the flags say."""
    return CameraSettings(params.threshold_on, params.threshold_off, params.readout_rate)


def _course(params: Record, plan: Plan | None) -> GripperCurrent | None:
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
        course = None if plan is None else plan.scene.gripper.current
    for item in fields(params) if course is not None else ():
        if item.name in INSTEAD and getattr(params, item.name) != item.default:
            expected = "one of the two: the gripper follows the scene's current from the first command to the last"
            raise InputError(f"has no effect with {named}", where=flag_of(item), expected=expected)
    return course


def check(trial: DeviceRecording, *, force: bool, taken: str = TAKEN) -> None:
    """InputError for whatever can be known to be wrong with the outputs of a trial before a device is touched.

    taken: what to do where one exists.
    """
    for camera in trial.cameras:
        camera.frame_px()  # of a recording that is played: that it can be read
    session.refuse_taken(trial, again="a recording from a device", hint=taken, force=force, resume=trial.resume)
    hint = "--expected-event-rate and --seconds say what is needed"
    session.check_room(trial, trial.events_per_s, trial.expected_s, hint)


def is_done(trial: DeviceRecording, *, force: bool) -> bool:
    """Whether the trial of a series that goes on was recorded before."""
    return trial.resume and not force and all(output.exists() for output in trial.outputs)


def dry_run(trials: Sequence[DeviceRecording], *, force: bool, writes: bool) -> Outcome:
    """What would be opened and done, checked as by a run; no device is touched, and no file written.

    writes: whether a run would write files, as a preview does not.
    """
    for trial in trials:
        if writes and not is_done(trial, force=force):
            check(trial, force=force)
    first = trials[0]
    given = ", ".join(f"{name} {value}" for name, value in first.settings.given().items())
    room_mb = session.needed_bytes(first.events_per_s, first.expected_s) / 1e6
    rate = f"{first.events_per_s:,.0f} events/s for {first.expected_s:g} s"
    parts = [
        *(("camera", str(camera), given or "the driver's settings") for camera in first.cameras),
        ("gripper", str(first.gripper), "not moved" if first.hold is None else str(first.hold)),
        ("end", _end(first), f"room for {room_mb:,.0f} MB is asked for, {rate}"),
    ]
    return session.plan_shown(trials, parts, simulated=any(camera.shows_simulation() for camera in first.cameras))


def _end(trial: DeviceRecording) -> str:
    """What ends a recording, in words."""
    if trial.seconds is not None:
        return f"after {trial.seconds:g} s"
    ends = []
    if trial.hold is not None:
        course = trial.hold.course
        ends.append("it lets go" if course is None else f"the gripper has followed its current, {course.ends_s:g} s")
    if trial.cameras[0].has(Capability.REPLAY):
        ends.append("the recording is over")
    return "until " + ", or ".join([*ends, "Ctrl-C"])
