"""Both fingers of a grasp see: simulated, on recordings, and on virtual devices."""

import json
import math
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.record import Record
from evetac_cli.errors import DeviceError, InputError
from evetac_cli.evaluate.grasp import EvaluateGrasp
from evetac_cli.evaluate.grasp import measure as evaluate_grasp
from evetac_cli.events import Events, empty
from evetac_cli.inspect import validate
from evetac_cli.kernels.slip.alarms import alarming
from evetac_cli.sim.setup.plan import read_plan
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials import grasp, record
from evetac_cli.trials.grasp.grasp_processes import GraspProcesses
from evetac_cli.trials.grasp.loop import TwoFingers
from tests.devices.stand_ins import StillCamera
from tests.trials.grasp.bench import goals_by_law
from tests.trials.grasp.test_real_time import grid_of

UNLIKE = "evetac,randomized:7"


class CountingCamera(StillCamera):
    """A camera of a few empty slices."""

    def __init__(self, slices: int) -> None:
        self.left = slices

    def read(self) -> Events | None:
        self.left -= 1
        return empty() if self.left >= 0 else None


@pytest.mark.parametrize(
    ("offset_us", "seen"),
    [(0.0, [1, 2, 3, 4, 5]), (400.0, [0, 1, 2, 3, 4]), (-400.0, [1, 2, 3, 4, 5]), (-2000.0, [3, 4, 5, 6, 6])],
)
def test_the_second_finger_comes_as_far_as_the_first(offset_us: float, seen: list[int]) -> None:
    """Assert that at the end of a slice just those slices of the second finger were seen that had ended by then."""
    events: list[Events] = []
    both = TwoFingers(None, None, CountingCamera(6), events.append, offset_us)
    counts = []
    for _ in seen:
        assert math.isnan(both.step(empty()))
        counts.append(len(events))
    assert counts == seen
    assert both.signal.slips == both.count == 0


@pytest.fixture(scope="module")
def grasped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A short simulated grasp with fingers that differ, and the object slipping out of them."""
    params = Grasp(camera="sim,sim", sensor=UNLIKE, lift_s=1.2, balance_s=0.0, slip_threshold=0.2)
    (job,) = grasp.jobs([], params, tmp_path_factory.mktemp("two"))
    row = grasp.run(job, params).rows[0]
    assert row["second_output"] == str(job.outputs[1])
    assert not grasp.run(job, params).made
    return job.outputs


def test_each_finger_has_a_file(grasped: tuple[Path, Path]) -> None:
    """Assert that both are valid and of one trajectory, hold as many slices, and each its own sensor and truth.

    What goes down goes down in both images, and what goes aside goes the other way in the second.
    """
    assert validate.run(list(grasped)).summary["invalid"] == 0
    with open_recording(grasped[0]) as first, open_recording(grasped[1]) as second:
        assert len(first) == len(second) == 2700
        assert [file.header["parameters"]["finger"] for file in (first, second)] == [1, 2]
        assert first.header["parameters"]["trajectory"] == second.header["parameters"]["trajectory"]
        assert (first.has("control"), second.has("control")) == (True, False)
        assert float(second.read("capture/clock_offset_us")) == 0.0
        assert second.read("sensor/name") == "randomized:7"
        plan = read_plan(first.header["parameters"], "")
        assert plan.second is not None and plan.second.name == "randomized:7"
        moved = [file.read("truth/object_xy_px")[-1] for file in (first, second)]
        scales = (plan.sensor.mm_per_px, plan.second.sensor.mm_per_px)
        np.testing.assert_allclose(moved[0] * scales[0], moved[1] * scales[1] * [1, -1], rtol=1e-4, atol=1e-6)
        assert moved[0][0] > 0.1
        assert first.event_count != second.event_count > 1000


def test_a_replay_decides_as_the_grasp_did(grasped: tuple[Path, Path], tmp_path: Path) -> None:
    """Assert that the decisions over both recordings are those of the grasp, bit for bit."""
    camera = ",".join(f"replay:{path}" for path in grasped)
    params = Grasp(camera=camera, slip_threshold=0.2)
    (job,) = grasp.jobs([], params, tmp_path)
    grasp.run(job, params)
    with open_recording(grasped[0]) as was, open_recording(job.output) as now, open_recording(grasped[1]) as second:
        for name in ("goal_ticks", "u_ff_ticks", "slip", "mean_displacement_px", "probability", "second_probability"):
            np.testing.assert_array_equal(was.read(f"control/{name}"), now.read(f"control/{name}"))
        assert np.isfinite(now.read("control/second_probability")).any()
        assert {was.header["id"], second.header["id"]} <= set(now.header["parents"])


def test_both_files_are_one_grasp_to_evaluate(grasped: tuple[Path, Path], tmp_path: Path) -> None:
    """Assert that the second finger's file has no part in a report, and that the setting says how many fingers saw."""
    params = EvaluateGrasp()
    (job,) = evaluate_grasp.jobs(list(grasped), params, tmp_path)
    assert job.inputs == grasped[:1]
    with open_recording(grasped[0]) as file:
        row = evaluate_grasp.trial_row(grasped[0], file.header)
        stored = json.loads(file.read("control/outcome"))
    assert row["setting"] == "load-proportional, two fingers, randomized:7"
    assert row["false_slip_events"] == stored["false_slip_events"]


