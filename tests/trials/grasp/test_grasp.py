"""grasp: which detector and controller, their timing, a closed gel, and the outcome."""

import json
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.commands.grasp import Grasp
from evetac_cli.devices import GripperReading, Rig
from evetac_cli.errors import InputError
from evetac_cli.inspect import validate
from evetac_cli.kernels.grip.control import Control, SlipSignal, make_law
from evetac_cli.resources import MODEL
from evetac_cli.stages.model_files import learned_true_slip_share, read_horizon_ms
from evetac_cli.stages.slip_detectors import load_detector
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.trial_writer import TrialBuffer
from evetac_cli.trials import grasp
from evetac_cli.trials.grasp.loop import Timing, grasp_slices
from evetac_cli.trials.grasp.online_detector import known_dots
from evetac_cli.trials.grasp.settings import GraspSettings
from tests.devices.stand_ins import StillCamera, StillGripper

SHORT = {"lift_s": 1.0, "balance_s": 0.1}


def made(tmp_path: Path, name: str = "a", **chosen):
    params = Grasp(**{**SHORT, **chosen})
    (job,) = grasp.jobs([], params, tmp_path / f"{name}.recording.h5")
    return job.output, grasp.run(job, params).rows[0]


def test_the_package_has_a_detector() -> None:
    """Assert that a grasp needs no --model: the package's is whole, runs, and its JSON is of this very file."""
    assert (detector := GraspSettings.of(Grasp()).detector) is not None
    assert detector.path == MODEL
    assert [row["faults"] for row in validate.run([MODEL]).rows] == [None]
    made = json.loads(MODEL.with_name("slip-10ms.json").read_text())
    with StageFile(MODEL, "model") as model:
        assert load_detector(model).architecture.name == made["model"]
        assert read_horizon_ms(model) == made["horizon_ms"] == 10
        assert float(model.read("threshold")) == made["threshold"]
        assert model.header["id"] == made["id"]
        assert learned_true_slip_share(model.header) == made["learned_true_slip_share"]
    assert made["simulated"]


@pytest.mark.parametrize("controller", ["paper", "paper-reset"])
def test_the_papers_controllers_need_a_model(tmp_path: Path, controller: str) -> None:
    """Assert that they are refused without a model, with the command that trains the paper's, and not with one."""
    with pytest.raises(InputError, match=r"--model(.|\n)*evetac train .*--model fast-slow .*--preset paper"):
        grasp.jobs([], Grasp(controller=controller), tmp_path)
    assert grasp.jobs([], Grasp(controller=controller, model=Path("shipped")), tmp_path)


def test_the_threshold_is_the_models_unless_named() -> None:
    """Assert that a grasp is detected at the model's own threshold, at one that is named, and never at two.

    A model that keeps no price of its thresholds is not run at its own, which was chosen for timing.
    """
    with StageFile(MODEL, "model") as model:
        own = float(model.read("threshold"))
    for named, expected in ((None, own), (0.25, 0.25)):
        settings = GraspSettings.of(Grasp(slip_threshold=named))
        assert settings.detector is not None and settings.detector.threshold == expected


@pytest.mark.slow
def test_dry_run_refuses_what_a_run_does(tmp_path: Path) -> None:
    """Assert that a file made by another recipe is refused by a dry run in the words of a run."""
    out = tmp_path / "a.recording.h5"
    out.touch()
    jobs, words = grasp.jobs([], Grasp(), out), []
    for act in (grasp.dry_run, lambda jobs, params: grasp.run(jobs[0], params)):
        with pytest.raises(InputError, match="the output exists") as refused:
            act(jobs, Grasp())
        words.append(str(refused.value))
    assert words[0] == words[1]
    assert grasp.dry_run(jobs, Grasp(), force=True).summary["files"] == 1


@pytest.mark.slow
def test_load_proportional_grips_as_the_object_pulls(tmp_path: Path) -> None:
    """Assert that ours lifts off with a grip that holds, and that the displacement that it reacts to is in the file."""
    path, row = made(tmp_path, controller="load-proportional", lift_s=1.2, balance_s=0.0)
    with StageFile(path, "recording") as recording:
        mean_displacement_px, gap_mm = (
            recording.read("control/mean_displacement_px"),
            recording.read("truth/table_gap_mm"),
        )
        shear_n = recording.read("truth/shear_force_n")
    assert gap_mm[-1] > 5.0
    load_px = np.linalg.norm(mean_displacement_px[-1] - mean_displacement_px[700])
    assert load_px == pytest.approx(2.8 * np.linalg.norm(shear_n[-1]), rel=0.25)  # H / G over the gel, in px/N
    assert row["force_lift_n"] > 0.5


