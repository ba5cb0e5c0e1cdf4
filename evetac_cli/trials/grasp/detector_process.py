"""The detector's process of a grasp in real time: a slice in, a status in shared memory out, 1000 times a second.

Everything that takes long is done before the camera runs: loading, compiling, a first run on noise. Slices go to the
recorder in batches, without waiting for it.
"""

import contextlib
import gc
import math
import os
import signal
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.devices import EventCamera
from evetac_cli.devices.cameras import CameraSettings, NamedCamera
from evetac_cli.errors import DeviceError, EvetacError
from evetac_cli.events import FRAME_PX, SLICE_US, Events, empty
from evetac_cli.interrupts import ignore_interrupts, remember_signals
from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.realtime.last_words import error_words
from evetac_cli.realtime.message_pipe import MessageWriter, PeerGone, take_order
from evetac_cli.realtime.processes import (
    NICE,
    set_niceness,
)
from evetac_cli.realtime.shared_status import REMEMBERED, DetectorStatus, SharedStatus
from evetac_cli.trials.grasp.detector_load import DetectorLoad, LoadMeter
from evetac_cli.trials.grasp.loop import SliceDetector
from evetac_cli.trials.grasp.settings import DetectorModel
from evetac_cli.trials.session import OVERLOADED

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.world import VirtualWorld

BATCH_MS = 5  # slices that the recorder gets at once: of 50, copying took a millisecond
COUNTED_SLICES = 100  # the recorder gets to know what the camera lost after so many
FLUSH_US = 250  # a quiet camera's words are sent this often: a slice is evaluated the sooner
WARM_UP_SLICES, MOST_WARM_UP_SLICES = 30, 2000  # of noise, before the camera runs
WARM_UP_EVENTS = 3000  # in each
FLUSH_S = 5.0
LAST_FLUSH_S = 60.0  # of the last messages, for a recorder that is busy: without them it would not know how this ended
ORDER_S = 0.1
SWITCH_S = 2e-4  # the threads that read and decode take turns so often


@dataclass(frozen=True)
class DetectorSettings:
    """What the detector's process is made of; it is sent there."""

    camera: NamedCamera
    seeds: np.random.SeedSequence
    sensor: Mapping[str, Any]  # with the dot grid
    model: DetectorModel | None  # None: slices are recorded, and no slip is detected
    slices: int  # after which the grasp is over
    finger: int = 0  # 1: the second, whose camera leads nothing: it sees until it is stopped


class CameraReady(NamedTuple):
    """The camera runs: what it is, how it is set, and how its process is scheduled."""

    sensor: Mapping[str, Any]
    setup: Mapping[str, Any]
    notes: tuple[str, ...]
    scheduling: str


@dataclass
class SliceBatch:
    """Some slices, one after the other, for the recorder; the lists have an item for each.

    Why so: columns travel as bytes, joined without a step between, in a quarter of the time that arrays take.
    """

    columns: tuple[bytes, ...] = ()  # of the events of all, as they lie in memory
    counts: list[int] = field(default_factory=list)
    probability: list[float] = field(default_factory=list)
    at_us: list[float] = field(default_factory=list)  # when it was evaluated
    late_us: list[float] = field(default_factory=list)  # from the end of a slice until it was evaluated, where known
    counted: Mapping[str, int] | None = None  # what the camera lost so far, by reason; now and then

    @property
    def size(self) -> int:
        """Bytes of memory that the events take."""
        return sum(len(column) for column in self.columns)

    @property
    def events(self) -> Events:
        """The events of all slices."""
        if not self.columns:
            return empty()
        t, x, y, p = self.columns
        x_px, y_px = (np.frombuffer(data, np.uint16) for data in (x, y))
        return Events(np.frombuffer(t, np.int64), x_px, y_px, np.frombuffer(p, np.uint8))


def joined(slices: Sequence[Events]) -> tuple[bytes, ...]:
    """The columns of slices for a batch."""
    return tuple(b"".join(column) for column in zip(*slices, strict=True))


class DetectorEnded(NamedTuple):
    """What the camera lost, by reason, what failed, if anything did, and what it took, once the detector has ended."""

    counted: Mapping[str, int]
    error: Exception | None
    load: DetectorLoad | None = None  # of the computer, where it ran long enough to say


def open_detector(settings: DetectorSettings) -> SliceDetector | None:
    """The detector, and a run through it on noise with another of its kind, so that everything is compiled and loaded.

    Until a first probability comes: the network is not run before, and loads a library of linear algebra when it is.
    """
    if settings.model is None:
        return None
    first, detector = (settings.model.open(settings.sensor) for _ in range(2))
    rng = np.random.default_rng(0)
    for k in range(MOST_WARM_UP_SLICES):
        probability = first.step(noise(rng, k))
        _ = first.signal
        if k >= WARM_UP_SLICES and not math.isnan(probability):
            break
    return detector


def noise(rng: np.random.Generator, slice_: int) -> Events:
    """A slice of events at random places."""
    t = np.sort(rng.integers(0, SLICE_US, WARM_UP_EVENTS)) + slice_ * SLICE_US
    x, y = (rng.integers(0, size, WARM_UP_EVENTS).astype(np.uint16) for size in FRAME_PX)
    p: NDArray[np.uint8] = rng.integers(0, 2, WARM_UP_EVENTS).astype(np.uint8)
    return Events(t.astype(np.int64), x, y, p)


