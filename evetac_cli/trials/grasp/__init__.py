"""grasp: detect slip at 1000 Hz and control the gripper at 500 Hz (paper, section VII).

A grasp has three phases: light contact, lifting, balancing. The detector applies the kernels of `track` and `featurize`
to live slices instead of a file (online_detector.py). It counts slices with slip, and the controller checks every 2 ms
whether the count has risen (loop.py). With two cameras, one looks at each finger, and each has a detector
(loop.py; in real time grasp_processes.py). The flags are resolved once (settings.py) and stored in the trials.
One module runs each kind of trial: SimulatedGrasp (simulated.py), DeviceGrasp (real_time.py) and ReplayGrasp
(replay.py).
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.parameter import refuse_unused
from evetac_cli.devices import cameras as named_cameras
from evetac_cli.devices import grippers as named_grippers
from evetac_cli.devices.cameras import NamedCamera
from evetac_cli.devices.grippers import NamedGripper
from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, Stage, silent
from evetac_cli.names import Capability
from evetac_cli.sim.setup import scene_file
from evetac_cli.store.recordings import slip_grid
from evetac_cli.trials import part_costs
from evetac_cli.trials.grasp import simulated
from evetac_cli.trials.grasp.settings import DeviceGrasp, GraspSettings, ReplayGrasp, SimulatedGrasp
from evetac_cli.trials.listen import Listening, listen, listening
from evetac_cli.trials.trial import DETAILS, for_people, grid_notes, on_resolving_grid, simulated_trials
from evetac_cli.trials.trial import OUTPUT as OUTPUT

METHOD = simulated.METHOD
FINGERS = 2
DETAILS_OF_MANY = frozenset(  # columns of grasp_outcome, of which a terminal of 80 columns shows two at a time
    (
        *("slices", "slices_with_slip", "moved_lift_mm", "reopened_share", "motor_work_j"),
        *("opening_after_lift_ticks", "opening_after_balance_ticks", "opening_after_lift_mm"),
        *("opening_after_balance_mm", "force_touch_n", "force_lift_n", "holding_end_n", "over_holding_mean"),
        *("over_holding_peak", "slip_events", "false_slip_events"),
    )
)
# must be the same for both cameras
_OF_A_KIND = (Capability.STEPPED, Capability.REPLAY, Capability.SCENE, Capability.SIMULATED)
NOT_OF_GRASP = frozenset(
    {Capability.IMPORT, Capability.RECORDED, Capability.PREVIEW, Capability.MOVED}
)  # capabilities that only `record` uses


def jobs(files: list[Path], params: Grasp, out: Path | None) -> Sequence[Job]:
    """Return one job per object and trial."""
    cameras = _cameras(params)
    camera = cameras[0]
    _refuse_unused(params, camera)
    settings = GraspSettings.of(params)
    if settings.detector is None:
        refuse_unused(params, set(Capability) - {Capability.DETECTOR}, f"--controller {params.controller}")
    gripper = _gripper(params, camera)
    if not camera.has(Capability.STEPPED):
        from evetac_cli.trials.grasp import real_time  # imported here because it loads all device code

        grasps = real_time.jobs(cameras, gripper, params, settings, out)
        if params.listen:  # only with devices, as _refuse_unused ensures
            return [listening([each for each in grasps if isinstance(each, DeviceGrasp)], out, params.listen_port)]
        return grasps
    trials = simulated_trials(("lift",), params, out, fingers=len(cameras))
    if params.node_pitch_mm is None and not scene_file.states_pitch(params.scene):
        trials = [on_resolving_grid(trial) for trial in trials]
    return [
        SimulatedGrasp(
            **vars(trial) | {"view": settings.view(params)},
            settings=settings,
            timing=settings.timing(trial.plan.scene.time.touch_s),
        )
        for trial in trials
    ]


def _cameras(params: Grasp) -> tuple[NamedCamera, ...]:
    """Return the camera of the first finger and, if named, of the second; InputError if they do not fit together."""
    cameras = named_cameras.parse_several(params.camera)
    if len(cameras) > FINGERS:
        expected = "one camera, or one for each of the two fingers"
        raise InputError("too many cameras", where="--camera", expected=expected, found=params.camera)
    kinds = {tuple(camera.has(each) for each in (*_OF_A_KIND,)) for camera in cameras}
    if len(kinds) > 1:
        expected = (
            "both simulated, both recordings, or both in real time; if virtual, both in the same scene or without one"
        )
        raise InputError(
            "these cameras cannot be combined in a grasp", where="--camera", expected=expected, found=params.camera
        )
    return cameras


def _refuse_unused(params: Grasp, camera: NamedCamera) -> None:
    has = {*camera.capabilities, Capability.DETECTOR}  # whether it is used depends on the controller
    if not has & {Capability.STEPPED, Capability.REPLAY}:
        has.add(Capability.GRASPED)
        if params.listen:
            has.add(Capability.LISTENING)
    flags = f"--camera {params.camera}{params.gripper_flag()}{', --live' * params.live}"
    refuse_unused(params, has, flags, never=NOT_OF_GRASP)


def _gripper(params: Grasp, camera: NamedCamera) -> NamedGripper:
    """Return the named gripper, or the camera's own; InputError if the pair cannot grasp."""
    stepped, replayed = camera.has(Capability.STEPPED), camera.has(Capability.REPLAY)
    own = named_grippers.Simulated.name if replayed else camera.own_gripper
    gripper = named_grippers.parse(params.gripper if params.gripper is not None else own)
    fits = stepped or replayed if gripper.has(Capability.STEPPED) else gripper.has(Capability.MOVED) and not stepped
    if not fits:
        raise InputError(
            "a grasp needs a camera and a gripper of matching kinds",
            where="--camera, --gripper",
            expected="both sim; or a virtual gripper or one at a PORT; or replay:RECORDING with sim",
            found=f"{camera}, {gripper}",
        )
    return gripper


