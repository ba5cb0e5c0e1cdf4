"""A simulated world in its own process, in real time, behind a virtual camera and a virtual gripper.

The world makes one slice per millisecond, starting when the camera is started. Its events become event words, which the
virtual camera sends over its virtual USB. Its finger follows the registers of the virtual gripper through shared
memory. So the drivers see both devices as they would see hardware.

Device time is the world's time. A world that cannot keep up with the host's clock is late, never slow, and counts late
slices. When a camera answers that it has no words, no words from before the question may remain. So before it gives
that answer, a late world first catches up with the time of the question.

A world with two cameras, one at each finger, makes the words of both: `seen_by` returns the world as one of them sees
it. Its time pauses until both cameras have started.

A world that `waits` is never late. Its `time`, used by the camera's driver, the virtual servo and the control loops of
a grasp, pauses until the world has made the slices that are due and the driver's slices were read. A world waits
unless a real gripper moves with it. How well time is kept is measured with prepared words, which follow the host's
clock.
"""

import copy
import gc
import math
import multiprocessing
import os
import select
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

import numpy as np

from evetac_cli.devices import OF_SECOND, EventCamera
from evetac_cli.devices.virtual.servo_plant import Goals, ServoMotion, SharedPlant
from evetac_cli.errors import DeviceError, EvetacError
from evetac_cli.interrupts import ignore_interrupts
from evetac_cli.realtime.message_pipe import MessageReader, MessageWriter
from evetac_cli.realtime.processes import (
    ErrorText,
    exit_words,
    start_shielded,
    storing_error,
    wait_while_computing,
    with_reason,
)
from evetac_cli.realtime.shared_time import READER_S, SharedTime
from evetac_cli.sim.setup.plan import Plan

SLICE_S = 1e-3
LATE_S = 5e-3  # a slice is late if its words leave later than this after its end
BACKLOG_BYTES = 4 << 20  # limit of unfetched words; further slices are dropped and counted
FIRST_MS = 1  # device time of the first slice: a camera clock of 0 would look as if it had wrapped
PAPER_P_GAIN = 50  # the servo's gain at which the simulated drive was fitted
WORD_BYTES = 4
END_S = 2.0
WARMING = 2500  # slices of a warm-up world that compiles all code: after 2 s a grasp reaches the lift
WARMING_TICKS = 3  # how far the goal is ahead of the finger during warm-up: it closes
TRUTH_SLICES = 50  # number of slices whose ground truth is sent together
CATCH_UP_S = 10.0  # a world that is later than this is not waited for any longer in this call
STANDING_S = 5e-4  # how often a waiting world checks whether its time may continue
# counters shared with the process; began: host time of world time 0, or 0 while it is paused
_LATE, _DROPPED, _MADE, _BEGAN_NS = range(4)


