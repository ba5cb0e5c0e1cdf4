"""Event frames of an evetac camera, drawn in a thread as slices arrive. Independent of LeRobot."""

import time
from collections import deque
from threading import Condition, Thread
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli import EventImager
from evetac_cli.devices import EventCamera
from evetac_cli.formats.write.lerobot.event_stacks import EventStacks, full_scale

WAITING_S = 10.0  # the longest queue of frames that were not read yet, in s


class EventFrame(NamedTuple):
    """A frame as grey levels (height, width), its number from 0, and the host time when it was drawn."""

    grey: NDArray[np.uint8]
    number: int
    drawn_s: float


class EventFrames:
    """The frames of an open camera, which `close` closes.

    rate_hz: frames per second. size_px: width and height of a frame. shown: number of frames in a picture. frames_lost:
    number of frames dropped because WAITING_S of frames were already waiting.
    """

    def __init__(
        self, camera: EventCamera, frame_px: tuple[int, int], size_px: tuple[int, int], rate_hz: float, shown: int = 1
    ) -> None:
        self.frames_lost = 0
        self._camera = camera
        self._stacks = EventStacks(shown, rate_hz, size_px, full_scale(frame_px, size_px))
        self._imager = EventImager("frames", frame_px, size_px=size_px, rate_hz=rate_hz, polarity="signed")
        blank = self._stacks.grey(np.zeros(size_px[::-1], np.int16))
        self._shown = deque([EventFrame(blank, -1, -np.inf)] * shown, maxlen=shown)
        self._waiting: deque[EventFrame] = deque()
        self._most = max(1, round(WAITING_S * rate_hz))
        self._ended: BaseException | None = None
        self._changed = Condition()
        self._is_open = True
        self._thread = Thread(target=self._run, name="event frames", daemon=True)
        self._thread.start()

    @property
    def camera(self) -> EventCamera:
        """The camera, which counts its own losses."""
        return self._camera

    def next(self, timeout_s: float) -> EventFrame:
        """Return the oldest frame not yet taken; raise TimeoutError, or an exception of the camera."""
        with self._changed:
            self._wait(timeout_s)
            return self._waiting.popleft()

    def newest(self, timeout_s: float) -> NDArray[np.uint8]:
        """Return a picture up to the newest frame, waiting for a new one; older frames are dropped."""
        with self._changed:
            self._wait(timeout_s)
            self._waiting.clear()
            return self._picture()

    def latest(self) -> tuple[NDArray[np.uint8], float]:
        """Return a picture up to the newest frame and that frame's age in s; RuntimeError before the first frame."""
        with self._changed:
            if self._ended is not None:
                raise self._ended
            if self._shown[-1].number < 0:
                raise RuntimeError("the camera has not delivered an event frame yet")
            return self._picture(), time.monotonic() - self._shown[-1].drawn_s

    def close(self) -> None:
        """End the thread and close the camera; a second call does nothing."""
        with self._changed:
            self._is_open = False
            self._changed.notify_all()
        self._camera.close()
        self._thread.join()

    def _wait(self, timeout_s: float) -> None:
        if self._changed.wait_for(lambda: self._waiting or self._ended is not None, timeout_s):
            if self._waiting:
                return
            assert self._ended is not None
            raise self._ended
        raise TimeoutError(f"no event frame within {1e3 * timeout_s:.0f} ms")

    def _picture(self) -> NDArray[np.uint8]:
        """Return the shown frames as one picture, the oldest at the top left."""
        side = round(len(self._shown) ** 0.5)
        greys = [frame.grey for frame in self._shown]
        return np.vstack([np.hstack(greys[row * side : (row + 1) * side]) for row in range(side)])

    def _run(self) -> None:
        number = 0
        try:
            while (events := self._camera.read()) is not None and self._is_open:
                image = self._imager.step(events)
                if image is None:
                    continue
                frame = EventFrame(self._stacks.grey(image[0]), number, time.monotonic())
                number += 1
                with self._changed:
                    if len(self._waiting) == self._most:
                        self._waiting.popleft()
                        self.frames_lost += 1
                    self._waiting.append(frame)
                    self._shown.append(frame)
                    self._changed.notify_all()
            ended: BaseException = EOFError("the camera's stream has ended")
        except Exception as error:  # raised again when the next frame is requested
            ended = error
        with self._changed:
            self._ended = ended
            self._changed.notify_all()
