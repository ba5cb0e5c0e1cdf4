"""What a recording of a gripper tells of gripper and gel, and what it does not."""

from pathlib import Path

import numpy as np
import pytest

from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.identify import Identify
from evetac_cli.commands.record import Record
from evetac_cli.errors import InputError
from evetac_cli.kernels.estimates import Estimate
from evetac_cli.sim import gripper
from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.plan import named_sensor, one_sensor
from evetac_cli.sim.setup.sensor import Sensor, SensorGripper
from evetac_cli.sim.setup.tables import read_table
from evetac_cli.stages import identify
from evetac_cli.stages.identify import gripped, gripper_rows
from evetac_cli.stages.identify.drive import NAMES, DriveFit, GripperRows
from evetac_cli.stages.identify.gripped import Gripped, Weight
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials import grasp, record
from tests.make import run_stage

LIKE = one_sensor("evetac")
MIDDLE = 0.36 * (0.36 / 0.35) ** gripper_rows.SLIP_PART  # of the friction in `gripped_whole`, as half of 1 kg is held


def gripped_whole() -> Gripped:
    """All parts, with values of a usual gripper and gel under 0.5 kg."""
    values = dict(zip(NAMES, (10.0, 400.0, 5.0, 1.4, 0.8, 1.0, 361.0, 61.0), strict=True))
    fit = DriveFit(values, dict.fromkeys(NAMES, 0.001), 0.3, [], np.zeros(10))
    creep = gripped.held_gel.Creep((0.02, 0.05), (0.3, 4.0), 1.0, 0.001)
    weight = Weight(creep, 2 * 150e3, 2 * np.array([0.35, 0.36]))
    plain = (Estimate(0.3, 0.2, 0.4), Estimate(3.0, 2.5, 3.5), Estimate(1.0, 0.5, 1.5), Estimate(6.0, 5.9, 6.1))
    return Gripped("a.recording.h5", fit, *plain, weight)


def test_what_is_written_simulates_the_same() -> None:
    """Assert that the drive of the file's table has the friction, gain and damping that were told; the gel, too."""
    listed, values = gripper_rows.rows(
        [gripped_whole()], Identify(object_mass_g=500.0, force_per_current=0.45, pixel_mm=0.03), LIKE
    )
    table = {key: one.value for key, one in values["gripper"].value.items()}
    drive = gripper.make_drive(read_table(SensorGripper, table, "here"))
    assert drive.force_per_current_n_ma == 0.45
    assert drive.friction_n == pytest.approx(10.0 * 0.45) and drive.gain_ma_tick == pytest.approx(6.0)
    assert drive.damping_n_s_m == pytest.approx(400 * 0.45) and drive.mass_kg == pytest.approx(5 * 0.45)
    assert values["shear_modulus_pa"].value == pytest.approx(150e3 / (1 + gripper_rows.MODULUS_HIGH_SHARE))
    assert values["static_friction_factor"].value == pytest.approx(MIDDLE / (0.45 * 0.9))
    assert list(values["creep"].value["time_s"]) == pytest.approx([0.3, 4.0])
    by_name = {row.parameter: row for row in listed}
    assert by_name["static_friction_factor"].estimate is not None
    for row in listed:
        if row.estimate is not None:
            assert row.estimate.low <= row.estimate.value <= row.estimate.high, row


def test_without_a_scale() -> None:
    """Assert that without mass or force per current the rows that hang on them say so, and the others stand."""
    listed, values = gripper_rows.rows([gripped_whole()], Identify(pixel_mm=0.03), LIKE)
    by_name = {row.parameter: row for row in listed}
    for name in ("shear_modulus_pa", "static friction x force per current"):
        assert by_name[name].estimate is None and "--object-mass-g" in by_name[name].source
    assert "--force-per-current" in by_name["gripper.force_per_current_n_ma"].source
    assert by_name["gripper: gear friction"].estimate is not None
    assert "shear_modulus_pa" not in values and values["gripper"].value["force_per_current_n_ma"].value == 0.4
    known = Identify(object_mass_g=500.0)
    with_mass, values = gripper_rows.rows([gripped_whole()], known, LIKE)
    by_name = {row.parameter: row for row in with_mass}
    wide = by_name["shear_modulus_pa"].estimate
    assert wide is not None and wide.high > 1.15 * wide.value  # the size of a pixel is not known
    assert by_name["static_friction_factor"].estimate is None
    assert values["static_friction_factor"].value == pytest.approx(MIDDLE / (0.4 * 0.9))


