"""Faults of virtual devices by name: one grammar, and two tables that say which parts a fault takes."""

import re
from typing import Any

import numpy as np
import pytest

from evetac_cli.devices.naming import CAMERA_FAULTS, GRIPPER_FAULTS, Fault, camera_fault, gripper_fault
from evetac_cli.devices.virtual.gripper import LATE_S, Faults
from evetac_cli.devices.virtual.servo import Answer
from evetac_cli.errors import InputError
from evetac_cli.resources import PACKAGE


@pytest.mark.parametrize(
    ("read", "text", "fault"),
    [
        (camera_fault, "unplug@2.5", Fault("unplug", 2.5)),
        (camera_fault, "silence@1:0.5", Fault("silence", 1.0, 0.5)),
        (camera_fault, "damage", Fault("damage", None, 0.1)),
        (gripper_fault, "bad-crc%2.5", Fault("bad-crc", share=0.025)),
        (gripper_fault, "lost-answer%20@1:3", Fault("lost-answer", 1.0, 3.0, 0.2)),
        (gripper_fault, "false-voltage@1:0.5", Fault("false-voltage", 1.0, 0.5)),
    ],
)
def test_what_a_fault_is_named(read: Any, text: str, fault: Fault) -> None:
    """Assert that name, share, moment and duration are understood, and that a fault has its usual duration."""
    assert read(text) == fault


NO_FAULTS = ["", "@1", "fire@1", "unplug@x", "unplug@", "unplug@-1", "unplug@inf", "unplug%5"]
NO_FAULT_OF = {
    "camera": [*NO_FAULTS, "busy@1", "damage%5", "silence@1:x", "silence@1:-1", "silence@1:", "watchdog"],
    "gripper": [*NO_FAULTS, "bad-crc%101", "bad-crc%0", "bad-crc%", "bad-crc@1:2", "overload@1:2", "stall"],
}


@pytest.mark.parametrize(("device", "text"), [(of, text) for of, texts in NO_FAULT_OF.items() for text in texts])
def test_what_is_no_fault_is_refused(device: str, text: str) -> None:
    """Assert an InputError that names the flag, whatever part of the text is wrong."""
    with pytest.raises(InputError, match=f"--{device}"):
        (camera_fault if device == "camera" else gripper_fault)(text)


def test_how_long_a_fault_lasts() -> None:
    """Assert that it lasts from its moment to its end, that included and this not, and without a duration for good."""
    assert [camera_fault("damage@1:0.5").lasts(now_s) for now_s in (0.9, 1.0, 1.4, 1.5)] == [False, True, True, False]
    assert camera_fault("unplug@1").lasts(1e9)
    assert not camera_fault("unplug").lasts(-1.0)


def spoilt(faults: Faults, times_s: list[float]) -> list[Answer | None]:
    return [faults.spoil(Answer(b"ab", 0.0), now_s, torque=True) for now_s in times_s]


def test_a_share_of_answers_is_lost_for_its_time() -> None:
    """Assert that answers are lost between moment and end, counted from the first torque, and none else."""
    faults = Faults([gripper_fault("lost-answer%100@1:2")], np.random.default_rng(0))
    answer = Answer(b"ab", 0.0)
    assert faults.spoil(answer, 0.0, torque=False) == answer
    assert spoilt(faults, [10.0, 10.9, 11.0, 12.9, 13.0]) == [answer, answer, None, None, answer]


def test_an_answer_is_spoilt_once() -> None:
    """Assert that a fault without a share hits one answer, which is damaged or late, and that others wait for it."""
    faults = Faults([gripper_fault("bad-crc"), gripper_fault("late-answer@1")], np.random.default_rng(0))
    assert faults.due(0.0, torque=True) == []
    damaged, whole, late = spoilt(faults, [0.0, 0.5, 1.0])
    assert damaged is not None and damaged.data[:1] == b"a" and damaged.data[1:] != b"b"
    assert whole == (b"ab", 0.0)
    assert late == (b"ab", LATE_S)
    faults.add(gripper_fault("overload@2"))
    assert [faults.due(now_s, torque=True) for now_s in (1.9, 2.0, 2.1)] == [[], ["overload"], []]


def test_false_readings_last_for_their_time() -> None:
    """Assert that registers show what was asked for between moment and end, or for good, and then what is measured."""
    texts = ("false-current@1:2", "false-voltage")
    faults = Faults([gripper_fault(text) for text in texts], np.random.default_rng(0))
    assert faults.false_readings(0.0) == {"Present Input Voltage": 0}
    assert faults.due(10.0, torque=True) == []
    shown = [set(faults.false_readings(now_s)) for now_s in (10.9, 11.0, 12.9, 13.0)]
    voltage, both = {"Present Input Voltage"}, {"Present Input Voltage", "Present Current"}
    assert shown == [voltage, both, both, voltage]
    assert faults.struck == {"false-current": 1, "false-voltage": 1}


def test_the_page_on_safety_lists_every_fault_of_a_gripper() -> None:
    """Assert that docs/safety.md has a row for each."""
    page = (PACKAGE.parent / "docs" / "safety.md").read_text()
    assert [name for name in GRIPPER_FAULTS if f"| `{name}` |" not in page] == []


def test_the_page_on_hardware_names_every_fault_and_no_other() -> None:
    """Assert that the table of faults in docs/hardware.md is that of the code, for cameras and for grippers."""
    table = (
        (PACKAGE.parent / "docs" / "hardware.md").read_text().split("| camera | | gripper | |\n")[1].split("\n\n")[0]
    )
    rows = [line.strip("|").split("|") for line in table.splitlines()[1:]]
    for column, faults in ((0, CAMERA_FAULTS), (2, GRIPPER_FAULTS)):
        named = {name for row in rows for name in re.findall("`([a-z][a-z0-9-]*)`", row[column])}
        assert named == set(faults)


def test_no_page_shows_a_fault_that_is_none() -> None:
    """Assert that each fault in a command of README or docs is one."""
    pages = [PACKAGE.parent / "README.md", *(PACKAGE.parent / "docs").rglob("*.md")]
    shown = re.findall("--(camera|gripper) virtual:([a-z][^\\s`|*]*)", "\n".join(page.read_text() for page in pages))
    assert shown
    read = {"camera": camera_fault, "gripper": gripper_fault}
    for device, text in shown:
        for fault in text.rstrip(".,").split("+"):
            if fault not in ("NAME", "prepared"):
                read[device](fault)
