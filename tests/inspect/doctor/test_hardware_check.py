"""doctor hardware on virtual devices: all steps, and for each fault the step that finds it, with torque off."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.commands.doctor import DoctorHardware
from evetac_cli.devices import grippers
from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.devices.virtual.servo_plant import Obstacle
from evetac_cli.errors import InputError
from evetac_cli.inspect.doctor import hardware_check
from evetac_cli.inspect.doctor.hardware_check import run
from evetac_cli.jobs import Outcome
from tests.conftest import SLOW, is_off

GRIPPER_STEPS = [
    *("port", "answers", "registers", "supply", "temperature", "hardware error", "torque", "line", "position"),
    *("agreed", "watchdog", "closes", "opens", "watchdog with current", "torque at the end"),
]


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers are waited for, and silence lasts no longer than it has to."""
    monkeypatch.setattr(grippers, "VIRTUAL_ANSWER_MS", SLOW.answer_ms)
    monkeypatch.setattr(hardware_check, "SILENCE", 2)
    monkeypatch.setattr(grippers.Serial, "settings", lambda self: grippers.Virtual().settings())


def tried(folder: Path, gripper: str, ask: Any = None, **flags: Any) -> tuple[Outcome, dict[str, Any]]:
    """What came of it, and the report."""
    out = folder / "report.json"
    outcome = run(DoctorHardware(gripper=gripper, **flags), out, ask)
    return outcome, json.loads(out.read_text())


@pytest.mark.slow
@pytest.mark.usefixtures("words_wait")
def test_a_good_camera_and_gripper(tmp_path: Path) -> None:
    """Assert that every step is as expected, and the report holds steps, all registers, and what ran where."""
    made, report = tried(tmp_path, "virtual", camera="virtual:prepared=1e4")
    assert [row["check"] for row in made.rows] == ["opens", "events", "losses", *GRIPPER_STEPS]
    assert made.summary["ended"] == "all as expected"
    assert all(row["ok"] and row["expected"] for row in made.rows)
    assert made.simulated and report["simulated"]
    assert report["rows"] == made.rows
    assert report["registers"]["Model Number"] == 35074 and report["registers"]["Current Limit"] == 661
    assert all(report["made"][name] for name in ("at", "evetac", "python", "system", "pyusb", "dynamixel-sdk"))


@pytest.mark.parametrize(
    ("fault", "step", "words"),
    [
        ("overload@0", "watchdog", "overload"),
        ("unplug@0", "watchdog", "port is gone"),
        ("watchdog@0", "watchdog", "before: Bus Watchdog -1"),
        ("unplug", "port", "no such port"),
        ("overload", "hardware error", "overload"),
        ("bad-crc%100", "answers", "damaged answers"),
        ("bad-crc", "line", "answers_damaged 1"),
    ],
)
@pytest.mark.slow
def test_each_fault_stops_at_its_step(fault: str, step: str, words: str, tmp_path: Path) -> None:
    """Assert that it ends at the step that finds the fault, with its words, and what torque is read back as."""
    made, report = tried(tmp_path, f"virtual:{fault}")
    wrong = next(row for row in made.rows if not row["ok"])
    if fault == "unplug":  # it may be gone before or while it is opened
        assert wrong["check"] in ("port", "answers")
        return
    assert (wrong["check"], made.summary["ended"]) == (step, f"stopped at: {step}")
    assert words in wrong["found"]
    following = made.rows[made.rows.index(wrong) + 1 :]
    assert {row["check"] for row in following} <= {"torque at the end"}
    if step in GRIPPER_STEPS[2:]:
        assert following
        assert following[0]["ok"] == ("unplug" not in fault)
    assert report["summary"]["ended"] == made.summary["ended"]