def test_nothing_told() -> None:
    """Assert that without a gripper, and where the object never slips, each row says which recording it takes."""
    listed, values = gripper_rows.rows([], Identify(object_mass_g=500.0, pixel_mm=0.03), LIKE)
    assert values == {} and len(listed) == 16
    assert all(row.estimate is None and row.source.startswith("cannot be estimated") for row in listed)
    whole = gripped_whole()
    assert whole.weight is not None
    stuck = Gripped("a.recording.h5", whole.drive, weight=whole.weight._replace(weight_per_ma=None))
    listed, values = gripper_rows.rows([stuck], Identify(object_mass_g=500.0, pixel_mm=0.03), LIKE)
    by_name = {row.parameter: row for row in listed}
    assert "until the object slips" in by_name["static friction x force per current"].source
    assert "static_friction_factor" not in values and "shear_modulus_pa" in values


def test_a_delay_that_could_be_anything_is_not_told() -> None:
    """Assert the stated rule: an interval wider than half of what sensors have is none."""
    vague = Gripped("a.recording.h5", delay_ms=Estimate(4.0, 1.0, 7.0), jitter_ms=Estimate(2.0, 0.0, 3.0))
    listed, values = gripper_rows.rows([vague], Identify(pixel_mm=0.03), LIKE)
    by_name = {row.parameter: row.estimate for row in listed}
    assert by_name["gripper.command_delay_ms"] is None and by_name["gripper.command_jitter_ms"] is None
    assert values == {}


def test_grips_at_several_places() -> None:
    """Assert that friction is the mean over grips, told the better the more there are, and worse by a slow slip."""
    whole = gripped_whole()
    assert whole.weight is not None

    def friction(*slips: tuple[float, float]) -> Estimate:
        held = [whole.weight._replace(weight_per_ma=2 * np.array(slip)) for slip in slips]  # type: ignore[union-attr]
        grips = [Gripped(f"{number}.recording.h5", weight=one) for number, one in enumerate(held)]
        listed, _ = gripper_rows.rows(grips, Identify(object_mass_g=500.0, pixel_mm=0.03), LIKE)
        row = next(row for row in listed if row.parameter == "static friction x force per current")
        assert row.estimate is not None and row.source == ", ".join(one.source for one in grips)
        return row.estimate

    one, three = friction((0.36, 0.36)), friction((0.36, 0.36), (0.33, 0.33), (0.36**2 / 0.33,) * 2)
    assert one.value == pytest.approx(0.36) and three.value == pytest.approx(0.36)
    assert three.high - three.low < 0.9 * (one.high - one.low)
    slow = friction((0.30, 0.36))
    assert slow.value > 0.37 and slow.high - slow.low > 1.1 * (one.high - one.low)


def test_a_bad_fit_is_not_told() -> None:
    """Assert the stated rule: where a fit leaves too much, its parameter is not told, and the row says so."""
    held = gripped.held_gel.HeldFit(0.3e-3, 0.06, np.ones(4), 0.9 * gripped.MOST_OFF_SHARE)
    creep = gripped.held_gel.Creep((0.02, 0.05), (0.3, 4.0), 1.0, 0.9 * gripped.MOST_OFF_IN_TIME)
    assert gripped._misfits(held, creep) == {}
    assert list(gripped._misfits(held._replace(misfit=2 * held.misfit), creep)) == ["modulus"]
    misfits = gripped._misfits(held, creep._replace(misfit=2 * creep.misfit))
    assert set(misfits) == {"modulus", "creep"}
    whole = gripped_whole()
    assert whole.weight is not None
    known = Identify(object_mass_g=500.0, pixel_mm=0.03)
    bad = Gripped(
        "bad.recording.h5", weight=Weight(None, None, None), misfits=misfits | {"drive": "cannot be estimated: x"}
    )
    listed, values = gripper_rows.rows([bad], known, LIKE)
    by_name = {row.parameter: row for row in listed}
    assert by_name["shear_modulus_pa"].source == by_name["creep.share, both arms"].source == misfits["creep"]
    assert (
        by_name["gripper: damping"].source == by_name["gripper.encoder_noise_ticks"].source == "cannot be estimated: x"
    )
    assert values == {}
    listed, values = gripper_rows.rows([bad, whole], known, LIKE)  # another recording tells it
    assert all(row.estimate is not None for row in listed if row.parameter.startswith("gripper: "))
    assert "shear_modulus_pa" in values and "creep" in values


