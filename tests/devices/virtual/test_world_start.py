"""The start of a virtual world, whose numba kernels may have to be compiled on a busy machine."""

from types import SimpleNamespace
from typing import Any

import pytest

from evetac_cli.devices.virtual import world
from evetac_cli.errors import DeviceError
from evetac_cli.realtime import processes

BUILT = {"sensors": ({},), "holding_ma": 1.0, "sampled": "{}", "fall_factor": 1.0}


class BusyHost:
    """A machine on which a process gets `share` of every second, and a world is built after `seconds` of its time."""

    def __init__(self, share: float, seconds: float) -> None:
        self.share, self.seconds, self.now_s = share, seconds, 0.0

    def cpu_time_s(self, pid: int) -> float:
        return round(self.share * self.now_s, 2)

    def poll(self, timeout_s: float) -> bool:
        self.now_s += timeout_s
        return self.share * self.now_s >= self.seconds

    def built(self, monkeypatch: pytest.MonkeyPatch) -> Any:
        """A world that was waited for on this machine."""
        monkeypatch.setattr(processes, "cpu_time_s", self.cpu_time_s)
        monkeypatch.setattr(processes, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        waiting = world.VirtualWorld.__new__(world.VirtualWorld)
        waiting._orders = SimpleNamespace(poll=self.poll, recv=lambda: BUILT)
        waiting._wait_until_built(SimpleNamespace(pid=1))
        return waiting


def test_cold_caches_on_a_busy_machine_are_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a world that computes is waited for, whatever the clock says: here half an hour."""
    assert BusyHost(0.02, 40.0).built(monkeypatch).holding_ma == 1.0


def test_a_world_that_does_nothing_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a process that stands still is not waited for without end."""
    with pytest.raises(DeviceError, match="did not start"):
        BusyHost(0.0, 1.0).built(monkeypatch)
