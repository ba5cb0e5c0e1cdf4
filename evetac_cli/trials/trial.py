"""Trials: the recordings that `record` and `grasp` make, their sources and their seeds.

A trial runs in a simulated scene as fast as that is computed (SimulatedTrial), with devices in real time, real or
virtual (DeviceTrial), or as a grasp on a replayed recording (ReplayGrasp).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.commands.trials import Trials
from evetac_cli.devices.cameras import NamedCamera
from evetac_cli.devices.grippers import NamedGripper
from evetac_cli.errors import InputError, SceneError
from evetac_cli.jobs import Job, Rows
from evetac_cli.names import Capability
from evetac_cli.sim.setup.object_file import seed_of
from evetac_cli.sim.setup.plan import Plan, plans, with_second
from evetac_cli.sim.setup.scene import Solver
from evetac_cli.store.recordings import slip_grid
from evetac_cli.store.recordings.segments import refuse_leftover
from evetac_cli.store.recordings.slip_grid import FEWEST_NODES, resolving_mm

OUTPUT = "recording"
GRIP = 2.5  # margin: normal force over the slip limit at which slip is resolved; objects also slip in too tight a grip
FINEST_MM = 0.5  # finest pitch that is chosen
DETAILS = frozenset(  # columns of SolverFigures
    ("mechanical_steps_a_slice", "estimated_error_um_median", "slices_over_tolerance", slip_grid.COLUMN)
)


@dataclass(frozen=True)
class ViewRequest:
    """How a trial is shown while it runs.

    model: the displayed slip detector, None for the pretrained one; threshold: for its slip, None for the model's own;
    preset: of the tracker.
    """

    model: Path | None = None
    threshold: float | None = None
    preset: str = "stable"


@dataclass(frozen=True)
class Trial(Job):
    """One of a series of trials.

    number: of the trial; seed: of the series; plan: of the simulated scene, None without one; view: None if the trial
    is not shown.
    """

    number: int
    seed: int
    plan: Plan | None
    view: ViewRequest | None = field(default=None, kw_only=True)

    @property
    def shows_simulation(self) -> bool:
        """Whether the trial shows a simulation, or a recording of one; for the title of a view."""
        return self.plan is not None

    def seeds(self) -> np.random.SeedSequence:
        """Return the seeds of this trial, which depend on no other trial."""
        if self.plan is None:
            return np.random.SeedSequence([self.seed, self.number])
        tone_mhz = [] if self.plan.tone_hz is None else [round(1000 * self.plan.tone_hz)]
        return np.random.SeedSequence([self.seed, seed_of(self.plan.object_name), self.number, *tone_mhz])


@dataclass(frozen=True)
class SimulatedTrial(Trial):
    """A trial in a simulated scene, whose time passes as its slices are read.

    second_output: the file of the second finger's camera, if the plan has one; usual_pitch_mm: pitch of the gel's nodes
    in its scene, if a finer one was chosen.
    """

    plan: Plan
    second_output: Path | None = field(default=None, kw_only=True)
    usual_pitch_mm: float | None = field(default=None, kw_only=True)

    @property
    def outputs(self) -> tuple[Path, ...]:
        """One file per camera."""
        return (self.output,) if self.second_output is None else (self.output, self.second_output)


@dataclass(frozen=True)
class DeviceTrial(Trial):
    """A trial with devices, in real time. There is one file per camera; the first camera's file has the gripper.

    series: the files of all trials, by trial; taken: those of them that existed before the first trial.
    """

    exclusive = True
    cameras: tuple[NamedCamera, ...]
    gripper: NamedGripper
    files: tuple[Path, ...]
    series: tuple[tuple[Path, ...], ...]
    taken: tuple[Path, ...]

    @property
    def outputs(self) -> tuple[Path, ...]:
        """One file per camera."""
        return self.files

    @property
    def shows_simulation(self) -> bool:
        """Whether the first camera shows a simulation, or a recording of one."""
        return self.cameras[0].shows_simulation()


def simulated_trials(
    kinds: tuple[str, ...],
    params: Trials,
    out: Path | None,
    tones: str | None = None,
    prefix: str = "",
    *,
    fingers: int = 1,
) -> list[SimulatedTrial]:
    """Return `count` trials of every object or tone in a scene of one of these kinds.

    fingers: number of fingers with a camera. Files are named <prefix><scene>[-obj<number> or
    -<name>][-<tone>hz][-<finger of two>]-s<seed>-<trial>.recording.h5.
    """
    trials = []
    view = ViewRequest() if params.shown else None
    sensor, second = _sensors(params.sensor, fingers)
    plan_options = (params.scene, params.objects, sensor, kinds, params.gel, tones)
    for one in plans(*plan_options, solver=params.solver(), texture=params.texture):
        each = one if second is None else with_second(one, second)
        name = each.object_name
        what = "" if name is None else f"-{name}" if isinstance(name, str) else f"-obj{name:02d}"
        what += "" if each.tone_hz is None else f"-{each.tone_hz:g}hz"
        for number in range(params.count):
            stem, rest = f"{prefix}{each.scene.name}{what}", f"-s{params.seed}-{number:03d}.{OUTPUT}.h5"
            names = [f"{stem}{rest}"] if fingers == 1 else [f"{stem}-{place + 1}{rest}" for place in range(fingers)]
            outputs = [out if out is not None and out.suffix == ".h5" else (out or Path()) / name for name in names]
            plan = each.of_trial((params.seed, seed_of(name), number))
            second_output = None if fingers == 1 else outputs[1]
            trials.append(
                SimulatedTrial((), outputs[0], number, params.seed, plan, view=view, second_output=second_output)
            )
    return trials


def _sensors(text: str, fingers: int) -> tuple[str, str | None]:
    """Return the sensor of the first finger and of the second, if any: one each for `A,B`, otherwise the same.

    InputError if there are more sensors than fingers with a camera.
    """
    if fingers == 1:
        return text, None
    sensors = text.split(",")
    if len(sensors) > fingers:
        expected = f"one sensor, or {fingers} separated by a comma, one per camera"
        raise InputError("too many sensors", where="--sensor", expected=expected, found=text)
    return sensors[0], sensors[-1]


def device_trials(
    kinds: tuple[str, ...],
    cameras: tuple[NamedCamera, ...],
    gripper: NamedGripper,
    params: Trials,
    out: Path | None,
    prefix: str = "",
) -> list[DeviceTrial]:
    """Return `count` trials with these devices; with a virtual camera, for every object in a scene of these kinds.

    Files are named <prefix><camera>[-<serial or recording>][-<which of the same>]-s<seed>-<trial>.recording.h5, and for
    a virtual scene virtual-<scene>...
    """
    numbered: list[tuple[int, Plan | None]]
    outputs: list[tuple[Path, ...]]
    if cameras[0].has(Capability.SCENE):
        simulated = simulated_trials(kinds, params, out, prefix="virtual-", fingers=len(cameras))
        numbered = [(trial.number, trial.plan) for trial in simulated]
        outputs = [trial.outputs for trial in simulated]
    else:
        numbered = [(number, None) for number in range(params.count)]
        outputs = [_camera_files(cameras, params.seed, number, out, prefix) for number in range(params.count)]
    inputs = tuple(path for camera in cameras for path in camera.files)
    taken = tuple(path for files in outputs for path in files if _is_taken(path))
    return [
        DeviceTrial(
            *(inputs, files[0], number, params.seed, plan, cameras, gripper, files, tuple(outputs), taken),
            view=ViewRequest() if params.shown else None,
        )
        for (number, plan), files in zip(numbered, outputs, strict=True)
    ]


def _camera_files(
    cameras: Sequence[NamedCamera], seed: int, number: int, out: Path | None, prefix: str
) -> tuple[Path, ...]:
    """Return one file per camera of a trial."""
    if out is not None and out.suffix == ".h5":
        return (out,) * len(cameras)
    stems = [prefix + camera.file_stem for camera in cameras]
    numbered = [
        f"{stem}-{stems[:place].count(stem) + 1}" if stems.count(stem) > 1 else stem for place, stem in enumerate(stems)
    ]
    return tuple((out or Path()) / f"{stem}-s{seed}-{number:03d}.{OUTPUT}.h5" for stem in numbered)


def _is_taken(output: Path) -> bool:
    """Return whether a recording exists here, or an aborted one waits here for repair."""
    try:
        refuse_leftover(output)
    except InputError:
        return True
    return output.exists()


class SolverFigures:
    """The resolution of a simulated trial, for the row of its recording."""

    def __init__(self) -> None:
        self._slices = 0
        self._steps = 0
        self._errors_um: list[float] = []
        self._half_wavelength = math.inf

    def add(self, rows: Mapping[str, Any]) -> None:
        """Add rows of the ground truth, of one slice or of all; rows without mechanics are skipped."""
        if "truth/mechanical_steps" not in rows:
            return
        steps = np.atleast_1d(rows["truth/mechanical_steps"])
        self._slices += len(steps)
        self._steps += int(steps.sum())
        self._errors_um += np.atleast_1d(rows["truth/estimated_error_um"]).tolist()
        nodes = slip_grid.fewest_nodes(rows[slip_grid.NODES])
        self._half_wavelength = min(self._half_wavelength, math.inf if nodes is None else nodes)

    def figures(self, solver: Solver) -> dict[str, Any]:
        """Return steps per slice, estimated errors per step, and a warning if nodes are too far apart, or None."""
        if not self._slices:
            return {}
        row: dict[str, Any] = {
            "mechanical_steps_a_slice": self._steps / self._slices,
            "estimated_error_um_median": float(np.median(self._errors_um)),
        }
        if solver.step_ms is None:
            row["slices_over_tolerance"] = int((np.array(self._errors_um) > solver.tolerance_um).sum())
        nodes = None if self._half_wavelength == math.inf else self._half_wavelength
        return row | {slip_grid.COLUMN: nodes, "warning": slip_grid.unresolved(nodes, solver.node_pitch_mm)}


def for_people(rows: Rows, params: Trials) -> tuple[Rows, list[str]]:
    """Return all rows without their warnings, which are printed once for all rows."""
    return [{name: value for name, value in row.items() if name != "warning"} for row in rows], []


def nodes_of_slip(trial: SimulatedTrial, grip: float = 1.0) -> float:
    """Return half the shortest wavelength of unstable slip, in grid nodes; infinity if slip is stable.

    grip: normal force over the slip limit. SceneError if the trial cannot be simulated.
    """
    from evetac_cli.sim.scenes.gripped import GraspSimulation
    from evetac_cli.sim.simulation import simulation_of  # imports numba

    simulation = simulation_of(trial.plan, trial.seeds())
    return simulation.pads.nodes_of_slip(grip) if isinstance(simulation, GraspSimulation) else math.inf


def on_resolving_grid(trial: SimulatedTrial) -> SimulatedTrial:
    """Return the trial on the coarsest grid that resolves the slip of its object with the margin GRIP.

    The grid is not coarser than the scene's, nor finer than FINEST_MM; the finest may do without the margin. The trial
    itself if its own grid resolves the slip, or if none does. It follows from the trial's plan and seeds alone, before
    anything is simulated. A trial with virtual devices keeps the usual grid, because it has to run in real time.
    """
    usual_mm = trial.plan.scene.solver.node_pitch_mm
    pitch_mm, finer = usual_mm, trial
    try:
        while (nodes := nodes_of_slip(finer, GRIP)) < FEWEST_NODES:
            if pitch_mm <= FINEST_MM:
                return finer if nodes_of_slip(finer) >= FEWEST_NODES else trial
            pitch_mm = max(resolving_mm(nodes, pitch_mm), FINEST_MM)
            scene = trial.plan.scene
            scene = replace(scene, solver=replace(scene.solver, node_pitch_mm=pitch_mm))
            finer = replace(trial, plan=replace(trial.plan, scene=scene), usual_pitch_mm=usual_mm)
    except SceneError:  # reported when the trial is run
        return trial
    return finer


def grid_notes(trials: Sequence[SimulatedTrial]) -> list[str]:
    """Return a sentence on the grids that were chosen; none if all trials have their scene's."""
    finer = [trial for trial in trials if trial.usual_pitch_mm is not None]
    if not finer:
        return []
    pitches_mm = sorted({trial.plan.scene.solver.node_pitch_mm for trial in finer})
    span = " to ".join(f"{pitch_mm:.2f}" for pitch_mm in dict.fromkeys((pitches_mm[0], pitches_mm[-1])))
    objects = list(dict.fromkeys(str(trial.plan.object_name) for trial in finer))
    which = f"object{'s' if len(objects) > 1 else ''} {', '.join(objects)}"
    which += f", {len(finer)} of {len(trials)} trials" if len(trials) > 1 else ""
    usual = f"default {finer[0].usual_pitch_mm:g}"
    resolved = "slip resolved" + ", unless the grip is tight" * (pitches_mm[0] <= FINEST_MM)
    return [f"gel grid {span} mm for {which} ({usual}): {resolved}"]
