"""The second camera backend, against a stand-in for the maker's library; with the library itself, as far as it goes."""

from collections import deque
from contextlib import closing
from datetime import timedelta
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evetac_cli.devices import EventCamera, dv
from evetac_cli.devices.dv import DvCamera
from evetac_cli.devices.dvxplorer.protocol import READOUT_RATES, DvxplorerSettings
from evetac_cli.errors import DeviceError
from evetac_cli.events import SLICE_US, Events

EPOCH_US = 1_700_000_000_000_000
ROW = np.dtype([("timestamp", "<i8"), ("x", "<i2"), ("y", "<i2"), ("polarity", "i1")])


class Batch:
    """As dv.EventStore."""

    def __init__(self, rows: np.ndarray) -> None:
        self._rows = rows

    def size(self) -> int:
        return len(self._rows)

    def numpy(self) -> np.ndarray:
        return self._rows


class FakeMini:
    """As dv.io.camera.DVXplorerM: hands out prepared batches, then None."""

    def __init__(self, *serial: str) -> None:
        self.calls: dict[str, Any] = {"serial": serial}
        self.batches: deque[Batch] = deque()
        self.running = True
        FakeMini.latest = self

    latest: "FakeMini"

    def __getattr__(self, name: str) -> Any:
        if not name.startswith("set"):
            raise AttributeError(name)
        return lambda value: self.calls.__setitem__(name, value)

    def getCameraName(self) -> str:  # the library's name
        return "DVXplorerM_FAKE"

    def getNextEventBatch(self) -> Batch | None:
        return self.batches.popleft() if self.batches else None

    def isRunning(self) -> bool:
        return self.running


RATES = SimpleNamespace(
    **{name.upper().replace("-", "_").replace("LOSSY", "CONSTANT_LOSSY"): name for name in READOUT_RATES}
)


def library(camera: Any = FakeMini) -> Any:
    known = SimpleNamespace(DVXplorerM=camera, DVXplorer=SimpleNamespace(ReadoutFPS=RATES))
    return SimpleNamespace(io=SimpleNamespace(camera=known))


def batch(t_us: list[int]) -> Batch:
    rows = np.zeros(len(t_us), ROW)
    rows["timestamp"] = np.array(t_us) + EPOCH_US
    rows["x"] = np.arange(len(t_us))
    rows["polarity"] = 1
    return Batch(rows)


def test_settings_are_told() -> None:
    """Assert that every setting reaches the library in its own words, and batches of 1 ms."""
    settings = DvxplorerSettings(3, 4, "lossy-2000", 500, global_hold=False)
    with closing(DvCamera("ABC", settings, library())) as camera:
        assert camera.sensor["sensor/name"] == "dv:DVXplorerM_FAKE"
    assert FakeMini.latest.calls == {
        "serial": ("ABC",),
        "setReadoutFPS": "lossy-2000",
        "setContrastThresholdOn": 3,
        "setContrastThresholdOff": 4,
        "setGlobalHold": False,
        "setMIPITimeoutValue": timedelta(microseconds=500),
        "setTimeInterval": timedelta(microseconds=1000),
    }


def test_slices_and_clock() -> None:
    """Assert slices from the first event's ms on, empty ones included, closed by device or host time; late events."""
    camera: EventCamera = DvCamera(library=library())
    mini = FakeMini.latest
    mini.batches += [batch([300, 900]), batch([3100, 4000])]
    slices = [camera.read() for _ in range(4)]
    assert [part.t.tolist() for part in slices if part is not None] == [[300, 900], [], [], [3100]]
    assert all([each.dtype for each in part] == [np.int64, np.uint16, np.uint16, np.uint8] for part in slices if part)
    assert camera.now_us() >= 4000
    silent = [camera.read() for _ in range(20)]
    assert isinstance(silent[0], Events)
    assert silent[0].t.tolist() == [4000]
    assert sum(part.size for part in silent[1:] if part is not None) == 0
    mini.batches.append(batch([5000, 5001, 10**7]))
    while mini.batches:  # on a busy machine several slices may have been closed already
        camera.read()
    assert {name: count for name, count in camera.counted.items() if count} == {"late_events": 2, "early_events": 1}
    camera.close()
    camera.close()
    assert camera.read() is None