class VirtualWorld:
    """The world's side of a virtual camera (`run`, `take`) and of a virtual gripper (`plant`).

    It may be passed to a process that is being spawned. The copy there is an equal source of words, but only the
    process that built the world ends it. If requested, `truths` returns the ground truth of slices, one row of every
    array per slice, and None after the last.
    """

    def __init__(
        self,
        plan: Plan,
        seeds: np.random.SeedSequence,
        *,
        sends_truth: bool = False,
        waits: bool = True,
        **durations: float,
    ) -> None:
        """Build the world of a plan, as devices.simulated.rig does; its time is paused until `run`.

        waits: whether `time` waits for a late world or reader.
        """
        context = multiprocessing.get_context("spawn")
        self.plant = SharedPlant()
        self.time: SharedTime = self.plant.time
        self._finger = 0
        self._asked_s = 0.0
        self._polling = False  # whether the last call had no time to wait and got words
        self._counters = context.Array("q", 4, lock=False)
        self._error_text = ErrorText()
        self._orders, orders = context.Pipe()
        pipes = [context.Pipe(duplex=False) for _ in range(1 if plan.second is None else 2)]
        self._all_words, words = [ours for ours, _ in pipes], [theirs for _, theirs in pipes]
        truths, truth_pipe = context.Pipe(duplex=False) if sends_truth else (None, None)
        self.truths = None if truths is None else MessageReader(truths)
        self._process: BaseProcess | None = context.Process(
            target=storing_error,
            args=(
                *(self._error_text, _run_world, orders, self.plant, words, truth_pipe, self._counters),
                *(waits, plan, seeds, durations),
            ),
            name="evetac-world",
            daemon=True,
        )
        try:
            start_shielded(self._process)
            orders.close()
            for pipe in words:
                pipe.close()
            if truth_pipe is not None:
                truth_pipe.close()
            self._wait_until_built(self._process)
        except BaseException:
            self.close()
            raise

    def _wait_until_built(self, process: BaseProcess) -> None:
        """Wait until the process has built the world; DeviceError if it does not start."""
        wait_while_computing(self._orders, process, "the virtual world did not start")
        try:
            reply = self._orders.recv()
        except EOFError:
            raise self.died("while it started") from None
        if isinstance(reply, EvetacError):
            raise reply
        if isinstance(reply, str):
            raise DeviceError(f"the virtual world could not be built: {reply}")
        self.sensors: tuple[Mapping[str, Any], ...] = reply["sensors"]
        self.sensor: Mapping[str, Any] = self.sensors[0]
        self.holding_ma: float = reply["holding_ma"]
        self.sampled: str = reply["sampled"]
        self.fall_factor: float = reply["fall_factor"]

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_process": None, "truths": None}

    @property
    def _words(self) -> Connection:
        return self._all_words[self._finger]

    def seen_by(self, finger: int) -> "VirtualWorld":
        """Return a source of the words of a finger's camera: a copy for the process that reads them."""
        seen = copy.copy(self)
        vars(seen).update(_finger=finger, time=self.time.of_reader(finger), _process=None, truths=None)
        return seen

    @property
    def pid(self) -> int | None:
        """The process id of the world; None once it has ended."""
        return None if self._process is None else self._process.pid

    @property
    def counted(self) -> Mapping[str, int]:
        """Numbers of slices that left later than 5 ms after their end, and of slices whose words were not fetched."""
        return {"slices_late": self._counters[_LATE], "slices_dropped": self._counters[_DROPPED]}

    def run(self, on: bool) -> None:
        """Let the world's time pass (True) or stop it; DeviceError if its process has died."""
        try:
            self._orders.send((self._finger, on))
        except OSError:
            raise self.died() from None

    def died(self, when: str = "") -> DeviceError:
        """Return the error for a world whose process has gone; a copy in another process has at most its error."""
        words, process = self._error_text, self._process
        how = words.read() if process is None else exit_words(process, words)
        return DeviceError(with_reason(f"the process of the virtual world died {when}".rstrip(), how))

    @property
    def has_died(self) -> bool:
        """Whether its process ended before it was closed; a copy in another process cannot know, and returns False."""
        return self._process is not None and self._process.pid is not None and self._process.exitcode is not None

    def take(self, most: int, timeout_s: float) -> bytes:
        """Return event words, little-endian, as they arrive; b"" if none arrived in time.

        An empty result also means that no words from before the call are due. Repeated calls with no time to wait,
        until no words are left, count as one call made at the time of the first.
        """
        if timeout_s > 0 or not self._polling:
            self._asked_s = self.time.now_s()
        give_up_s = time.monotonic() + CATCH_UP_S
        polls = timeout_s == 0
        behind = True
        while behind:
            behind = self._is_behind(self._asked_s) and time.monotonic() < give_up_s
            if select.select([self._words], [], [], timeout_s)[0]:
                data = os.read(self._words.fileno(), most)
                if not data:
                    raise self.died()
                self._polling = polls
                return data
            timeout_s = SLICE_S
        self._polling = False
        return b""

    def _is_behind(self, now_s: float) -> bool:
        """Return whether a slice that ended before this time has not been sent yet."""
        began_ns = self._counters[_BEGAN_NS]
        return bool(began_ns and (self._counters[_MADE] + 1) * SLICE_S < now_s - began_ns * 1e-9)

    def close(self) -> None:
        """End the world; a second call does nothing."""
        self._orders.close()
        if self._process is not None and self._process.pid is not None:
            self._process.join(END_S)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()
            self.time.limit(math.inf)
        for pipe in self._all_words:
            pipe.close()
        self.plant.close()


