"""The detector's loop: a status for every slice, and every slice for the recorder."""

import multiprocessing
import subprocess
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import DeviceError
from evetac_cli.events import Events, empty
from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.realtime import processes
from evetac_cli.realtime.message_pipe import MessageReader, MessageWriter
from evetac_cli.realtime.shared_status import DetectorStatus, SharedStatus
from evetac_cli.resources import PACKAGE
from evetac_cli.trials.grasp.detector_process import BATCH_MS, DetectorLoop, SliceBatch, noise
from tests.devices.stand_ins import StillCamera


class Camera(StillCamera):
    """Slices of noise, every fifth of them empty; its clock is 7 s behind the host's."""

    def __init__(self, slices: int) -> None:
        rng = np.random.default_rng(1)
        self.slices = [empty() if k % 5 == 4 else noise(rng, k) for k in range(slices)]
        self.read_so_far = 0
        self.counted = {"late_events": 2}

    def read(self) -> Events | None:
        if self.read_so_far == len(self.slices):
            return None
        self.read_so_far += 1
        return self.slices[self.read_so_far - 1]

    def host_us(self, device_us: float) -> float:
        return 7e6 + device_us

    def now_us(self) -> int:
        return 1000 * self.read_so_far

    def close(self) -> None:
        pass


class Detector:
    """Detects slip in every third slice."""

    def __init__(self) -> None:
        self.steps = self.slips = 0

    def tell_gripper(self, position_ticks: float, goal_ticks: float) -> None:
        self.told = position_ticks, goal_ticks

    def step(self, events: Events) -> float:
        self.steps += 1
        self.slips += self.steps % 3 == 0
        return 0.25 * (self.steps % 3)

    @property
    def signal(self) -> SlipSignal:
        return SlipSignal(self.slips, 0.25 * (self.steps % 3), 1.0, -2.0)


class SpiedStatus(SharedStatus):
    """Shared memory that remembers all that was published."""

    def __init__(self) -> None:
        super().__init__()
        self.published: list[DetectorStatus] = []

    def publish(self, status: DetectorStatus, finger: int = 0) -> None:
        super().publish(status, finger)
        self.published.append(status)


@pytest.fixture
def pipe() -> Iterator[tuple[MessageReader, MessageWriter]]:
    reading, writing = multiprocessing.Pipe(duplex=False)
    yield MessageReader(reading), MessageWriter(writing)
    reading.close()
    writing.close()


def batches_in(inbox: MessageReader, outbox: MessageWriter) -> list[SliceBatch]:
    batches: list[SliceBatch] = []
    while outbox.waiting_bytes:
        batches += inbox.take()
        outbox.send()
    return batches + list(inbox.take())