def test_recordings_that_make_no_grasp(grasped: tuple[Path, Path], tmp_path: Path) -> None:
    """Assert that the wrong way round, and fingers of two grasps, are refused in words."""
    first, second = (f"replay:{path}" for path in grasped)
    with pytest.raises(InputError, match="first finger"):
        grasp.jobs([], Grasp(camera=f"{second},{first}"), tmp_path)
    params = Grasp(lift_s=1.0, balance_s=0.0, controller="none")
    (job,) = grasp.jobs([], params, tmp_path)
    grasp.run(job, params)
    with pytest.raises(InputError, match="different grasps"):
        grasp.jobs([], Grasp(camera=f"replay:{job.output},{second}"), tmp_path)


def test_a_calibration_for_each_finger(tmp_path: Path) -> None:
    """Assert that one file is for both cameras, two are one for each, and another number is refused."""
    wide, narrow = (tmp_path / name for name in ("wide", "narrow"))
    for folder in (wide, narrow):
        folder.mkdir()
    grids = grid_of(wide), grid_of(narrow, columns=9)
    cameras = "virtual:prepared=10000,virtual:prepared=10000"

    def columns(calibration: str, kind: type[Grasp] | type[Record] = Grasp) -> list[int]:
        stage = grasp if kind is Grasp else record
        (job,) = stage.jobs([], kind(camera=cameras, calibration=Path(calibration)), tmp_path)  # type: ignore[arg-type]
        return [each.dot_xy_px.shape[1] for each in job.calibrations]  # type: ignore[attr-defined]

    assert columns(str(grids[0])) == [8, 8]
    assert columns(f"{grids[0]},{grids[1]}") == columns(f"{grids[0]},{grids[1]}", Record) == [8, 9]
    with pytest.raises(InputError, match="number of calibrations"):
        columns(",".join(map(str, (*grids, grids[0]))))


PAPER = {"controller": "paper", "model": Path("shipped")}
PATIENT = {"watchdog_ms": 500, "lift_s": 1.0, "balance_s": 0.2}


@pytest.mark.slow
def test_a_virtual_grasp_of_two_fingers(tmp_path: Path) -> None:
    """Assert that both files are whole and of one clock, and that the law over both detectors gives the goals."""
    params = Grasp(camera="virtual,virtual", sensor=UNLIKE, slip_threshold=0.2, **PAPER, **PATIENT)  # type: ignore[arg-type]
    (job,) = grasp.jobs([], params, tmp_path)
    row = grasp.run(job, params).rows[0]
    assert row["ended"] == "the grasp is over"
    assert validate.run(list(job.outputs)).summary["invalid"] == 0
    with open_recording(job.outputs[0]) as first, open_recording(job.outputs[1]) as second:
        assert len(first) == len(second) == row["second_slices"] == 2700
        assert len(second.read("truth/slip")) == 2700
        assert abs(float(second.read("capture/clock_offset_us"))) < 500.0  # it is known by how fast words came
        assert first.header["parameters"]["trajectory"] == second.header["parameters"]["trajectory"]
        names = ("goal_ticks", "slip", "phase", "early_goal_ticks")
        names += tuple(f"{early}{of}slices_processed" for early in ("", "early_") for of in ("", "second_"))
        steps = {f"control/{name}": first.read(f"control/{name}").tolist() for name in names}
        steps["gripper/position_ticks"] = first.read("gripper/position_ticks").tolist()
        rows = [dict(zip(steps, each, strict=True)) for each in zip(*steps.values(), strict=True)]
        offset_ms = round(float(second.read("capture/clock_offset_us")) / 1e3 + 0.5) - 1  # whole slices
        said = first.read("control/probability"), first.read("control/second_probability")
        slips, others = (alarming(each, 0.2) for each in said)
        goals_by_law(rows, lambda k: bool(slips[k]), lambda k: bool(others[min(max(k + offset_ms + 1, 0), 2699)]))
        assert others.any()


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["kill", "unplug"])
def test_the_gripper_lets_go_whatever_dies_at_the_second_finger(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that its detector and its camera, dead, end the grasp with torque off, both files valid, and are named."""
    cameras = ["virtual", "virtual:unplug@0.8" if fault == "unplug" else "virtual"]
    params = Grasp(camera=",".join(cameras), **PATIENT)  # type: ignore[arg-type]
    (job,) = grasp.jobs([], params, tmp_path)
    if fault == "kill":
        go = GraspProcesses.go

        def kill_soon(self: GraspProcesses) -> None:
            go(self)
            give = self.give_sign_of_life
            signs = iter(range(10**9))

            def give_and_kill() -> None:
                give()
                latest = self.status.latest()
                if latest is not None and latest.slices > 400 and next(signs) == 0:
                    os.kill(self.detectors[1].pid or 0, signal.SIGKILL)

            self.give_sign_of_life = give_and_kill  # type: ignore[method-assign]

        monkeypatch.setattr(GraspProcesses, "go", kill_soon)
    with pytest.raises(DeviceError, match="torque is off") as failed:
        grasp.run(job, params)
    assert "second finger" in str(failed.value)
    assert validate.run(list(job.outputs)).summary["invalid"] == 0
    with open_recording(job.outputs[1]) as second:
        assert json.dumps(second.read("capture/ended"))
        assert 0 < len(second) < 2700
