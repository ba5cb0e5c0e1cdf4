"""Another camera of the same trial, read by a thread of its own, so that no camera waits for the other."""

import threading
import time
from collections import deque

from evetac_cli.devices import EventCamera
from evetac_cli.events import Events


class SliceThread:
    """Reads slices as they come and keeps them, each with the host time (s) at which it came, until they are taken."""

    def __init__(self, camera: EventCamera) -> None:
        self._camera = camera
        self._slices: deque[tuple[Events, float]] = deque()
        self._running = True
        self._thread = threading.Thread(target=self._run, name="slices", daemon=True)
        self.error: Exception | None = None

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def take(self) -> list[tuple[Events, float]]:
        """What came since this was last asked, oldest first."""
        return [self._slices.popleft() for _ in range(len(self._slices))]

    def stop(self) -> None:
        """End after the slice that is awaited; the camera is not read after this returns."""
        self._running = False
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        try:
            while self._running and (events := self._camera.read()) is not None:
                self._slices.append((events, time.monotonic()))
        except Exception as error:  # told by the thread that records
            self.error = error