class Times:
    """A clock of the host that goes on by as much as is asked for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_us = 1e9
        monkeypatch.setattr(dv, "_now_us", lambda: self.now_us)
        monkeypatch.setattr(dv.time, "sleep", self.sleep)

    def sleep(self, seconds: float) -> None:
        self.now_us += seconds * 1e6


@pytest.mark.parametrize("jump_us", [5_000_000, -5_000_000, 10**15])
def test_h2_a_clock_that_jumps_makes_no_more_slices_than_the_hosts_time(
    jump_us: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert slices of the host's time, whatever the library's clock says, and events again a second after the jump."""
    times = Times(monkeypatch)
    began_us = times.now_us
    sizes = []
    with closing(DvCamera(library=library())) as camera:
        mini = FakeMini.latest
        for ms in range(3000):
            times.now_us = max(times.now_us, began_us + 1000.0 * (ms + 1))
            device_us = 10_000_000 + 1000 * ms + (jump_us if ms >= 500 else 0)
            mini.batches.append(batch([device_us + 100, device_us + 900]))
            while mini.batches or camera._ready:
                part = camera.read()
                assert part is not None
                sizes.append(part.size)
                assert len(sizes) <= (times.now_us - began_us) * 1e-3 + 30
        counts = camera.counted
    assert counts["clock_restarts"] == 1
    assert len(sizes) >= 2900
    assert sum(sizes[:490]) >= 2 * 480
    assert sum(sizes[-1000:]) >= 2 * 900
    assert sum(sizes) + counts["late_events"] + counts["early_events"] >= 6000 - 100


def test_m8_a_library_without_events_is_news(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that seconds without an event are counted, also once events come again, and a short pause is not."""
    times = Times(monkeypatch)
    with closing(DvCamera(library=library())) as camera:
        mini = FakeMini.latest
        mini.batches.append(batch([300]))
        for _ in range(900):
            camera.read()
        assert camera.counted["ms_without_events"] == 0
        for _ in range(2000):
            camera.read()
        quiet_ms = camera.counted["ms_without_events"]
        assert 2850 <= quiet_ms <= 2950
        mini.batches.append(batch([int(times.now_us - 1e9) + 500]))
        camera.read()
        assert 2850 <= camera.counted["ms_without_events"] <= 2950


def test_unplugged() -> None:
    """Assert that what came is handed out, and then a DeviceError, each time."""
    camera = DvCamera(library=library())
    mini = FakeMini.latest
    mini.batches += [batch([300]), batch([1000 + SLICE_US])]
    mini.running = False
    assert camera.read() is not None
    assert camera.read() is not None
    for _ in range(2):
        with pytest.raises(DeviceError, match="no longer on the bus"):
            camera.read()
    camera.close()


@pytest.mark.parametrize("error", [RuntimeError("No compatible devices"), IndexError("vector"), ValueError("x")])
def test_camera_that_cannot_be_opened(error: Exception) -> None:
    """Assert that what the library raises becomes a DeviceError with a hint."""

    def refuse(*serial: str) -> None:
        raise error

    with pytest.raises(DeviceError, match="evetac doctor"):
        DvCamera(library=library(refuse))


def test_the_library_itself() -> None:
    """Assert that the maker's library has every name we use, and that without a camera there is a DeviceError."""
    real = pytest.importorskip("dv_processing")
    mini = real.io.camera.DVXplorerM
    calls = [name for name in FakeMini("x").calls if name.startswith("set")]
    with closing(DvCamera(library=library())):
        calls = [name for name in FakeMini.latest.calls if name.startswith("set")]
    assert len(calls) == 6
    for name in (*calls, "getCameraName", "getNextEventBatch", "isRunning"):
        assert hasattr(mini, name)
    assert vars(RATES).keys() == real.io.camera.DVXplorer.ReadoutFPS.__members__.keys()
    if not real.io.camera.discover():
        with pytest.raises(DeviceError, match="could not open"):
            DvCamera()
