"""A camera that shows a bright stripe, which moves right by one column per millisecond."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from evetac_cli.devices.cameras import CameraSettings, NamedCamera, OpenedCamera
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.names import Capability
from evetac_cli.realtime.shared_time import HOST_TIME

WIDTH, HEIGHT = 640, 480


class StripeCamera:
    """An open camera: each slice has one event in every row of the stripe's column."""

    sensor: Mapping[str, Any] = {
        "sensor/frame_px": np.array([WIDTH, HEIGHT], np.int32),
        "sensor/name": "stripe",
    }
    counted: Mapping[str, int] = {}
    notes: tuple[str, ...] = ()
    time = HOST_TIME

    def __init__(self, rows: int) -> None:
        self.rows = rows
        self.slices = 0
        self.open = True
        self.began_s = time.monotonic()

    def read(self) -> Events | None:
        """Return the next slice once its time is over; None after the camera is closed."""
        if not self.open:
            return None
        start_us = self.now_us()
        self.slices += 1
        time.sleep(max(0.0, self.began_s + self.slices * 1e-3 - time.monotonic()))
        return Events(
            t=start_us + np.sort(np.arange(self.rows, dtype=np.int64) % SLICE_US),
            x=np.full(self.rows, self.slices % WIDTH, np.uint16),
            y=np.arange(self.rows, dtype=np.uint16),
            p=np.ones(self.rows, np.uint8),
        )

    def now_us(self) -> int:
        """Return the end time of the slice that was read last, in us of the recording."""
        return self.slices * SLICE_US

    def host_us(self, device_us: float) -> float:
        """Convert a time of the recording to host time, in us; lateness is measured with it."""
        return self.began_s * 1e6 + device_us if self.open else math.nan

    def close(self) -> None:
        """Stop the camera."""
        self.open = False


@dataclass(frozen=True)
class Stripe(NamedCamera):
    """The camera as named on the command line: `stripe[:ROWS]`."""

    name = "stripe"
    rows: int = 100

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse the text after the colon."""
        if not text:
            return cls()
        if not (text.isascii() and text.isdigit() and 1 <= int(text) <= HEIGHT):
            raise InputError("no such stripe", where="--camera stripe:ROWS", expected=f"1 to {HEIGHT}", found=text)
        return cls(int(text))

    def __str__(self) -> str:
        return f"{self.name}:{self.rows}"

    @property
    def capabilities(self) -> frozenset[Capability]:
        """It runs in real time (DEVICE), and its events are not from a real sensor (SIMULATED)."""
        return frozenset({Capability.DEVICE, Capability.SIMULATED})

    def open(self, settings: CameraSettings, world: Any, seeds: np.random.SeedSequence) -> OpenedCamera:
        """Start the camera, and return it with the entries for the recording's header."""
        return OpenedCamera(StripeCamera(self.rows), {"name": self.name, "rows": self.rows})
