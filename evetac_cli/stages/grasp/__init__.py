"""grasp: detect slip at 1000 Hz and control the gripper at 500 Hz (paper, section VII).

Light contact, lifting, balancing. The detector folds the same kernels over live slices that `track` and `featurize`
fold over a file (online_detector.py). It counts slices with slip; the controller checks every 2 ms whether the count
has risen (loop.py). Each kind of trial has a module: SimulatedTrial (simulated.py), DeviceTrial (real_time.py) and
ReplayTrial (replay.py).
"""

from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path

from evetac_cli.devices import cameras as named_cameras
from evetac_cli.devices import grippers as named_grippers
from evetac_cli.devices.cameras import NamedCamera
from evetac_cli.devices.grippers import NamedGripper
from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, silent
from evetac_cli.kernels.grip import control as grip_control
from evetac_cli.params.grasp import Grasp
from evetac_cli.params.parameter import flag_of
from evetac_cli.stages import part_costs
from evetac_cli.stages.grasp import simulated
from evetac_cli.stages.grasp.online_detector import OnlineSlipDetector
from evetac_cli.stages.grasp.setup import make_law, make_timing
from evetac_cli.stages.trials import OUTPUT as OUTPUT
from evetac_cli.stages.trials import DeviceTrial, ReplayTrial, SimulatedTrial, simulated_trials
from evetac_cli.stages.unused_options import refuse_unused_of_grasp
from evetac_cli.store.files import up_to_date

METHOD = simulated.METHOD
OF_DETECTOR = ("model", "slip_threshold", "tracker")
TIMERS = (("slip detector", OnlineSlipDetector, "step"),)  # what a dry run times beside the scene


def jobs(files: list[Path], params: Grasp, out: Path | None) -> Sequence[Job]:
    """One recording for every object and trial."""
    camera = named_cameras.parse(params.camera)
    refuse_unused_of_grasp(params, camera)
    law = make_law(params)
    for item in fields(params) if not grip_control.uses_detector(law) else ():
        value = getattr(params, item.name)
        if item.name in OF_DETECTOR and value != item.default:
            without = f"no detector is used with --controller {params.controller}"
            raise InputError(without, where=flag_of(item), found=str(value))
    gripper = _gripper(params, camera)
    if not camera.is_stepped:
        from evetac_cli.stages.grasp import real_time  # with all that belongs to devices

        return real_time.jobs(camera, gripper, params, out)
    trials = simulated_trials(("lift",), params, out)
    make_timing(params, trials[0].plan)  # refuses a rate that cannot be kept
    return trials


def _gripper(params: Grasp, camera: NamedCamera) -> NamedGripper:
    """The gripper that is named, or that belongs to the camera; InputError for a pair that makes no grasp."""
    own = named_grippers.Simulated.name if camera.is_replay else camera.own_gripper
    gripper = named_grippers.parse(params.gripper if params.gripper is not None else own)
    fits = camera.is_stepped or camera.is_replay if gripper.is_stepped else not camera.is_stepped and gripper.is_moved
    if not fits:
        raise InputError(
            "a grasp needs a camera and a gripper that belong together",
            where="--camera, --gripper",
            expected="both sim; or a gripper that is virtual or at a PORT; or replay:RECORDING with sim",
            found=f"{camera}, {gripper}",
        )
    return gripper


def dry_run(jobs: Sequence[Job], params: Grasp, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """What would be built or done, and what that costs; refused what a run refuses."""
    trials = [job for job in jobs if isinstance(job, SimulatedTrial)]
    if not trials:
        from evetac_cli.stages.grasp import real_time

        others = [job for job in jobs if isinstance(job, DeviceTrial | ReplayTrial)]
        return real_time.dry_run(others, params, force=force)
    for trial in trials:
        up_to_date(trial.output, simulated.make_recipe(trial, params), force=force)
    return part_costs.dry_run(trials, partial(simulated.play, params=params), TIMERS, progress)


dry_run_for_people = part_costs.for_people


def run(job: Job, params: Grasp, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Grasp one object and record everything: in simulation, in real time, or on a recording."""
    match job:
        case SimulatedTrial():
            return simulated.run(job, params, force=force, progress=progress)
        case ReplayTrial():
            from evetac_cli.stages.grasp import replay

            return replay.run(job, params, force=force, progress=progress)
        case DeviceTrial():
            from evetac_cli.stages.grasp import real_time

            return real_time.run(job, params, force=force, progress=progress)
    raise TypeError(f"grasp has no {type(job).__name__}")