def _run_world(orders: Connection, plant: SharedPlant, *made_of: Any) -> None:
    """Run the world's process: build, report that, then obey orders until the other side has gone."""
    ignore_interrupts()  # Ctrl-C is for the recorder, which then ends this process
    running_world, reply = _build(plant, *made_of)
    try:
        orders.send(reply)
    except OSError:  # the recorder did not wait
        plant.remove()
        return
    if running_world is None:
        return
    gc.freeze()
    while True:
        readable, _, _ = select.select([orders], running_world.waiting_for, [], running_world.wait_s)
        try:
            if readable:
                running_world.run(*orders.recv())
            running_world.tick()
        except (EOFError, BrokenPipeError, ConnectionResetError):  # the recorder has gone, perhaps killed
            plant.remove()
            return


def _build(*made_of: Any) -> tuple["_RunningWorld | None", Any]:
    """Return the world, and the reply to the other process: its description, or why it cannot be built."""
    try:
        running_world = _RunningWorld(*made_of)
    except EvetacError as error:
        return None, error
    except Exception as error:  # the other process raises it
        return None, f"{type(error).__name__}: {error}"
    return running_world, running_world.described()


class _RunningWorld:
    """A world that makes its slices when they are due."""

    def __init__(
        self,
        plant: SharedPlant,
        words: Sequence[Connection],
        truths: Connection | None,
        counters: Any,
        waits: bool,
        plan: Plan,
        seeds: np.random.SeedSequence,
        durations: dict[str, float],
    ) -> None:
        from evetac_cli.devices.dvxplorer.event_words import encode, timestamp
        from evetac_cli.devices.simulated import SimulatedGripper, rig

        self._waits = waits
        first = rig(plan, np.random.SeedSequence(0), **durations)
        for _ in range(WARMING):  # loads or compiles everything before time is critical
            events = first.camera.read()
            if events is None:
                break
            encode(events, FIRST_MS)
            if first.second is not None:
                first.second.camera.read()
                first.second.truth()
            timestamp(FIRST_MS)
            if isinstance(first.gripper, SimulatedGripper) and plan.scene.kind == "lift":
                first.gripper.write_position(first.gripper.read().position_ticks + WARMING_TICKS)
        self._encode = encode
        self._timestamp = timestamp
        self._rig = rig(plan, seeds, **durations)
        if not isinstance(self._rig.gripper, SimulatedGripper):
            raise DeviceError("a virtual gripper needs a scene with a gripper", found=plan.scene.name)
        self._world = self._rig.gripper.simulation
        self._gain_ma_tick = self._world.finger.drive.gain_ma_tick / PAPER_P_GAIN
        self._plant = plant
        self._time = plant.time
        self._words = list(words)
        for pipe in words:
            os.set_blocking(pipe.fileno(), False)
        self._counters = counters
        self._truths = None if truths is None else MessageWriter(truths)
        self._pending: list[Mapping[str, Any]] = []  # ground truth that was not sent yet
        self._backlogs = [b""] * len(words)
        self._on = [False] * len(words)  # which cameras are started
        self._running = False
        self._stands_s = math.inf  # time since which a camera waits for the other to start: it must close no slices yet
        self._began_s = 0.0  # time at which the world's time was 0
        self._torque = False  # whether the servo ever had torque: until then the scene's own command applies
        self._goals = Goals()
        self._publish_motion(self._world.finger.state.motor_ticks)

    def described(self) -> dict[str, Any]:
        """Return the description of this world for the other side."""
        return {
            "sensors": tuple(dict(camera.sensor) for camera in self._cameras),
            "holding_ma": self._rig.holding_ma,
            "sampled": self._rig.sampled,
            "fall_factor": self._rig.fall_factor,
        }

    @property
    def _cameras(self) -> list[EventCamera]:
        second = self._rig.second
        return [self._rig.camera] if second is None else [self._rig.camera, second.camera]

    def run(self, finger: int, on: bool) -> None:
        """Start or stop the camera of a finger. The world continues from its time once all cameras run."""
        self._on[finger] = on
        self._stands_s = math.inf
        if on and not all(self._on):
            self._stands_s = self._time.now_s()
            self._limit_time()
            return
        if on and not self._running:
            self._began_s = self._time.now_s() - self._world.slices * SLICE_S
        self._running = on
        self._limit_time()
        if not on:
            self._send_pending()
        self._counters[_BEGAN_NS] = int(self._began_s * 1e9) if on and not self._world.finished else 0

    @property
    def wait_s(self) -> float | None:
        """Time until the end of the next slice, in s; None for a world that is paused or over."""
        if not self._running or self._world.finished:
            return None
        left_s = self._began_s + (self._world.slices + 1) * SLICE_S - self._time.now_s()
        return max(left_s, STANDING_S) if self._waits and left_s > 0.0 else max(left_s, 0.0)

    @property
    def waiting_for(self) -> list[Connection | MessageWriter]:
        """The pipes for words and ground truth that have data waiting for room; for select."""
        pipes: list[Connection | MessageWriter] = [
            pipe for pipe, backlog in zip(self._words, self._backlogs, strict=True) if backlog
        ]
        if self._truths is not None and self._truths.waiting_bytes:
            pipes.append(self._truths)
        return pipes

    def tick(self) -> None:
        """Make one slice if it is due, and send waiting data."""
        if self.wait_s == 0.0:
            self._pass_on(self._plant.goals())
            before_ticks = self._world.finger.state.motor_ticks
            seen = [camera.read() for camera in self._cameras]
            self._publish_motion(before_ticks)
            # A sensor that is read out 5000 times per second starts every millisecond with a TIMESTAMP, with or without
            # events. Here it is sent once, at the end of the slice before, except for the very first.
            first = self._timestamp(FIRST_MS).tobytes() if self._world.slices == 1 else b""
            last = self._timestamp(FIRST_MS + self._world.slices).tobytes()
            for finger, events in enumerate(seen):
                words = b"" if events is None else self._encode(events, FIRST_MS).tobytes()[WORD_BYTES:]
                self._queue(finger, first + words + last)
            self._send_truth()
            if self._time.now_s() > self._began_s + self._world.slices * SLICE_S + LATE_S:
                self._counters[_LATE] += 1
        self._limit_time()
        for finger, pipe in enumerate(self._words):
            while backlog := self._backlogs[finger]:
                try:
                    self._backlogs[finger] = backlog[os.write(pipe.fileno(), backlog) :]
                except BlockingIOError:
                    break
        if self._truths is not None:
            self._truths.send()
        if self._world.finished:
            self._counters[_BEGAN_NS] = 0
        self._counters[_MADE] = self._world.slices

    def _limit_time(self) -> None:
        """Let time advance as far as this world and the reader of its slices have come."""
        if not self._waits:
            return
        until_s = self._stands_s
        if self._running and not self._world.finished:
            made_s = self._began_s + (self._world.slices + 1) * SLICE_S
            until_s = min(made_s + LATE_S, self._time.reader_s + READER_S)
        self._time.limit(until_s)

    def _send_truth(self) -> None:
        """Send the ground truth of the last slice, several slices at a time."""
        if self._truths is None or self._rig.truth is None:
            return
        row, second = self._rig.truth(), self._rig.second
        if second is not None:
            row = {**row, **{OF_SECOND + name: value for name, value in second.truth().items()}}
        self._pending.append(row)
        if len(self._pending) >= TRUTH_SLICES or self._world.finished:
            self._send_pending()
        if self._world.finished:
            self._truths.put(None)

    def _send_pending(self) -> None:
        if self._truths is not None and self._pending:
            self._truths.put({name: np.asarray([row[name] for row in self._pending]) for name in self._pending[0]})
            self._pending = []

    def _queue(self, finger: int, data: bytes) -> None:
        if len(self._backlogs[finger]) + len(data) > BACKLOG_BYTES:
            self._counters[_DROPPED] += 1
        else:
            self._backlogs[finger] += data

    def _pass_on(self, goals: Goals) -> None:
        """Pass the servo's registers on to the world's gripper."""
        if goals != self._goals:
            self._goals = goals
            self._torque |= goals.torque
            gain = self._gain_ma_tick * goals.p_gain
            finger = self._world.finger
            finger.drive = replace(finger.drive, gain_ma_tick=gain, current_limit_ma=goals.limit_ma)
        if self._torque:
            self._world.finger.command = goals.command()

    def _publish_motion(self, before_ticks: float) -> None:
        """Publish the finger's motion for the servo: current, position, and speed over the last slice."""
        finger = self._world.finger.state
        speed = (finger.motor_ticks - before_ticks) / SLICE_S
        self._plant.show(ServoMotion(finger.current_ma, finger.position_ticks, speed))
