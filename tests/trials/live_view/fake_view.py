"""A live view without a process: remembers what it was handed over, and asks to let go after a number of slices."""

from collections.abc import Mapping
from contextlib import nullcontext
from typing import Any

import pytest

from evetac_cli.events import Events
from evetac_cli.trials import live_view


class FakeView:
    """Stands for a LiveView; `after`: its button is pressed once there are so many slices."""

    def __init__(self, after: float = float("inf")) -> None:
        self._after = after
        self.sensor: dict[str, Any] = {}
        self.slices: list[tuple[int, float, float]] = []  # events, lateness, probability
        self.commands: list[dict[str, Any]] = []
        self.counts: dict[str, int] = {}
        self.said: list[str] = []
        self.ended = ""

    def begin(self, sensor: Mapping[str, Any]) -> None:
        self.sensor = dict(sensor)

    def add_slice(self, events: Events, late_us: float = float("nan"), probability: float = float("nan")) -> None:
        self.slices.append((events.size, late_us, probability))

    def add_command(self, row: Mapping[str, Any]) -> None:
        self.commands.append(dict(row))

    def lost(self, counts: Mapping[str, int]) -> None:
        self.counts = dict(counts)

    def say(self, text: str) -> None:
        self.said.append(text)

    @property
    def is_asked_to_let_go(self) -> bool:
        return len(self.slices) >= self._after

    def end(self, why: str) -> None:
        self.ended = self.ended or why

    def put_in_place(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Let it stand for whatever view is opened from now on."""
        monkeypatch.setattr(live_view, "opened", lambda *asked, **more: nullcontext(self))
