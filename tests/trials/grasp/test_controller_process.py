"""The controller and its watchdog, on a clock that only these tests move."""

import math
import signal
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from evetac_cli.errors import DeviceError
from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.realtime.shared_status import DetectorStatus
from evetac_cli.trials.grasp.controller_process import COMMAND_BYTES, OVER, STOPPED, TOO_LONG, FaultDetector
from evetac_cli.trials.grasp.deadlines import FRESH_US
from evetac_cli.trials.grasp.loop import Timing
from evetac_cli.trials.session import OPENED, RECORDER_LATE_MS
from tests.trials.grasp.bench import FELT_S, PERIOD_S, WRITE_S, Bench, goals_by_law


def test_watch() -> None:
    """Assert that silence of detector, camera and recorder are told apart, within the watchdog's time or 75 ms."""
    faults = FaultDetector(60)
    status = DetectorStatus(SlipSignal(), 10, at_us=1e6, last_event_us=1e6, zero_us=0.0, slip_us=())
    assert faults.fault(status, 1e6, 1.044e6)[0] == ""
    reason, alive_us = faults.fault(status, 1.04e6, 1.046e6)
    assert ("detector" in reason, alive_us) == (True, 1e6)
    reason, alive_us = faults.fault(status._replace(at_us=1.04e6), 1.04e6, 1.046e6)
    assert ("camera" in reason, alive_us) == (True, 1e6)
    later = status._replace(at_us=1.07e6, last_event_us=1.07e6)
    assert faults.fault(later, 1e6, 1.074e6)[0] == ""
    reason, alive_us = faults.fault(later, 1e6, 1.076e6)
    assert ("recorder" in reason, alive_us) == (True, 1e6)
    assert FaultDetector(200).fault(later._replace(at_us=1.14e6, last_event_us=1.14e6), 1e6, 1.149e6)[0] == ""
    assert "recorder" in faults.fault(status, -math.inf, 1.001e6)[0]  # it never gave a sign of life


def test_a_recorder_that_waits_for_a_core_is_late_for_seconds() -> None:
    """Assert that a silent recorder ends the grasp at once if it was stopped, and if it was not, after its 5 s."""
    stopped = False
    faults = FaultDetector(60, recorder_stopped=lambda: stopped)

    def fault(silent_ms: float) -> str:
        now_us = 10e6
        status = DetectorStatus(SlipSignal(), 10, at_us=now_us, last_event_us=now_us, zero_us=0.0, slip_us=())
        return faults.fault(status, now_us - 1e3 * silent_ms, now_us)[0]

    assert [fault(ms) for ms in (74, 76, 1000, RECORDER_LATE_MS - 1)] == [""] * 4
    assert fault(RECORDER_LATE_MS + 1) == "the recorder hangs: no sign of life for 5001 ms"
    stopped = True
    assert fault(74) == ""
    assert fault(76) == "the recorder hangs: no sign of life for 76 ms"


def test_watch_counts_only_while_it_runs_but_not_for_ever() -> None:
    """Assert that who was stopped with the controller has time to go on, but no more than that time."""
    faults = FaultDetector(60)
    status = DetectorStatus(SlipSignal(), 10, at_us=1e6, last_event_us=1e6, zero_us=0.0, slip_us=())
    faults.slept_until(1.04e6)
    assert faults.fault(status, 1e6, 1.084e6)[0] == ""
    assert "detector" in faults.fault(status, 1e6, 1.086e6)[0]
    faults.slept_until(1.09e6)
    assert "detector" in faults.fault(status, 1e6, 1.091e6)[0]


def test_a_grasp_that_is_over(bench: Callable[..., Bench]) -> None:
    """Assert that it steps 500 times a second without a miss, decides as the law does, and ends with torque off."""
    at = bench(slips=lambda k: 150 <= k < 160 or 320 <= k < 330)
    ended, rows = at.run()
    assert (ended.ended, ended.error, ended.missed) == (OVER, None, 0)
    assert at.hand.closed_s is not None
    assert ended.steps == len(rows)
    assert ended.steps / ended.seconds == pytest.approx(500.0, rel=0.01)
    phases = [row["control/phase"] for row in rows]
    assert sorted(phases) == phases
    assert set(phases) == set(GraspPhase)
    assert goals_by_law(rows, lambda k: 150 <= k < 160 or 320 <= k < 330) == at.hand.goals
    assert sum(row["control/slip"] for row in rows) == pytest.approx(10, abs=2)
    times = [row["control/t_us"] for row in rows]
    assert all(earlier < later for earlier, later in pairwise(times))


