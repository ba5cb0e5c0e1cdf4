"""The detector's process of a grasp in real time: slices in, status in shared memory out, 1000 times per second.

Everything slow is done before the camera runs: loading, compiling, and a first run on noise. Slices go to the recorder
in batches, without waiting for it.
"""

import contextlib
import gc
import math
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.devices import EventCamera
from evetac_cli.devices.cameras import CameraSettings, NamedCamera
from evetac_cli.devices.plugin_devices import open_camera
from evetac_cli.errors import DeviceError, EvetacError
from evetac_cli.events import FRAME_PX, SLICE_US, Events, empty
from evetac_cli.interrupts import ignore_interrupts, remember_signals
from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.realtime.message_pipe import FLUSH_S, LAST_FLUSH_S, ORDER_S, MessageWriter, PeerGone, take_order
from evetac_cli.realtime.processes import NICE, error_words, raise_if_ended, set_niceness
from evetac_cli.realtime.shared_status import REMEMBERED, DetectorStatus, SharedStatus
from evetac_cli.trials.grasp.loop import SliceDetector
from evetac_cli.trials.grasp.settings import DetectorModel
from evetac_cli.trials.session import OVERLOADED

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.world import VirtualWorld

BATCH_MS = 5  # slices sent to the recorder at once: with 50, copying took a millisecond
COUNTED_SLICES = 100  # number of slices after which the recorder receives the camera's losses
FLUSH_US = 250  # a quiet camera's words are sent this often, so that a slice is evaluated sooner
WARM_UP_SLICES, MOST_WARM_UP_SLICES = 30, 2000  # fewest and most slices of noise before the camera runs
WARM_UP_EVENTS = 3000  # events per noise slice
WARM_SLICES = 100  # slices at the beginning, during which it catches up
FEWEST_SLICES = 1000  # whose CPU time says what a slice takes
SWITCH_S = 2e-4  # how often the reading and decoding threads take turns


@dataclass(frozen=True)
class DetectorSettings:
    """The settings of the detector's process, which are sent to it."""

    camera: NamedCamera
    seeds: np.random.SeedSequence
    sensor: Mapping[str, Any]  # datasets `sensor/...`, including the dot grid
    model: DetectorModel | None  # None: slices are recorded, but no slip is detected
    slices: int  # number of slices after which the grasp is over
    finger: int = 0  # 1: the second finger, whose camera does not determine the end: it runs until it is stopped


class CameraReady(NamedTuple):
    """The camera runs; its sensor, its settings, and the scheduling of its process."""

    sensor: Mapping[str, Any]
    setup: Mapping[str, Any]
    notes: tuple[str, ...]
    scheduling: str


@dataclass
class SliceBatch:
    """Consecutive slices for the recorder; the lists have one item per slice.

    The columns are sent as joined bytes, which takes a quarter of the time of arrays.
    """

    columns: tuple[bytes, ...] = ()  # columns of all events, as stored in memory
    counts: list[int] = field(default_factory=list)
    probability: list[float] = field(default_factory=list)
    at_us: list[float] = field(default_factory=list)  # when the slice was evaluated
    late_us: list[float] = field(default_factory=list)  # time from the end of a slice until its evaluation, if known
    counted: Mapping[str, int] | None = None  # losses of the camera so far, by reason; only now and then
    finger: int = 0

    def add(self, events: int, probability: float, at_us: float, late_us: float) -> None:
        """Add what is known of a slice, but for its events."""
        self.counts.append(events)
        self.probability.append(probability)
        self.at_us.append(at_us)
        self.late_us.append(late_us)

    @property
    def size(self) -> int:
        """The number of bytes that the events take."""
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
    """Return the joined columns of slices for a batch."""
    return tuple(b"".join(column) for column in zip(*slices, strict=True))


class DetectorEnded(NamedTuple):
    """The end of a detector: the camera's losses by reason, the error if any, and the share of a core that it used."""

    counted: Mapping[str, int]
    error: Exception | None
    core_share: float | None = None  # CPU time per second of the recording; None if it ran too briefly


class CoreMeter:
    """The share of a core that the detector's process uses, including its camera's driver."""

    def __init__(self) -> None:
        self._began_s = math.nan
        self._slices = -WARM_SLICES

    def add(self, slices: int) -> None:
        """Record that some slices were evaluated."""
        if self._slices < 0 <= self._slices + slices:
            self._began_s = time.process_time()
        self._slices += slices

    @property
    def share(self) -> float | None:
        """CPU time per second of the recording so far; None after too short a time."""
        if self._slices < FEWEST_SLICES:
            return None
        return (time.process_time() - self._began_s) / (1e-6 * SLICE_US * self._slices)