def test_a_drive_that_does_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a drive which leaves more than MOST_OFF_TICKS is not told, and nothing that hangs on its force."""
    columns = {"t_us": np.arange(1, 2001) * 2000}
    names = ("current_written_ma", "current_ma", "position_ticks", "current_target_ma")
    columns |= {name: np.zeros(2000) for name in names}

    class Recording:
        path = Path("grip.recording.h5")

        def has(self, name: str) -> bool:
            return name.removeprefix("gripper/") in columns

        def read(self, name: str) -> np.ndarray:
            return columns[name.removeprefix("gripper/")]

    fitted = gripped_whole().drive
    assert fitted is not None
    known: list[DriveFit | None] = []
    monkeypatch.setattr(gripped, "_weight", lambda recording, rows, drive, scale: (known.append(drive), {}))
    for off in (0.9, 1.1):
        one = fitted._replace(residual_ticks=off * gripped.MOST_OFF_TICKS)
        monkeypatch.setattr(gripped.drive, "fit", lambda rows, one=one: one)
        gripping = gripped.find(Recording(), 0.0329, np.random.default_rng(0))  # type: ignore[arg-type]
        assert gripping is not None and (gripping.drive is None) == (known[-1] is None) == (off > 1)
        assert list(gripping.misfits) == (["drive"] if off > 1 else [])


def test_why_a_grip_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the rows name the recording and the reason, for the drive and for the weight."""
    known = Identify(object_mass_g=500.0, pixel_mm=0.03)
    rows = GripperRows(np.arange(1, 3001) * 2000, *(np.full(3000, 60.0) for _ in range(2)), np.full(3000, 61))

    class Recording:
        path = Path("grip.recording.h5")
        dot_xy_px: np.ndarray | None = None
        dot_radius_px: float | None = None

        def __len__(self) -> int:
            return 6000

    recording = Recording()
    weight, why = gripped._weight(recording, rows, None, 0.0329)  # type: ignore[arg-type]
    assert weight is None and "no dot grid" in why["weight"]
    recording.dot_xy_px, recording.dot_radius_px = np.zeros((7, 9, 2)), 15.0
    monkeypatch.setattr(gripped, "_tracked", lambda _: np.zeros((6000, 63, 2), np.float32))
    weight, why = gripped._weight(recording, rows, None, 0.0329)  # type: ignore[arg-type]
    assert weight is None and "grip.recording.h5: no weight" in why["weight"]
    why["drive"] = "cannot be estimated from grip.recording.h5: the gripper never closes"
    by_name = {row.parameter: row for row in gripper_rows.rows([Gripped("", misfits=why)], known, LIKE)[0]}
    assert by_name["gripper: damping"].source == why["drive"]
    assert by_name["shear_modulus_pa"].source == by_name["static_friction_factor"].source == why["weight"]
    unknown_force = Weight(None, None, None)
    grip = Gripped("", weight=unknown_force, misfits={"drive": why["drive"]})
    by_name = {row.parameter: row for row in gripper_rows.rows([grip], known, LIKE)[0]}
    assert by_name["static friction x force per current"].source == why["drive"]


def test_when_the_weight_comes_on() -> None:
    """Assert direction, time and length of a load, and that a hold without one, or a short one, is refused."""
    path = np.zeros((5000, 6, 2), np.float32)
    path[2000:, :, 1] = -5.0
    path[2000:2100, :, 1] = np.linspace(0, -5, 100)[:, None]
    path += np.random.default_rng(0).normal(0, 0.02, path.shape).astype(np.float32)
    along, came, lasts = gripped._loading(path)
    assert along == -2 and abs(came - 2003) < 10 and abs(lasts - 100) < 15
    with pytest.raises(ValueError, match="no weight"):
        gripped._loading(path[:1900])
    with pytest.raises(ValueError, match="too short"):
        gripped._loading(path[:500])


