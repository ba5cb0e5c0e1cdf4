"""Faults of a virtual servo by name."""

import pytest

from evetac_cli.devices.virtual.servo_faults import ServoFault
from evetac_cli.errors import InputError


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("unplug", ServoFault("unplug")),
        ("lost-answer@1.5", ServoFault("lost-answer", 1.5)),
        ("bad-crc%2.5", ServoFault("bad-crc", None, 0.025)),
        ("late-answer@0", ServoFault("late-answer", 0.0)),
    ],
)
def test_faults_are_parsed(text: str, fault: ServoFault) -> None:
    """Assert that a fault's name, moment and share are understood."""
    assert ServoFault.parse(text) == fault


@pytest.mark.parametrize("text", ["", "fire", "unplug@", "unplug@x", "unplug%5", "bad-crc%101", "bad-crc@-1", "a%1@2"])
def test_other_faults_are_refused(text: str) -> None:
    """Assert that what is no fault is refused, with all that are."""
    with pytest.raises(InputError, match="late-answer, lost-answer, bad-crc, watchdog, overload, unplug"):
        ServoFault.parse(text)