def test_latency_is_from_the_event_to_the_last_byte(bench: Callable[..., Bench]) -> None:
    """Assert that latency counts slice, detector, waiting, command and wire, and exists only after a new slip.

    In contact slip waits for the next step; later, half of it comes just before a step and half is answered at once.
    """
    at = bench(slips=lambda k: k % 50 == 7 or k % 50 == 30)
    _, rows = at.run()
    wire_us = COMMAND_BYTES * 10 / 2.0
    least_us = 1000.0 - 50.0 + FELT_S * 1e6 + WRITE_S * 1e6 + wire_us
    latency = np.array([row["control/latency_us"] for row in rows])
    new = np.array([row["control/slip"] for row in rows], bool)
    touched = np.array([row["control/phase"] for row in rows]) != GraspPhase.CONTACT
    assert new[touched].sum() == 12
    assert new[~touched].sum() == 4
    assert (np.isfinite(latency) == new).all()
    assert (latency[new] >= least_us - 0.01).all()
    assert (latency[new] <= least_us + PERIOD_S * 1e6 + 0.01).all()
    later = latency[new & touched][4:]  # once the steps follow the slices
    assert later[-2] == pytest.approx(least_us + FRESH_US, abs=20.0)
    assert later[1::2] == pytest.approx(least_us, abs=0.01)


@pytest.mark.parametrize(
    ("silent", "what", "after_ms"),
    [("dies_at", "detector", 45), ("silent_at", "camera", 45), ("recorder_dies_at", "recorder", 75)],
)
def test_silence_ends_with_torque_off(bench: Callable[..., Bench], silent: str, what: str, after_ms: int) -> None:
    """Assert that a hanging detector or recorder, or a silent camera, ends the grasp within the watchdog's time."""
    at = bench()
    setattr(at, silent, 250)
    if silent == "dies_at":  # the clock of this bench is the detector's; the recorder lives on
        passing = at.clock.passing
        at.clock.passing = lambda: (passing(), at.shared.recorder_lives(at.clock.s * 1e6))[0]
    ended, _ = at.run()
    assert what in ended.ended
    assert isinstance(ended.error, DeviceError)
    assert "; torque is off (read back)" in str(ended.error)
    assert ended.torque == "torque is off (read back)"
    assert 0.0 < ended.released_us - ended.alive_us - 1e3 * after_ms < 3_000.0
    assert at.hand.closed_s == pytest.approx(ended.released_us * 1e-6)


def test_a_bus_that_fails(bench: Callable[..., Bench]) -> None:
    """Assert that the driver's error ends the grasp and is handed on; when torque was off is not known."""
    at = bench()
    at.hand.fails_at = 60
    ended, rows = at.run()
    assert ended.ended.endswith("no answer")
    assert isinstance(ended.error, DeviceError)
    assert math.isnan(ended.released_us)
    assert at.hand.closed_s is not None
    assert len(rows) == ended.steps == 60


def test_a_computer_that_stops_everything(bench: Callable[..., Bench]) -> None:
    """Assert that 0.05 s in which no process ran is no death of the detector, and that its deadlines are counted."""
    at = bench()
    at.hand.frozen_at, at.hand.frozen_s = 60, 0.05
    ended, rows = at.run()
    assert ended.ended == OVER
    assert ended.missed == pytest.approx(25, abs=1)
    assert sum(row["control/missed"] for row in rows) == ended.missed


@pytest.mark.parametrize("frozen_s", [0.065, 0.1, 10.0])
def test_a_controller_that_was_stopped_does_not_grip_again(bench: Callable[..., Bench], frozen_s: float) -> None:
    """Assert that a stop longer than the watchdog's time ends with torque off, before another goal is written."""
    at = bench()
    at.hand.frozen_at, at.hand.frozen_s = 60, frozen_s
    ended, _ = at.run(most_s=1e3, timing=Timing(100, 200, 100_000))
    assert "the controller was stopped for" in ended.ended
    assert "; torque is off (read back)" in str(ended.error)
    assert len(at.hand.goals) == 60
    assert at.hand.closed_s is not None