@pytest.fixture(scope="module")
def grip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene grip-steps with coarse nodes, by a gripper with faults on a creeping gel."""
    folder = tmp_path_factory.mktemp("grip")
    faults = {"backlash_ticks": 2.0, "encoder_noise_ticks": 0.3, "command_delay_ms": 3.4, "command_jitter_ms": 2.2}
    coarse = scene_file.changed("grip-steps", {"solver": {"node_pitch_mm": 1.45}, "gripper": faults})
    (folder / "grip-steps.toml").write_text(coarse)
    chosen = Record(scene=str(folder / "grip-steps.toml"), sensor="realistic", objects="18", seed=3)
    return run_stage(record, [], chosen, folder / "grip.recording.h5")[0]


@pytest.mark.slow
def test_a_simulated_gripper_and_gel(grip: Path, tmp_path: Path) -> None:
    """Assert that the truth of a simulated sensor is within the intervals, and that its file simulates."""
    by_goals = Grasp(controller="fixed:6", lift_s=2.0, balance_s=0.0, sensor="realistic")
    output, _ = run_stage(
        grasp, [], by_goals, tmp_path / "grasp.recording.h5", force=False, progress=lambda done, of: None
    )
    asked = Identify(object_mass_g=550.0, pixel_mm=0.0329, force_per_current=0.4)
    (job,) = identify.jobs([grip, output], asked, tmp_path)
    by_name = {row["parameter"]: row for row in identify.run(job, asked).rows}
    truth = {
        "gripper: gear friction": 3.87 / 0.4,
        "gripper: damping": 0.15 / 0.4,
        "gripper: moving mass": 2.0 / 0.4,
        "gripper.backlash_ticks": 2.0,
        "gripper.encoder_noise_ticks": 0.3,
        "gripper.command_delay_ms": 3.4,
        "gripper.command_jitter_ms": 2.2,
        "gripper: servo gain": 5.0,
        "shear_modulus_pa": 145e3,
        "creep.share, both arms": 0.1,
        "static friction x force per current": 0.9 * 0.4,
        "static_friction_factor": 1.0,
    }
    for name, value in truth.items():
        assert by_name[name]["low"] <= value <= by_name[name]["high"], (name, by_name[name])
    for name in ("normal_modulus_pa", "loss_tangent", "noise_hz", "dots"):
        assert by_name[name]["estimate"] is None and "cannot be estimated" in by_name[name]["from"]
    _, sensor = named_sensor(str(job.output))
    assert isinstance(sensor, Sensor)
    chosen = Record(scene="slip", sensor=str(job.output), objects="18")
    assert record.jobs([], chosen, tmp_path)[0].plan.sensor.gripper == sensor.gripper


@pytest.mark.slow
def test_truth_is_never_read(grip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that no truth is asked for, and that a current which is not finite tells nothing."""
    with open_recording(grip) as recording:
        read = recording.read

        def without_truth(name: str, *range_: int) -> np.ndarray:
            assert not name.startswith("truth"), name
            return read(name, *range_)

        monkeypatch.setattr(recording, "read", without_truth)
        monkeypatch.setattr(gripped, "_weight", lambda *_: (None, {}))
        gripping = gripped.find(recording, 0.0329, np.random.default_rng(0))
        assert gripping is not None and gripping.drive is not None

        def broken(name: str, *range_: int) -> np.ndarray:
            column = without_truth(name, *range_)
            return np.full(len(column), np.nan) if name == "gripper/current_ma" else column

        monkeypatch.setattr(recording, "read", broken)
        assert gripped.find(recording, 0.0329, np.random.default_rng(0)) is None


def test_a_scene_without_a_current_to_follow(tmp_path: Path) -> None:
    """Assert that --current-of refuses a scene that names no current for the gripper."""
    asked = Record(camera="virtual", gripper="virtual", current_of="slip", dry_run=True)
    with pytest.raises(InputError, match="no current for the gripper"):
        record.jobs([], asked, tmp_path)
    both = Record(camera="virtual", gripper="virtual", current_of="grip-steps", hold_s=3.0, dry_run=True)
    with pytest.raises(InputError, match="no effect with --current-of"):
        record.jobs([], both, tmp_path)
    asked = Record(camera="virtual", gripper="virtual", current_of="grip-steps", dry_run=True)
    (job,) = record.jobs([], asked, tmp_path)
    assert "-25 to 60 mA for 35.5 s" in str(record.dry_run([job], asked).rows)
