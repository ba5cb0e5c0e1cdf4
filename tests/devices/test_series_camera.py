"""A camera that stays open: each of its parts is a camera of its own, whose time begins with it."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from evetac_cli.devices.cameras import CameraSettings, NamedCamera, OpenedCamera
from evetac_cli.devices.series_camera import SeriesCamera
from evetac_cli.errors import DeviceError
from evetac_cli.events import SLICE_US, Events
from tests.devices.stand_ins import StillCamera
from tests.devices.stepped import StepClock

SEEDS = np.random.SeedSequence(0)


class Numbered(StillCamera):
    """A camera with one event a slice, at the column of its number, which is ever so many slices behind."""

    time = StepClock()  # none passes while a busy machine computes

    def __init__(self, fails_at: int = 10**9) -> None:
        self.sensor = {"sensor/frame_px": np.array([640, 480], np.int32)}
        self.notes = ("by USB 2",)
        self.fails_at = fails_at
        self.behind = 0  # slices that wait
        self.is_closed = False

    @property
    def counted(self) -> dict[str, int]:  # type: ignore[override]
        return {"events_lost": 2 * self.slices}

    def read(self) -> Events | None:
        if self.slices >= self.fails_at:
            raise DeviceError("is no longer on the bus")
        self.slices += 1
        self.behind = max(0, self.behind - 1)
        number = np.array([self.slices - 1])
        return Events(number * SLICE_US + 7, number.astype(np.uint16), np.zeros(1, np.uint16), np.ones(1, np.uint8))

    def host_us(self, device_us: float) -> float:
        """Slices that wait ended before now, by half a slice and more."""
        return self.time.now_s() * 1e6 + device_us - (self.slices + self.behind + 0.5) * SLICE_US

    def close(self) -> None:
        self.is_closed = True


@dataclass(frozen=True)
class Named(NamedCamera):
    """Opens the cameras of a list, one after the other."""

    name = "numbered"
    cameras: list[Numbered] = field(default_factory=list)

    def open(self, settings: CameraSettings, world: Any, seeds: Any) -> OpenedCamera:
        return OpenedCamera(self.cameras.pop(0), {"name": self.name})


def kept(*cameras: Numbered) -> SeriesCamera:
    return SeriesCamera(Named(list(cameras)), CameraSettings())


def opened(camera: SeriesCamera) -> Any:
    return camera.open(camera.settings, None, SEEDS).camera


def test_a_part_begins_at_zero_with_the_slice_of_its_moment() -> None:
    """Assert that slices that waited, and those between two parts, are thrown away, and times begin anew."""
    camera = Numbered()
    named = kept(camera)
    first = opened(named)
    assert [(int(each.t[0]), int(each.x[0])) for each in (first.read(), first.read())] == [(7, 0), (1007, 1)]
    first.close()
    named.skip()
    named.skip()
    camera.behind = 5
    second = opened(named)
    assert [(int(each.t[0]), int(each.x[0])) for each in (second.read(), second.read())] == [(7, 9), (1007, 10)]
    assert int(second.sensor["t_offset"]) == 9 * SLICE_US
    assert second.now_us() == 2 * SLICE_US
    assert second.host_us(0.0) == camera.host_us(9 * SLICE_US)
    assert second.counted == {"events_lost": 4}
    assert (first.notes, second.notes) == (("by USB 2",), ())
    assert first.read() is None
    assert not camera.is_closed


def test_a_camera_that_fails_between_two_parts_is_opened_anew() -> None:
    """Assert that its failure is raised once, that it is closed, and that the next part is of another one."""
    broken, whole = Numbered(fails_at=2), Numbered()
    named = kept(broken, whole)
    opened(named)
    named.skip()
    named.skip()
    with pytest.raises(DeviceError, match="no longer on the bus"):
        named.skip()
    assert broken.is_closed
    assert not named.is_open
    named.skip()
    assert int(opened(named).read().x[0]) == 0
    named.close()
    assert whole.is_closed


def test_a_camera_that_fails_in_a_part_is_opened_anew() -> None:
    """Assert that the next part is of another camera, whether or not somebody looked meanwhile."""
    broken, whole = Numbered(fails_at=1), Numbered()
    named = kept(broken, whole)
    part = opened(named)
    part.read()
    with pytest.raises(DeviceError, match="no longer on the bus"):
        part.read()
    assert int(opened(named).read().x[0]) == 0
    assert broken.is_closed
