"""record: write the events of one trial to a file: of a scene, of given dots, of devices or of a foreign event file.

Each of the sources is a type of job with its own module: SimulatedTrial (simulated.py), GivenDots (given_dots.py),
DeviceRecording (capture.py) and ImportJob (imported.py). With --preview, the job is a Preview: the camera's view is
shown, and nothing is written. With --listen, a robot's program starts trials of devices, any number of them
(trials/listen).
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from evetac_cli.commands.parameter import refuse_unused
from evetac_cli.commands.record import Record
from evetac_cli.devices import Rig, losses
from evetac_cli.devices import cameras as named_cameras
from evetac_cli.devices import grippers as named_grippers
from evetac_cli.devices.cameras import CameraSettings, NamedCamera
from evetac_cli.devices.grippers import NamedGripper, NoGripper
from evetac_cli.devices.opening import open_rig, require_arm
from evetac_cli.devices.series_camera import SeriesCamera
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, SLICES_PER_S
from evetac_cli.formats.read.bags.bag_files import is_bag_folder
from evetac_cli.jobs import Job, Outcome, Progress, Stage, silent
from evetac_cli.names import Capability
from evetac_cli.store.calibration import Calibration, read_calibration
from evetac_cli.store.files import output_path, up_to_date
from evetac_cli.store.recordings import slip_grid
from evetac_cli.trials import live_view, part_costs
from evetac_cli.trials.listen import Listening, listen, listening
from evetac_cli.trials.live_view import LiveView
from evetac_cli.trials.record import capture, capture_plan, given_dots, imported, simulated
from evetac_cli.trials.record.capture_plan import DeviceRecording, camera_settings
from evetac_cli.trials.record.given_dots import GivenDots
from evetac_cli.trials.record.imported import ImportJob
from evetac_cli.trials.trial import DETAILS, SimulatedTrial, Trial, device_trials, for_people, simulated_trials
from evetac_cli.trials.trial import OUTPUT as OUTPUT

METHOD = simulated.METHOD
WATCHDOG_STEP_MS = 20  # unit of the register Bus Watchdog
LONGEST_S = 3600.0  # limit for a trial that a robot's program started and does not stop; --seconds sets another
SCENE_KINDS = ("ramp", "hold", "press", "rub", "tone")  # lift scenes are for `grasp`
NEWS_SLICES = 100  # number of slices of a preview after which losses are checked


@dataclass(frozen=True)
class Preview(Trial):
    """A trial whose camera is shown for some seconds, or if they are None until its stream ends."""

    exclusive = True
    camera: NamedCamera
    settings: CameraSettings
    calibration: Calibration | None
    seconds: float | None

    @classmethod
    def of(cls, trial: Trial, camera: NamedCamera, params: Record) -> "Preview":
        """Return a preview with the settings of the flags.

        InputError for a calibration that does not fit the camera.
        """
        calibration = None
        if params.calibration is not None:
            calibration = read_calibration(params.calibration, camera.frame_px())
        return cls(
            *(trial.inputs, trial.output, trial.number, trial.seed, trial.plan),
            *(camera, camera_settings(params), calibration, params.seconds),
            view=trial.view,
        )

    @property
    def shows_simulation(self) -> bool:
        """Whether the camera shows a simulation, or a recording of one."""
        return self.camera.shows_simulation()


def jobs(files: list[Path], params: Record, out: Path | None) -> Sequence[Job]:
    """Return one job per object and trial, or one for the imported file; InputError for options of other sources."""
    cameras, gripper = devices(params)
    _refuse_unused(params, cameras, gripper)
    if params.dots is not None:
        return [GivenDots((params.dots,), output_path(params.dots, OUTPUT, out))]
    if params.source is not None:
        if params.source.is_dir() and not is_bag_folder(params.source):
            raise InputError("this is a folder", where=str(params.source), expected="an event file")
        return [ImportJob((params.source,), output_path(params.source, OUTPUT, out))]
    shows = params.preview and not params.dry_run
    if cameras[0].has(Capability.STEPPED):
        scenes = simulated_trials(SCENE_KINDS, params, out, params.tones)
        return [Preview.of(trial, cameras[0], params) for trial in scenes] if shows else scenes
    require_arm(gripper, armed=params.arm or params.dry_run or params.preview)  # dry run and preview move nothing
    trials = device_trials(("ramp", "hold"), cameras, gripper, params, out)
    if params.listen:
        return [_listening([DeviceRecording.of(each, params) for each in trials], params, out)]
    return [Preview.of(each, cameras[0], params) if shows else DeviceRecording.of(each, params) for each in trials]


def _listening(trials: list[DeviceRecording], params: Record, out: Path | None) -> Listening:
    """Return trials that a robot's program starts; cameras without a scene of their own stay open between them."""
    if params.resume:
        raise InputError("has no effect with --listen: each start names its file", where="--resume")
    job = listening(trials, out, params.listen_port, None if params.seconds is not None else LONGEST_S)
    (first,) = trials
    cameras = tuple(
        each if each.has(Capability.SCENE) or each.has(Capability.REPLAY) else SeriesCamera(each, first.settings)
        for each in first.cameras
    )
    return replace(job, first=replace(first, cameras=cameras))


def _refuse_unused(params: Record, cameras: Sequence[NamedCamera], gripper: NamedGripper) -> None:
    """Raise InputError for an option that applies to nothing in this run."""
    if params.dots is not None:
        refuse_unused(params, {Capability.DOTS}, f"--from-dots {params.dots}", never={Capability.GRASPED})
        return
    if params.source is not None:
        refuse_unused(params, {Capability.IMPORT}, f"--from {params.source}", never={Capability.GRASPED})
        return
    has = {capability for camera in cameras for capability in camera.capabilities}
    if params.preview:
        has.add(Capability.PREVIEW)
    elif Capability.DEVICE in has:
        has |= {Capability.RECORDED} | gripper.capabilities
        if params.listen:
            has.add(Capability.LISTENING)
    shown = ", --preview" * params.preview or ", --live" * params.live
    flags = f"--camera {params.camera}{params.gripper_flag()}{shown}"
    refuse_unused(params, has, flags, never={Capability.GRASPED})


