"""The detector's process of a grasp in real time: a slice in, a sign on the board out, 1000 times a second.

Everything that takes long is done before the camera runs: loading, compiling, a first run through. What is recorded
goes to the recorder in pieces of a few slices, without waiting for it.
"""

import contextlib
import gc
import os
import sys
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.devices.naming import CameraName, CameraSettings, Opened, open_camera
from evetac_cli.errors import DeviceError, EvetacError
from evetac_cli.events import FRAME_PX, SLICE_US, Events, concatenate
from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.realtime.message_pipe import MessageWriter
from evetac_cli.realtime.processes import ignore_interrupts, set_realtime_priority
from evetac_cli.realtime.shared_status import REMEMBERED, DetectorStatus, SharedStatus
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource
from evetac_cli.stages.grasp.loop import Sense

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.world import VirtualWorld

RANK = 20  # of urgency: behind the controller, whose steps are short
PIECE_MS = 50  # slices that the recorder gets at once
FLUSH_US = 250  # a quiet camera's words are sent this often: a slice is felt the sooner
WARMING = 30  # slices of noise that are felt before the camera runs
WARMING_EVENTS = 3000
FLUSH_S = 5.0
SWITCH_S = 2e-4  # the threads that read and decode take turns so often


@dataclass(frozen=True)
class Feeling:
    """What the detector is made of; may be sent to another process."""

    camera: CameraName
    seeds: np.random.SeedSequence
    sensor: Mapping[str, Any]  # with the dot grid
    model: Path | None  # None: slices are recorded, and nothing is felt
    tracker: str
    slices: int  # after which the grasp is over


class Seen(NamedTuple):
    """The camera, once it runs."""

    sensor: Mapping[str, Any]
    setup: Mapping[str, Any]
    notes: tuple[str, ...]
    scheduling: str


@dataclass
class Piece:
    """Some slices, for the recorder."""

    events: Events
    counts: list[int] = field(default_factory=list)
    probability: list[float] = field(default_factory=list)
    at_us: list[float] = field(default_factory=list)  # when it was felt
    late_us: list[float] = field(default_factory=list)  # from the end of a slice until it was felt, where known


class FeelingEnded(NamedTuple):
    """Why there are no more slices; `error` where that was not meant."""

    counted: Mapping[str, int]
    error: Exception | None


def open_detector(feeling: Feeling) -> Sense | None:
    """The detector, and one run through it on noise with another of its kind, so that everything is compiled."""
    if feeling.model is None:
        return None
    from evetac_cli.stages.grasp.setup import open_detector as load
    from evetac_cli.store.files import StageFile

    with StageFile(feeling.model, "model") as model:
        first, sense = (load(model, feeling.sensor, feeling.tracker) for _ in range(2))
    rng = np.random.default_rng(0)
    for k in range(WARMING):
        first.step(noise(rng, k))
        _ = first.felt
    return sense


def noise(rng: np.random.Generator, slice_: int) -> Events:
    """A slice of events anywhere."""
    t = np.sort(rng.integers(0, SLICE_US, WARMING_EVENTS)) + slice_ * SLICE_US
    x, y = (rng.integers(0, size, WARMING_EVENTS).astype(np.uint16) for size in FRAME_PX)
    p: NDArray[np.uint8] = rng.integers(0, 2, WARMING_EVENTS).astype(np.uint8)
    return Events(t.astype(np.int64), x, y, p)


def live(
    feeling: Feeling,
    board: SharedStatus,
    world: "VirtualWorld | None",
    orders: Connection,
    pipe: Connection,
    alive: Connection,
) -> None:
    """Be the detector's process: load, say `ready`, wait for word, open the camera, wait for word, feel until stopped.

    alive: held, and never written to: it closes when this process ends, however it ends.
    """
    ignore_interrupts()  # Ctrl-C is for the recorder, which then stops this
    outbox = MessageWriter(pipe)
    camera = None
    error: Exception | None = None
    try:
        sense = open_detector(feeling)
        sys.setswitchinterval(SWITCH_S)
        outbox.put("ready")
        outbox.flush(FLUSH_S)
        orders.recv()
        scheduling = set_realtime_priority(RANK)  # before the camera's thread, which inherits it
        settings = CameraSettings(flush_us=FLUSH_US)
        camera, setup, _ = open_camera(feeling.camera, settings, world, feeling.seeds)
        outbox.put(Seen(camera.sensor, setup, getattr(camera, "notes", ()), scheduling))
        gc.collect()
        gc.freeze()
        gc.disable()  # the loop makes no cycles
        outbox.flush(FLUSH_S)
        orders.recv()  # from the first slice that is felt on, the gripper moves
        feel(camera, sense, board, outbox, feeling.slices)
    except (EOFError, BrokenPipeError):  # whoever started this is gone
        return
    except EvetacError as failed:
        error = failed
    except Exception as failed:  # told by the process that started this
        error = DeviceError(f"the detector failed: {type(failed).__name__}: {failed}")
    finally:
        if camera is not None:
            with contextlib.suppress(DeviceError):  # it may have failed already
                camera.close()
    outbox.put(FeelingEnded(dict(camera.counted) if camera is not None else {}, error))
    with contextlib.suppress(BrokenPipeError):
        outbox.flush(FLUSH_S)
    alive.close()


def feel(camera: Opened, sense: Sense | None, board: SharedStatus, outbox: MessageWriter, most: int) -> None:
    """Feel slice after slice, until there are no more, or enough, or the board says stop."""
    host_us = getattr(camera, "host_us", None)
    slip_us: deque[float] = deque(maxlen=REMEMBERED)
    parent = os.getppid()
    clock: TimeSource = getattr(camera, "time", HOST_TIME)
    heard_us = clock.now_s() * 1e6
    slips = slices = 0
    piece: list[Events] = []
    rows = Piece(concatenate([]))
    while slices < most and not board.stopping:
        events = camera.read()
        if events is None:
            raise DeviceError("the camera's stream ended", expected=f"{most} slices", found=f"{slices}")
        slices += 1
        probability = float("nan") if sense is None else sense.step(events)
        felt = SlipSignal() if sense is None else sense.felt
        now_us = clock.now_s() * 1e6
        if events.size:
            heard_us = now_us
        zero_us = now_us - slices * SLICE_US if host_us is None else host_us(0.0)
        if felt.slips > slips:
            slips = felt.slips
            slip_us.append(zero_us + (float(events.t[0]) if events.size else (slices - 1) * SLICE_US))
        board.publish(DetectorStatus(felt, slices, now_us, heard_us, zero_us, tuple(slip_us)))
        piece.append(events)
        rows.counts.append(events.size)
        rows.probability.append(probability)
        rows.at_us.append(now_us)
        rows.late_us.append(now_us - zero_us - slices * SLICE_US)
        if len(piece) >= PIECE_MS:
            _hand_over(outbox, rows, piece)
            piece, rows = [], Piece(concatenate([]))
            if os.getppid() != parent:
                return
    _hand_over(outbox, rows, piece)


def _hand_over(outbox: MessageWriter, rows: Piece, piece: list[Events]) -> None:
    rows.events = concatenate(piece)
    if not outbox.put(rows):
        waiting = f"{outbox.waiting_bytes / 1e6:.0f} MB wait to be written"
        raise DeviceError("the recorder cannot keep up", found=waiting)
    outbox.send()