def dry_run(jobs: Sequence[Job], params: Grasp, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return what would be built or done and its cost; it refuses everything that a run refuses."""
    trials = [job for job in jobs if isinstance(job, SimulatedGrasp)]
    if not trials:
        from evetac_cli.trials.grasp import real_time

        each = [job.first if isinstance(job, Listening) else job for job in jobs]
        others = [job for job in each if isinstance(job, DeviceGrasp | ReplayGrasp)]
        return real_time.dry_run(others, force=force)
    for trial in trials:
        simulated.are_up_to_date(trial, force=force)
    return part_costs.dry_run(trials, simulated.play, progress)


def cautions(jobs: Sequence[Job], params: Grasp) -> list[str]:
    """Return a sentence on the gel's grids that were chosen."""
    return grid_notes([job for job in jobs if isinstance(job, SimulatedGrasp)])


def run(job: Job, params: Grasp, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Grasp one object and record everything: in simulation, in real time, or on a recording."""
    match job:
        case SimulatedGrasp():
            return simulated.run(job, force=force, progress=progress)
        case ReplayGrasp():
            from evetac_cli.trials.grasp import replay

            return replay.run(job, force=force, progress=progress)
        case DeviceGrasp():
            from evetac_cli.trials.grasp import real_time

            return real_time.run(job, force=force, progress=progress)
        case Listening():
            from evetac_cli.trials.grasp import real_time

            return listen(job, partial(real_time.run, force=force, progress=silent))
    raise TypeError(f"grasp has no {type(job).__name__}")


STAGE = Stage(
    jobs,
    run,
    cautions=cautions,
    for_people=for_people,
    details=DETAILS,
    details_of_many=DETAILS_OF_MANY,
    warnings=slip_grid.once,
    dry_run=dry_run,
    dry_run_for_people=part_costs.for_people,
)