def devices(params: Record) -> tuple[tuple[NamedCamera, ...], NamedGripper]:
    """Return the named devices; InputError for unknown names, and for flags that do not fit them."""
    cameras = named_cameras.parse_several(params.camera)
    gripper = named_grippers.parse(params.gripper if params.gripper is not None else cameras[0].own_gripper)
    if params.watchdog_ms is not None:
        if params.watchdog_ms % WATCHDOG_STEP_MS:
            raise InputError(
                "not a valid watchdog time",
                where="--watchdog-ms",
                expected="a multiple of 20 ms",
                found=str(params.watchdog_ms),
            )
        gripper = replace(gripper, watchdog_ms=params.watchdog_ms)
    if any(camera.has(Capability.STEPPED) != gripper.has(Capability.STEPPED) for camera in cameras):
        raise InputError(
            "a simulated camera and a real gripper (or vice versa) cannot be combined",
            where="--camera, --gripper",
            expected="both sim, or neither",
            found=f"{params.camera}, {gripper}",
        )
    if params.source is not None and params.dots is not None:
        raise InputError("two files cannot be combined", where="--from, --from-dots", found=f"{params.source}")
    of_file = "--from" if params.source is not None else "--from-dots" if params.dots is not None else ""
    if of_file and not cameras[0].has(Capability.STEPPED):
        raise InputError("a file and a camera cannot be combined", where=f"{of_file}, --camera", found=params.camera)
    scenes = any(camera.has(Capability.SCENE) for camera in cameras)
    if len(cameras) > 1 and (scenes or params.preview):
        expected = "one camera of a simulated world" if scenes else "one camera to preview"
        raise InputError("too many cameras", where="--camera", expected=expected, found=params.camera)
    return cameras, gripper


def dry_run(jobs: Sequence[Job], params: Record, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return what would be built or done and its cost; it refuses everything that a run refuses."""
    each = [job.first if isinstance(job, Listening) else job for job in jobs]
    trials = [job for job in each if isinstance(job, DeviceRecording)]
    if trials:
        return capture_plan.dry_run(trials, force=force, writes=not params.preview)
    scenes = [job for job in jobs if isinstance(job, SimulatedTrial)]
    if not scenes:
        raise InputError("a file has no plan to show", where="--dry-run", hint="leave out the file, or --dry-run")
    for trial in scenes:
        if not params.preview:
            up_to_date(trial.output, simulated.make_recipe(trial), force=force)
    return part_costs.dry_run(scenes, simulated.play_through, progress)


def run(job: Job, params: Record, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Record one trial, or import one file; with --preview, only show the camera of the trial."""
    match job:
        case Preview():
            return _show(job)
        case SimulatedTrial():
            return simulated.run(job, force=force, progress=progress)
        case DeviceRecording():
            return capture.run(job, force=force, progress=progress)
        case Listening():
            return listen(job, partial(capture.run, force=force, progress=silent))
        case ImportJob():
            return imported.run(job, params, force=force, progress=progress)
        case GivenDots():
            return given_dots.run(job, params, force=force, progress=progress)
    raise TypeError(f"record has no {type(job).__name__}")


def _show(trial: Preview) -> Outcome:
    """Show the camera until the seconds are over, its stream ends, or Ctrl-C."""
    camera = trial.camera
    with live_view.opened(trial, f"preview of {camera}", moves=False) as view:
        assert view is not None
        rig = open_rig(camera, NoGripper(), trial.settings, trial.plan, trial.seeds())
        try:
            sensor = rig.known_sensor()
            if trial.calibration is not None:
                sensor |= trial.calibration.recorded()
            view.begin(sensor)
            most = round(SLICES_PER_S * trial.seconds) if trial.seconds is not None else None
            row = _watch(rig, view, most, paced=camera.has(Capability.STEPPED))
        except KeyboardInterrupt:
            raise KeyboardInterrupt("stopped; nothing was written") from None
        finally:
            rig.close()
    row = {"camera": str(camera), **row}
    return Outcome([row], rig.simulated or any(parent["simulated"] for parent in rig.parents), {"shown": 1})


def _watch(rig: Rig, view: LiveView, most: int | None, *, paced: bool) -> dict[str, Any]:
    """Read and show slices; `paced` holds a simulation back to real time."""
    slices = total = 0
    began_s = time.monotonic()
    camera = rig.camera
    while slices != most and (events := camera.read()) is not None:
        slices += 1
        total += events.size
        view.add_slice(events, camera.time.now_s() * 1e6 - camera.host_us(slices * SLICE_US))
        if paced:
            time.sleep(max(0.0, began_s + slices * 1e-3 - time.monotonic()))
        if slices % NEWS_SLICES == 0:
            view.lost(rig.counted())
    passed_s = time.monotonic() - began_s
    return {
        "slices": slices,
        "events": total,
        "events_per_s": total / (slices * 1e-3) if slices else None,
        "slices_per_s": slices / passed_s,
        "lost": losses.events_lost(rig.counted()),
        "lost_why": losses.reasons(rig.counted()),
    }


STAGE = Stage(
    jobs,
    run,
    for_people=for_people,
    details=DETAILS,
    warnings=slip_grid.once,
    dry_run=dry_run,
    dry_run_for_people=part_costs.for_people,
)
