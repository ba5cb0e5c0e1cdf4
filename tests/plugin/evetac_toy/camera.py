"""A camera: a bright stripe that moves to the right by a column a millisecond."""

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
    """The open camera: each slice has an event in every row of the stripe's column."""

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
        """The next slice, not before its time; None once the camera is closed."""
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
        """The end of the slice read last."""
        return self.slices * SLICE_US

    def host_us(self, device_us: float) -> float:
        """The host's time at a time of the recording; lateness is measured by it."""
        return self.began_s * 1e6 + device_us if self.open else math.nan

    def close(self) -> None:
        """Stop."""
        self.open = False


@dataclass(frozen=True)
class Stripe(NamedCamera):
    """`stripe[:ROWS]`: as it is named on the command line."""

    name = "stripe"
    rows: int = 100

    @classmethod
    def parse(cls, text: str) -> Self:
        """Understand what stands behind the colon."""
        if not text:
            return cls()
        if not (text.isascii() and text.isdigit() and 1 <= int(text) <= HEIGHT):
            raise InputError("no such stripe", where="--camera stripe:ROWS", expected=f"1 to {HEIGHT}", found=text)
        return cls(int(text))

    def __str__(self) -> str:
        return f"{self.name}:{self.rows}"

    @property
    def capabilities(self) -> frozenset[Capability]:
        """It plays in real time, and what it shows is no touch."""
        return frozenset({Capability.DEVICE, Capability.SIMULATED})

    def open(self, settings: CameraSettings, world: Any, seeds: np.random.SeedSequence) -> OpenedCamera:
        """Start the camera, and say what a header is to know of it."""
        return OpenedCamera(StripeCamera(self.rows), {"name": self.name, "rows": self.rows})