def open_detector(settings: DetectorSettings) -> SliceDetector | None:
    """Return the detector, after a run of an identical one on noise, so that everything is loaded and compiled.

    The run lasts until a first probability, because only then the network runs and loads a linear algebra library.
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
    """Return a slice of events at random positions."""
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
    """Run the detector's process: load, open the camera after an order, then detect until stopped.

    A status is published only after another order. orders: any message is the next order; pipe: to the recorder; alive:
    nothing is written to it, and it closes when this process ends in any way.
    """
    ignore_interrupts()  # Ctrl-C is for the recorder, which then stops this process
    ending = remember_signals()
    outbox = MessageWriter(pipe)
    camera = detection = None
    error: Exception | None = None
    try:
        detector = open_detector(settings)
        sys.setswitchinterval(SWITCH_S)
        outbox.put("ready")
        outbox.flush(FLUSH_S)
        while not take_order(orders, ORDER_S):
            raise_if_ended("the detector", ending)
        gc.collect()  # collect now, because it takes long and would delay slices once the camera runs
        scheduling = set_niceness(NICE)  # before the camera's thread starts, which inherits it
        camera, setup, _ = open_camera(settings.camera, CameraSettings(flush_us=FLUSH_US), world, settings.seeds)
        outbox.put(CameraReady(camera.sensor, setup, camera.notes, scheduling))
        gc.freeze()
        gc.disable()  # the loop creates no reference cycles
        outbox.flush(FLUSH_S)
        detection = DetectorLoop(
            *(camera, detector, status, outbox, settings.slices, settings.finger, ending),
            may_move=lambda: take_order(orders),
        )
        detection.run()
    except PeerGone:  # the process that started this has gone
        return
    except EvetacError as failed:
        error = failed
    except BaseException as failed:  # the process that started this raises it
        error = DeviceError(f"the detector failed: {error_words(failed)}")
    finally:
        if camera is not None:
            with contextlib.suppress(DeviceError):  # the camera may have failed already
                camera.close()
    counted = dict(camera.counted) if camera is not None else {}
    outbox.put(DetectorEnded(counted, error, None if detection is None else detection.meter.share), always=True)
    with contextlib.suppress(PeerGone):
        outbox.flush(LAST_FLUSH_S)
    alive.close()


@dataclass(eq=False)
class DetectorLoop:
    """The loop of the detector's process: evaluates slices and passes them to the recorder.

    most: slices after which it ends; ending: signals received by this process. may_move: whether the gripper may move.
    """

    camera: EventCamera
    detector: SliceDetector | None
    status: SharedStatus
    outbox: MessageWriter
    most: int
    finger: int = 0
    ending: Sequence[int] = ()
    may_move: Callable[[], bool] = lambda: True
    meter: CoreMeter = field(default_factory=CoreMeter, init=False)

    def run(self) -> None:
        """Evaluate slices until there are `most`, or an order to stop.

        Nothing is published before `may_move`, because the gripper moves as soon as there is a first status. Slices are
        evaluated before that anyway. Otherwise waiting slices would have to be caught up with, while the gripper moves
        by old ones. DeviceError if the stream ends too early, the recorder cannot keep up, or a signal was received.
        """
        slip_us: deque[float] = deque(maxlen=REMEMBERED)
        parent = os.getppid()
        events_us = self.camera.time.now_s() * 1e6  # when the camera last sent an event
        slips = slices = 0
        moves = False
        held: list[Events] = []
        batch = SliceBatch(finger=self.finger)
        while slices < self.most and not self.status.stopping:
            raise_if_ended("the detector", self.ending)
            events = self.camera.read()
            if events is None:
                raise DeviceError("the camera's stream ended", expected=f"{self.most} slices", found=f"{slices}")
            slices += 1
            probability, signal = self._evaluate(events)
            now_us = self.camera.time.now_s() * 1e6
            if events.size:
                events_us = now_us
            zero_us = self.camera.host_us(0.0)
            if math.isnan(zero_us):
                zero_us = now_us - slices * SLICE_US
            if signal.slips > slips:
                slips = signal.slips
                slip_us.append(zero_us + (float(events.t[0]) if events.size else (slices - 1) * SLICE_US))
            moves = moves or self.may_move()
            if moves:
                seen = DetectorStatus(signal, slices, now_us, events_us, zero_us, tuple(slip_us))
                self.status.publish(seen, self.finger)
            held.append(events)
            batch.add(events.size, probability, now_us, now_us - zero_us - slices * SLICE_US)
            if len(held) >= BATCH_MS:
                if slices % COUNTED_SLICES < BATCH_MS:
                    batch.counted = dict(self.camera.counted)
                self.meter.add(len(batch.counts))
                _hand_over(self.outbox, batch, held)
                held, batch = [], SliceBatch(finger=self.finger)
                if os.getppid() != parent:
                    return
        _hand_over(self.outbox, batch, held)

    def _evaluate(self, events: Events) -> tuple[float, SlipSignal]:
        """Return the probability of slip in a slice, and the signal; NaN and no slip without a detector."""
        if self.detector is None:
            return math.nan, SlipSignal()
        if (gripper_state := self.status.gripper) is not None:
            self.detector.tell_gripper(*gripper_state)
        return self.detector.step(events), self.detector.signal


def _hand_over(outbox: MessageWriter, batch: SliceBatch, slices: list[Events]) -> None:
    """Send a batch to the recorder; DeviceError if too much is waiting for it already."""
    batch.columns = joined(slices)
    if not outbox.put(batch):
        waiting = f"{outbox.waiting_bytes / 1e6:.0f} MB waiting to be written"
        raise DeviceError("the recorder cannot keep up", found=waiting, hint=OVERLOADED)
    outbox.send()