def run_detector(
    settings: DetectorSettings,
    status: SharedStatus,
    world: "VirtualWorld | None",
    orders: Connection,
    pipe: Connection,
    alive: Connection,
) -> None:
    """The detector's process: load, wait for an order, open the camera, detect until stopped; publish from an order on.

    orders: any message is the next order; pipe: to the recorder; alive: never written to, it closes when this process
    ends, however it ends.
    """
    ignore_interrupts()  # Ctrl-C is for the recorder, which then stops this
    ending = remember_signals()
    outbox = MessageWriter(pipe)
    camera = meter = None
    error: Exception | None = None
    try:
        detector = open_detector(settings)
        sys.setswitchinterval(SWITCH_S)
        outbox.put("ready")
        outbox.flush(FLUSH_S)
        while not take_order(orders, ORDER_S):
            _raise_if_ended(ending)
        gc.collect()  # which takes long, and once the camera runs its slices wait
        scheduling = set_niceness(NICE)  # before the camera's thread, which inherits it
        camera, setup, _ = settings.camera.open(CameraSettings(flush_us=FLUSH_US), world, settings.seeds)
        outbox.put(CameraReady(camera.sensor, setup, camera.notes, scheduling))
        gc.freeze()
        gc.disable()  # the loop makes no cycles
        outbox.flush(FLUSH_S)
        meter = LoadMeter()
        may_move, finger = (lambda: take_order(orders)), settings.finger
        detect(camera, detector, status, outbox, settings.slices, ending, may_move, meter, finger)
    except PeerGone:  # whoever started this
        return
    except EvetacError as failed:
        error = failed
    except BaseException as failed:  # raised by the process that started this
        error = DeviceError(f"the detector failed: {error_words(failed)}")
    finally:
        if camera is not None:
            with contextlib.suppress(DeviceError):  # it may have failed already
                camera.close()
    counted = dict(camera.counted) if camera is not None else {}
    outbox.put(DetectorEnded(counted, error, meter.load() if meter is not None else None), always=True)
    with contextlib.suppress(PeerGone):
        outbox.flush(LAST_FLUSH_S)
    alive.close()


def _raise_if_ended(ending: Sequence[int]) -> None:
    if ending:
        raise DeviceError(f"the detector was ended by {signal.Signals(ending[0]).name}")


def detect(
    camera: EventCamera,
    detector: SliceDetector | None,
    status: SharedStatus,
    outbox: MessageWriter,
    most: int,
    ending: Sequence[int] = (),
    may_move: Callable[[], bool] = lambda: True,
    meter: LoadMeter | None = None,
    finger: int = 0,
) -> None:
    """Evaluate and hand over slice after slice, until there are `most`, or an order to stop.

    Nothing is published before `may_move`: from the first status on, the gripper moves. Slices are evaluated before,
    because those that wait in the meantime would have to be caught up with, while the gripper moves by old ones.
    meter: gets to know how many slices and events there were. DeviceError where the stream ends before, the recorder
    cannot keep up, or a signal came (`ending`).
    """
    slip_us: deque[float] = deque(maxlen=REMEMBERED)
    parent = os.getppid()
    clock = camera.time
    events_us = clock.now_s() * 1e6  # when the camera last gave an event
    slips = slices = 0
    moves = False
    slices_held: list[Events] = []
    batch = SliceBatch()
    while slices < most and not status.stopping:
        _raise_if_ended(ending)
        events = camera.read()
        if events is None:
            raise DeviceError("the camera's stream ended", expected=f"{most} slices", found=f"{slices}")
        slices += 1
        if detector is not None and (told := status.gripper) is not None:
            detector.tell_gripper(*told)
        probability = float("nan") if detector is None else detector.step(events)
        signal = SlipSignal() if detector is None else detector.signal
        now_us = clock.now_s() * 1e6
        if events.size:
            events_us = now_us
        zero_us = camera.host_us(0.0)
        if math.isnan(zero_us):
            zero_us = now_us - slices * SLICE_US
        if signal.slips > slips:
            slips = signal.slips
            slip_us.append(zero_us + (float(events.t[0]) if events.size else (slices - 1) * SLICE_US))
        moves = moves or may_move()
        if moves:
            status.publish(DetectorStatus(signal, slices, now_us, events_us, zero_us, tuple(slip_us)), finger)
        slices_held.append(events)
        batch.counts.append(events.size)
        batch.probability.append(probability)
        batch.at_us.append(now_us)
        batch.late_us.append(now_us - zero_us - slices * SLICE_US)
        if len(slices_held) >= BATCH_MS:
            if slices % COUNTED_SLICES < BATCH_MS:
                batch.counted = dict(camera.counted)
            if meter is not None:
                meter.add(len(batch.counts), sum(batch.counts))
            _hand_over(outbox, batch, slices_held)
            slices_held, batch = [], SliceBatch()
            if os.getppid() != parent:
                return
    _hand_over(outbox, batch, slices_held)


def _hand_over(outbox: MessageWriter, batch: SliceBatch, slices: list[Events]) -> None:
    """Send a batch to the recorder; DeviceError if too much waits for it already."""
    batch.columns = joined(slices)
    if not outbox.put(batch):
        waiting = f"{outbox.waiting_bytes / 1e6:.0f} MB wait to be written"
        raise DeviceError("the recorder cannot keep up", found=waiting, hint=OVERLOADED)
    outbox.send()
