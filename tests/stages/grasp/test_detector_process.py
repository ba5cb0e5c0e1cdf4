"""The detector's loop: a sign for every slice, and every slice for the recorder."""

import multiprocessing
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import DeviceError
from evetac_cli.events import Events, empty
from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.realtime import scheduling
from evetac_cli.realtime.message_pipe import Inbox, Outbox
from evetac_cli.realtime.shared_status import DetectorStatus, SharedStatus
from evetac_cli.stages.grasp.detector_process import PIECE_MS, SliceBatch, feel, noise


class Camera:
    """Slices of noise, every fifth of them empty; its clock is 7 s behind the host's."""

    def __init__(self, slices: int) -> None:
        rng = np.random.default_rng(1)
        self.slices = [empty() if k % 5 == 4 else noise(rng, k) for k in range(slices)]
        self.read_so_far = 0

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


class Sense:
    """Feels slip in every third slice."""

    def __init__(self) -> None:
        self.steps = self.slips = 0

    def step(self, events: Events) -> float:
        self.steps += 1
        self.slips += self.steps % 3 == 0
        return 0.25 * (self.steps % 3)

    @property
    def felt(self) -> SlipSignal:
        return SlipSignal(self.slips, 0.25 * (self.steps % 3), 1.0, -2.0)


class Spied(SharedStatus):
    """A board that remembers all that it was told."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[DetectorStatus] = []

    def publish(self, sign: DetectorStatus) -> None:
        super().publish(sign)
        self.told.append(sign)


@pytest.fixture
def pipe() -> Iterator[tuple[Inbox, Outbox]]:
    reading, writing = multiprocessing.Pipe(duplex=False)
    yield Inbox(reading), Outbox(writing)
    reading.close()
    writing.close()


def pieces(inbox: Inbox, outbox: Outbox) -> list[SliceBatch]:
    found: list[SliceBatch] = []
    while outbox.waiting_bytes:
        found += inbox.take()
        outbox.send()
    return found + list(inbox.take())


def test_signs_and_slices(pipe: tuple[Inbox, Outbox]) -> None:
    """Assert that every slice gives a sign, with the host's time of the first event of slip, and is handed over."""
    camera, board, most = Camera(4 * PIECE_MS), Spied(), 2 * PIECE_MS + 7
    feel(camera, Sense(), board, pipe[1], most)
    assert [sign.slices for sign in board.told] == list(range(1, most + 1))
    assert [sign.felt.slips for sign in board.told] == [k // 3 for k in range(1, most + 1)]
    assert {sign.zero_us for sign in board.told} == {7e6}
    began = [7e6 + (float(camera.slices[k].t[0]) if camera.slices[k].size else 1e3 * k) for k in range(2, most, 3)]
    assert list(board.told[-1].slip_us) == began[-len(board.told[-1].slip_us) :]
    assert all(sign.heard_us == board.told[k - 1].heard_us for k, sign in enumerate(board.told) if k % 5 == 4)
    came = pieces(*pipe)
    assert [len(piece.counts) for piece in came] == [PIECE_MS, PIECE_MS, 7]
    assert [count for piece in came for count in piece.counts] == [part.size for part in camera.slices[:most]]
    t_us = np.concatenate([piece.events.t for piece in came])
    np.testing.assert_array_equal(t_us, np.concatenate([part.t for part in camera.slices[:most]]))
    assert [p for piece in came for p in piece.probability] == [0.25 * (k % 3) for k in range(1, most + 1)]


def test_without_a_detector(pipe: tuple[Inbox, Outbox]) -> None:
    """Assert that slices are recorded, and signs of life given, where nothing is felt."""
    board = Spied()
    feel(Camera(20), None, board, pipe[1], 10)
    assert board.told[-1].slices == 10
    assert board.told[-1].felt.slips == 0
    assert np.isnan(pieces(*pipe)[0].probability).all()


def test_ends(pipe: tuple[Inbox, Outbox]) -> None:
    """Assert that an order to stop ends it with what was felt, and that a stream which ends too early is an error."""
    board = Spied()
    board.stop()
    feel(Camera(20), Sense(), board, pipe[1], 10)
    assert board.told == []
    with pytest.raises(DeviceError, match="stream ended"):
        feel(Camera(20), Sense(), Spied(), pipe[1], 30)


def test_a_recorder_that_does_not_read() -> None:
    """Assert that slices which nobody fetches are an error once too much is waiting, and not silently lost."""
    reading, writing = multiprocessing.Pipe(duplex=False)
    with pytest.raises(DeviceError, match="cannot keep up"):
        feel(Camera(500), Sense(), Spied(), Outbox(writing, most_bytes=3_000_000), 500)
    reading.close()
    writing.close()


def test_urgency_as_far_as_permitted(monkeypatch: pytest.MonkeyPatch) -> None:
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
    monkeypatch.setattr(scheduling, "os", permitted)
    monkeypatch.setattr(scheduling, "sys", SimpleNamespace(platform="linux"))
    assert scheduling.set_realtime_priority(20) == "real-time 20"
    permitted.sched_setscheduler = refuse
    assert scheduling.set_realtime_priority(20, 4711) == "nice -10"
    assert asked[-1] == ("nice", (0, 4711, -10))
    permitted.setpriority = refuse
    assert scheduling.set_realtime_priority(20) == "as usual"
    monkeypatch.setattr(scheduling, "sys", SimpleNamespace(platform="darwin"))
    assert scheduling.set_realtime_priority(20) == "as usual"
