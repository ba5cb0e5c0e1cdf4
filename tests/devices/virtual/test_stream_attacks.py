"""Attacks on the stream of a virtual camera: the driver outlasts each, and counts what the camera counts."""

import pytest

from evetac_cli.devices.virtual.stream_attacks import ATTACKS, Attack, Ending, attack

EVENTS_S = 100_000
QUICK = ("random@0:600", "torn@0.5", "jump-forward@0.5", "jump-back@0.5", "fast@0.2", "slow@0.2", "silence@0.5:0.3")


@pytest.mark.parametrize(
    "attacked",
    [pytest.param(each, id=each.fault, marks=() if each.fault in QUICK else pytest.mark.slow) for each in ATTACKS],
)
def test_the_driver_outlasts_every_attack(attacked: Attack) -> None:
    """Assert slices that follow the host's time, and losses that are the camera's own count, or at least so many."""
    ending = attack(attacked.fault, 1.0, EVENTS_S)
    assert ending.slices == 1000
    assert ending.faults(attacked, EVENTS_S) == []


@pytest.mark.parametrize(
    ("ending", "countable", "wrong"),
    [
        (Ending(5000, 1000.0, 100_000, 100_000, 0), True, ["5000 slices in 1000 ms"]),
        (Ending(100, 5000.0, 500_000, 500_000, 0), True, ["100 slices in 5000 ms"]),
        (Ending(1000, 1000.0, 50_000, 100_000, 0), True, ["0 events said to be lost, 50000 were"]),
        (Ending(1000, 1000.0, 90_000, 100_000, 30_000), True, None),
        (Ending(1000, 1000.0, 90_000, 100_000, "unknown, at least 30,000"), False, None),
        (Ending(1000, 1000.0, 90_000, 100_000, "unknown, at least 9,000"), True, ["the number is not known"]),
        (Ending(1000, 1000.0, 50_000, 100_000, "unknown, at least 9,000"), False, []),
        (Ending(1000, 1000.0, 50_000, 100_000, 49_000), True, []),
    ],
)
def test_what_is_wrong_with_an_ending(ending: Ending, countable: bool, wrong: list[str] | None) -> None:
    """Assert that slices beyond the host's time and counts that are not the camera's are found."""
    faults = ending.faults(Attack("any", countable), EVENTS_S)
    assert faults == wrong if wrong is not None else faults