def test_known_dots() -> None:
    """Assert that of a closed gel the column where the window would be is left out, and of a cut one nothing."""
    x, y = np.meshgrid(np.arange(9) * 62.0 + 60, np.arange(7) * 62.0 + 40)
    closed = np.stack([x, y], axis=-1)
    known = known_dots(closed, 7, 8).reshape(7, 9)
    assert known[:, :8].all()
    assert not known[:, 8].any()
    assert not known_dots(closed[:, ::-1], 7, 8).reshape(7, 9)[:, 0].any()
    assert known_dots(closed[:, :8], 7, 8).all()
    worn = np.where(np.arange(9)[:, None] == 2, np.nan, closed)
    assert (~known_dots(worn, 7, 8).reshape(7, 9)).all(axis=0).tolist() == [column == 2 for column in range(9)]
    for rows, columns in ((7, 7), (6, 8), (7, 10)):
        with pytest.raises(ValueError, match="dots"):
            known_dots(closed, rows, columns)


@pytest.mark.slow
def test_a_closed_gel_is_felt_by_the_network_for_a_cut_one(tmp_path: Path) -> None:
    """Assert that 63 dots are tracked and evaluated: the file has them all, and a probability for every slice."""
    path, row = made(tmp_path, gel="closed", controller="paper", model=Path("shipped"))
    with StageFile(path, "recording") as recording:
        assert recording.read("sensor/dot_xy_px").shape == (7, 9, 2)
        assert not recording.has("sensor/window_px")
        probability = recording.read("control/probability")
    assert np.isfinite(probability[100:]).all()
    assert row["slices_with_slip"] > 0


class Silence(StillCamera):
    """A camera of so many empty slices."""

    def __init__(self, slices: int) -> None:
        self.most = slices

    def read(self):
        return None if self.slices == self.most else super().read()


class Still(StillGripper):
    """A gripper whose fingers do not move, with a log of its commands."""

    def __init__(self, camera: Silence) -> None:
        self.camera, self.goals = camera, []

    def read(self) -> GripperReading:
        return GripperReading(0.0, 100)

    def write_position(self, goal_ticks: int) -> None:
        self.goals.append((self.camera.slices, goal_ticks))


class SlipsAt:
    """A detector that detects slip in one slice."""

    def __init__(self, at: int) -> None:
        self.at, self.slices, self.signal = at, 0, SlipSignal()

    def tell_gripper(self, position_ticks: float, goal_ticks: float) -> None:
        self.told = position_ticks, goal_ticks

    def step(self, events) -> float:
        self.slices += 1
        self.signal = SlipSignal(int(self.slices >= self.at), 1.0)
        return float(self.slices == self.at)


def held(timing: Timing, slips_at: int) -> list[tuple[int, int]]:
    camera = Silence(timing.end_ms)
    still = Still(camera)
    buffer = TrialBuffer()
    control = Control(make_law("paper"), timing.control_hz)
    for events, rows in grasp_slices(Rig(camera, still), SlipsAt(slips_at), control, timing):
        buffer.append(events, rows)
    assert timing.end_ms == len(buffer.events)
    assert len(buffer.rows["control/t_us"]) == len(still.goals)
    return still.goals


@pytest.mark.parametrize("hz", [50, 100, 250, 500, 1000])
def test_the_controller_steps_at_its_rate(hz: int) -> None:
    """Assert that a command is written in every slice in which one is due, and in no other."""
    goals = held(Timing(10, 90, 100, float(hz)), 10_000)
    assert [ms for ms, _ in goals] == list(range(1, 201, 1000 // hz))


@pytest.mark.parametrize("latency_ms", [0, 1, 2, 7, 50])
def test_the_controller_reacts_after_the_latency(latency_ms: int) -> None:
    """Assert that slip in a slice changes the goal in the first step of control after the latency."""
    timing = Timing(10, 190, 0, 500.0, latency_ms)
    goals = held(timing, 51)
    closed = next(ms for ms, goal in goals if ms > 10 and goal > 100)
    due = 51 + latency_ms
    assert closed == due + (due + 1) % 2  # slices 1, 3, 5 ... are followed by a step