@pytest.mark.parametrize("fault", ["lost-answer", "late-answer", "lost-answer%100"])
@pytest.mark.slow
def test_lost_answers_stop_it_before_anything_moves(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a line that loses answers is found before torque is ever on."""
    monkeypatch.setattr(grippers, "VIRTUAL_ANSWER_MS", 150.0)
    made, _ = tried(tmp_path, f"virtual:{fault}")
    wrong = next(row for row in made.rows if not row["ok"])
    assert GRIPPER_STEPS.index(wrong["check"]) <= GRIPPER_STEPS.index("line")


@pytest.mark.parametrize(
    ("options", "step"),
    [
        ({"registers": {"Model Number": 35073}}, "answers"),
        ({"registers": {"Present Input Voltage": 110}}, "supply"),
        ({"registers": {"Present Temperature": 90}}, "temperature"),
        ({"registers": {"Hardware Error Status": 4}}, "hardware error"),
        ({"position_ticks": 700.0}, "position"),
        ({"plant": Obstacle(at_ticks=400.0, stiffness_n_tick=100.0)}, "closes"),
    ],
)
@pytest.mark.slow
def test_each_oddity_of_a_gripper_stops_at_its_step(options: dict[str, Any], step: str, tmp_path: Path) -> None:
    """Assert that a gripper at a port that is not as expected is left alone, and off, from that step on."""
    with VirtualGripper(**options) as gripper:
        made, _ = tried(tmp_path, gripper.port, arm=True, yes=True)
        assert made.summary["ended"] == f"stopped at: {step}"
        assert not made.simulated
        assert is_off(gripper)


@pytest.mark.slow
def test_a_person_is_asked_before_it_moves(tmp_path: Path) -> None:
    """Assert that without a yes torque is never on and nothing is changed, and with one all is done and put back."""
    with VirtualGripper() as gripper:
        asked: list[str] = []
        made, _ = tried(tmp_path, gripper.port, lambda question: bool(asked.append(question)), arm=True)
        assert made.summary["ended"] == "stopped at: agreed"
        assert "space between them empty" in asked[0]
        assert gripper.read_register("Operating Mode") == 5
        assert is_off(gripper)
        (tmp_path / "report.json").unlink()
        made, _ = tried(tmp_path, gripper.port, lambda question: True, arm=True)
        assert made.summary["ended"] == "all as expected"
        assert gripper.read_register("Operating Mode") == 5
        assert is_off(gripper)


def test_ctrl_c_leaves_a_report_and_no_torque(tmp_path: Path) -> None:
    """Assert that an interrupted check says so in its report."""

    def interrupted(question: str) -> bool:
        raise KeyboardInterrupt

    with VirtualGripper() as gripper:
        with pytest.raises(KeyboardInterrupt):
            tried(tmp_path, gripper.port, interrupted, arm=True)
        assert is_off(gripper)
    assert json.loads((tmp_path / "report.json").read_text())["summary"]["ended"] == "interrupted"


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({}, "no device was given"),
        ({"gripper": "sim"}, "not a device"),
        ({"camera": "sim"}, "not a device"),
        ({"gripper": "/dev/ttyNothing"}, "--arm"),
        ({"gripper": "/dev/ttyNothing", "arm": True}, "a terminal, or --yes"),
    ],
)
def test_what_is_refused(flags: dict[str, Any], words: str, tmp_path: Path) -> None:
    """Assert that it is refused before anything is opened or written."""
    with pytest.raises(InputError, match=words):
        run(DoctorHardware(**flags), tmp_path / "report.json")
    assert not list(tmp_path.iterdir())


def test_a_report_is_not_replaced(tmp_path: Path) -> None:
    """Assert that a file that exists, or a folder that does not, is refused before anything is opened."""
    (tmp_path / "report.json").write_text("kept")
    for out in (tmp_path / "report.json", tmp_path / "none" / "report.json"):
        with pytest.raises(InputError, match="report cannot be written"):
            run(DoctorHardware(gripper="virtual"), out)
    assert (tmp_path / "report.json").read_text() == "kept"


def test_from_the_command_line(tmp_path: Path) -> None:
    """Assert exit codes 3 and 2, the steps on stderr, and that flags of this part are of no other."""
    out = str(tmp_path / "report.json")
    shown = CliRunner().invoke(app, ["doctor", "hardware", "--gripper", "virtual:overload", "-o", out])
    assert shown.exit_code == 3, shown.output
    assert "stopped at: hardware error" in shown.stdout and out in shown.stdout
    assert "expected every register can be read" in shown.stderr
    for flags in (["--arm"], ["--yes"], ["--camera", "virtual"], ["-o", out]):
        assert CliRunner().invoke(app, ["doctor", *flags]).exit_code == 2