def test_the_emergency_key_opens(bench: Callable[..., Bench]) -> None:
    """Assert that it opens within a step, ends with its own word and no error, and commands nothing afterwards."""
    at = bench()
    at.key_at = 120
    ended, _ = at.run()
    assert (ended.ended, ended.error) == (OPENED, None)
    assert at.hand.opened_s == pytest.approx(at.zero_s + 0.121 + FELT_S, abs=2 * PERIOD_S)
    assert ended.torque == "torque is off (read back)"


def test_a_signal_to_the_controller_ends_in_words(bench: Callable[..., Bench]) -> None:
    """Assert that a signal ends it at the next step, torque off, and is named; before the first slice too."""
    at = bench()
    came: list[int] = []
    passing = at.clock.passing
    at.clock.passing = lambda: (passing(), came.append(signal.SIGTERM) if at.clock.s > at.zero_s + 0.1 else None)[0]
    ended, _ = at.run(ending=came)
    assert str(ended.error) == "the controller was ended by SIGTERM; torque is off (read back)"
    at = bench()
    at.clock.passing = lambda: None
    ended, rows = at.run(ending=[signal.SIGUSR1])
    assert ended.ended == "the controller was ended by SIGUSR1"
    assert not at.hand.goals


def test_stop_and_too_long(bench: Callable[..., Bench]) -> None:
    """Assert that an order to stop and the longest time end a grasp, with torque off and no error."""
    at = bench()
    at.stops_at = 120
    ended, _ = at.run()
    assert (ended.ended, ended.error) == (STOPPED, None)
    assert at.hand.closed_s is not None
    at = bench()
    ended, _ = at.run(most_s=0.1)
    assert (ended.ended, ended.error) == (TOO_LONG, None)
    assert ended.steps == pytest.approx(50, abs=2)
    assert at.hand.closed_s is not None


def test_slip_of_the_second_finger_alone(bench: Callable[..., Bench]) -> None:
    """Assert that it is answered as slip of the first, with its latency, and that the law over the rows agrees.

    Where the second finger is not asked, the same goals are those of a grasp without slip.
    """

    def second(slice_: int) -> bool:
        return 150 <= slice_ < 160 or 320 <= slice_ < 330

    at, blind = bench(second=second), bench()
    ended, rows = at.run()
    assert (ended.ended, ended.error, ended.missed) == (OVER, None, 0)
    assert goals_by_law(rows, lambda k: False, second) == at.hand.goals
    assert sum(row["control/slip"] for row in rows) == pytest.approx(10, abs=2)
    assert sum(np.isfinite(row["control/latency_us"]) for row in rows) == sum(row["control/slip"] for row in rows)
    assert not any(row["control/slip"] for row in blind.run()[1])
    assert max(at.hand.goals) > max(blind.hand.goals)


@pytest.mark.parametrize(("silent", "what"), [("second_dies_at", "detector"), ("second_silent_at", "camera")])
def test_silence_of_the_second_finger_ends_with_torque_off(bench: Callable[..., Bench], silent: str, what: str) -> None:
    """Assert that its hanging detector or silent camera ends the grasp as those of the first do, and is named."""
    at = bench(second=lambda k: False)
    setattr(at, silent, 250)
    ended, _ = at.run()
    assert f"the {what} of the second finger" in ended.ended
    assert ended.torque == "torque is off (read back)"
    assert 0.0 < ended.released_us - ended.alive_us - 45_000.0 < 3_000.0
    assert at.hand.closed_s == pytest.approx(ended.released_us * 1e-6)


@pytest.mark.parametrize("finger", [0, 1])
def test_the_death_of_either_detector_is_told(finger: int) -> None:
    """Assert that a detector whose process ended is named at once."""
    faults = FaultDetector(60, has_ended=lambda asked: asked == finger)
    status = DetectorStatus(SlipSignal(), 10, at_us=1e6, last_event_us=1e6, zero_us=0.0, slip_us=())
    reason, _ = faults.fault(status._replace(second=status), 1e6, 1.001e6)
    assert reason == f"the detector of the {('first', 'second')[finger]} finger died"