def test_status_and_slices(pipe: tuple[MessageReader, MessageWriter]) -> None:
    """Assert that every slice gives a status, with the host's time of the first event of slip, and is handed over."""
    camera, shared, most = Camera(4 * BATCH_MS), SpiedStatus(), 2 * BATCH_MS + 3
    DetectorLoop(camera, Detector(), shared, pipe[1], most).run()
    assert [status.slices for status in shared.published] == list(range(1, most + 1))
    assert [status.signal.slips for status in shared.published] == [k // 3 for k in range(1, most + 1)]
    assert {status.zero_us for status in shared.published} == {7e6}
    began = [7e6 + (float(camera.slices[k].t[0]) if camera.slices[k].size else 1e3 * k) for k in range(2, most, 3)]
    assert list(shared.published[-1].slip_us) == began[-len(shared.published[-1].slip_us) :]
    last_us = [status.last_event_us for status in shared.published]
    assert all(last_us[k] == last_us[k - 1] for k in range(4, len(last_us), 5))
    batches = batches_in(*pipe)
    assert [len(batch.counts) for batch in batches] == [BATCH_MS, BATCH_MS, 3]
    assert [count for batch in batches for count in batch.counts] == [part.size for part in camera.slices[:most]]
    t_us = np.concatenate([batch.events.t for batch in batches])
    np.testing.assert_array_equal(t_us, np.concatenate([part.t for part in camera.slices[:most]]))
    assert [p for batch in batches for p in batch.probability] == [0.25 * (k % 3) for k in range(1, most + 1)]


def test_slices_before_the_order_are_evaluated_and_not_published(pipe: tuple[MessageReader, MessageWriter]) -> None:
    """Assert that the gripper's controller hears nothing before it may move, and then nothing that is old."""
    shared, asked = SpiedStatus(), iter([False] * 6 + [True])
    DetectorLoop(Camera(20), Detector(), shared, pipe[1], 12, may_move=lambda: next(asked)).run()
    assert [status.slices for status in shared.published] == list(range(7, 13))
    assert [status.signal.slips for status in shared.published] == [k // 3 for k in range(7, 13)]
    assert sum(len(batch.counts) for batch in batches_in(*pipe)) == 12


def test_the_detector_knows_what_the_controller_told(pipe: tuple[MessageReader, MessageWriter]) -> None:
    """Assert that a detector is told of the gripper as soon as the controller has read it, and not before."""
    shared, detector = SpiedStatus(), Detector()
    DetectorLoop(Camera(20), detector, shared, pipe[1], 2).run()
    assert not hasattr(detector, "told")
    shared.tell_gripper(300.0, 310.0)
    DetectorLoop(Camera(20), detector, shared, pipe[1], 2).run()
    assert detector.told == (300.0, 310.0)


def test_ends(pipe: tuple[MessageReader, MessageWriter]) -> None:
    """Assert that an order to stop ends it, and that a stream which ends too early is an error."""
    shared = SpiedStatus()
    shared.stop()
    DetectorLoop(Camera(20), Detector(), shared, pipe[1], 10).run()
    assert shared.published == []
    with pytest.raises(DeviceError, match="stream ended"):
        DetectorLoop(Camera(20), Detector(), SpiedStatus(), pipe[1], 30).run()


def test_a_recorder_that_does_not_read() -> None:
    """Assert that slices which are not fetched are an error once too much is waiting, and not silently lost."""
    reading, writing = multiprocessing.Pipe(duplex=False)
    with pytest.raises(DeviceError, match="cannot keep up"):
        DetectorLoop(Camera(500), Detector(), SpiedStatus(), MessageWriter(writing, most_bytes=3_000_000), 500).run()
    reading.close()
    writing.close()


def test_priority_as_far_as_permitted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that what is not permitted is not asked for again but left, and that what came of it is said."""
    asked: list[tuple[str, Any]] = []

    def refuse(*what: Any) -> None:
        asked.append(("real-time", what))
        raise PermissionError

    permitted = SimpleNamespace(
        SCHED_FIFO=1,
        sched_param=lambda rank: rank,
        sched_setscheduler=lambda *what: asked.append(("real-time", what)),
        PRIO_PROCESS=0,
        setpriority=lambda *what: asked.append(("nice", what)),
    )
    monkeypatch.setattr(processes, "os", permitted)
    monkeypatch.setattr(processes, "sys", SimpleNamespace(platform="linux"))
    assert processes.set_realtime_priority(20) == "real-time 20"
    permitted.sched_setscheduler = refuse
    assert processes.set_realtime_priority(20, 4711) == "nice -10"
    assert asked[-1] == ("nice", (0, 4711, -10))
    permitted.setpriority = refuse
    assert processes.set_realtime_priority(20) == "as usual"
    monkeypatch.setattr(processes, "sys", SimpleNamespace(platform="darwin"))
    assert processes.set_realtime_priority(20) == "as usual"


WARMED = """
import sys
import numpy as np
from evetac_cli.commands.grasp import Grasp
from evetac_cli.devices.cameras import parse
from evetac_cli.trials.grasp.detector_process import DetectorSettings, noise, open_detector
from evetac_cli.trials.grasp.settings import DetectorModel

x, y = np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0)
sensor = {"sensor/dot_xy_px": np.stack([x, y], axis=-1), "sensor/dot_radius_px": 11.0}
sensor["sensor/frame_px"] = (640, 480)
seeds = np.random.SeedSequence(0)
detector = open_detector(DetectorSettings(parse("virtual"), seeds, sensor, DetectorModel.of(Grasp()), 1))
assert detector.count == 0 and np.isnan(detector.probability)
loaded, rng = set(sys.modules), np.random.default_rng(0)
for k in range(200):
    detector.step(noise(rng, k))
assert detector.count == 0  # noise is no slip
print(sorted(set(sys.modules) - loaded))
"""


def test_a_detector_loads_nothing_once_the_camera_runs() -> None:
    """Assert that the first slices need no module that is not there: loading one stopped a grasp for 0.2 s."""
    done = subprocess.run(
        [sys.executable, "-c", WARMED], capture_output=True, text=True, check=False, cwd=PACKAGE.parent
    )
    assert (done.stdout.strip(), done.returncode) == ("[]", 0), done.stderr
