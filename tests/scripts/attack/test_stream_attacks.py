"""Attacks on the stream of a virtual camera: the driver outlasts each, and counts what the camera counts."""

import time
from typing import Any

import pytest

from evetac_cli.devices.dvxplorer.usb_reader import UsbReader
from evetac_cli.realtime.shared_time import SharedTime
from scripts.attack.stream_attacks import ATTACKS, Attack, Ending, attack

EVENTS_S = 100_000
QUICK = ("random@0:600", "torn@0.5", "jump-forward@0.5", "jump-back@0.5", "silence@0.5:0.3")


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """The driver's kernels are compiled: a camera does not wait for that."""
    attack(ATTACKS[0], 0.01, EVENTS_S)


@pytest.mark.parametrize(
    "attacked",
    [pytest.param(each, id=each.fault, marks=() if each.fault in QUICK else pytest.mark.slow) for each in ATTACKS],
)
def test_the_driver_outlasts_every_attack(attacked: Attack) -> None:
    """Assert slices that follow the host's time, and losses that are the camera's own count, or at least so many."""
    ending = attack(attacked, 1.0, EVENTS_S, SharedTime())
    assert ending.slices == 1000
    assert ending.faults(attacked, EVENTS_S) == []


@pytest.mark.parametrize("late", [(0.0, 0.7), pytest.param((0.35, 0.4), marks=pytest.mark.slow), (0.48, 0.3)], ids=str)
@pytest.mark.parametrize("fault", [fault for fault in QUICK if "@0:" not in fault])
def test_a_computer_that_stands_still_changes_no_count(
    fault: str, late: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that the events that are lost are known and right where the thread that reads is kept from running.

    From so long after its first read, for so long: as on a computer that others need, at the start or over the fault.
    The camera's time does not wait here, so of how far the slices came nothing is said.
    """
    at_s, for_s = late
    started_s: list[float] = []  # of the first read, and of the one that is late
    put = UsbReader._put

    def delayed(reader: UsbReader, block: Any) -> None:
        if not started_s:
            started_s.append(time.monotonic())
        if len(started_s) == 1 and time.monotonic() >= started_s[0] + at_s:
            started_s.append(time.monotonic())
            time.sleep(for_s)
        put(reader, block)

    monkeypatch.setattr(UsbReader, "_put", delayed)
    attacked = next(each for each in ATTACKS if each.fault == fault)
    ending = attack(attacked, 1.0, EVENTS_S)
    assert [words for words in ending.faults(attacked, EVENTS_S) if "slices in" not in words] == []


@pytest.mark.parametrize(
    ("ending", "countable", "wrong"),
    [
        (Ending(5000, 1000.0, 100_000, 100_000, 0), True, ["5000 slices in 1000 ms"]),
        (Ending(100, 5000.0, 500_000, 500_000, 0), True, ["100 slices in 5000 ms"]),
        (Ending(1000, 1000.0, 50_000, 100_000, 0), True, ["0 events reported as lost, 50000 were"]),
        (Ending(1000, 1000.0, 90_000, 100_000, 30_000), True, None),
        (Ending(1000, 1000.0, 90_000, 100_000, "unknown, at least 30,000"), False, None),
        (
            Ending(1000, 1000.0, 90_000, 100_000, "unknown, at least 9,000"),
            True,
            ["the number of lost events is unknown"],
        ),
        (Ending(1000, 1000.0, 50_000, 100_000, "unknown, at least 9,000"), False, []),
        (Ending(1000, 1000.0, 50_000, 100_000, 49_000), True, []),
        (Ending(1000, 1200.0, 100_000, 120_000, 0, 20_000), True, []),
        (Ending(1000, 1200.0, 100_000, 120_000, 0, 10_000), True, ["0 events reported as lost, 10000 were"]),
        (Ending(1000, 1200.0, 100_000, 120_000, 9_500, 10_000), True, []),
    ],
)
def test_what_is_wrong_with_an_ending(ending: Ending, countable: bool, wrong: list[str] | None) -> None:
    """Assert that slices beyond the host's time and counts that are not the camera's are found."""
    faults = ending.faults(Attack("any", countable), EVENTS_S)
    assert faults == wrong if wrong is not None else faults
