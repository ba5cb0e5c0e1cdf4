"""doctor speed, on computers made up of figures: what is asked of each part, and what is advised where it is slow."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.errors import InputError
from evetac_cli.inspect.doctor import speed
from evetac_cli.inspect.doctor.speed import Computer, Tried, WakeUps

FINE = Tried(0, "", 10_000, 100, 5_000, 50, 400, 0.5, 0.62)  # at the limits, but for what a pseudo terminal misses


class Made(Computer):
    """A computer of known figures, all of them within their limits by a little."""

    def __init__(self, **figures: Any) -> None:
        given = {
            "cores": [0, 1],
            "late_us": {0: [50.0, 2000.0, *[499.0] * 998], 1: [10.0] * 100},
            "scheduling": "real-time 30",
            "governor": "performance",
            "fails": None,
            "bears": 1_000_000,
            "too_much": {"late_slices": 101},
        }
        self.figures: dict[str, Any] = {**given, **figures}

    def cores(self) -> list[int]:
        return self.figures["cores"]  # type: ignore[no-any-return]

    def wake_ups_us(self, core: int, seconds: float) -> WakeUps:
        return WakeUps(np.array(self.figures["late_us"][core]), self.figures["scheduling"])

    def governor(self) -> str | None:
        return self.figures["governor"]  # type: ignore[no-any-return]

    def grasped(
        self, events_per_s: int, folder: Path, progress: Callable[[float], None], seconds: float = 10.0
    ) -> Tried:
        for passed_s in (0.5, seconds):
            progress(passed_s)
        if self.figures["fails"] is not None:
            raise self.figures["fails"]
        if events_per_s > self.figures["bears"]:
            return FINE._replace(events_per_s=events_per_s, **self.figures["too_much"])
        return FINE._replace(events_per_s=events_per_s)


def wrong(**figures: Any) -> dict[str, dict[str, Any]]:
    """The checks that are not passed by a computer that differs so from one within all limits."""
    result = speed.run(Made(**figures))
    failed = {row["check"]: row for row in result.rows if row["ok"] is False}
    assert result.summary["wrong"] == len(failed)
    return failed


def test_at_the_limits_a_computer_is_fast_enough(capsys: pytest.CaptureFixture[str]) -> None:
    assert wrong() == {}
    speed.show(speed.run(Made()))
    shown = capsys.readouterr().out
    assert "WRONG" not in shown
    assert "no faults found" in shown
    assert "camera found" not in shown  # nothing was looked for


@pytest.mark.parametrize(
    ("figures", "check", "words"),
    [
        ({"late_us": {0: [10.0] * 100, 1: [501.0] * 100}}, "core 1 wakes", "501 us late"),
        ({"late_us": {0: [*[10.0] * 999, 2001.0], 1: [10.0]}}, "core 0 wakes", "all of them at most 2001 us"),
        ({"cores": [1]}, "for this program", "1"),
    ],
)
def test_a_part_that_is_too_slow_is_named(figures: dict[str, Any], check: str, words: str) -> None:
    failed = wrong(**figures)
    assert list(failed) == [check]
    assert words in failed[check]["found"]
    assert failed[check]["expected"]
    assert failed[check]["fix"]


def test_late_wake_ups_are_blamed_on_what_can_be_changed() -> None:
    late = {0: [10.0], 1: [3000.0] * 10}
    assert wrong(late_us=late)["core 1 wakes"]["fix"] == speed.CLOSE
    figures = {"late_us": late, "scheduling": "as usual", "governor": "powersave"}
    assert wrong(**figures)["core 1 wakes"]["fix"] == "; ".join([speed.CLOSE, speed.PERMIT, speed.SET_GOVERNOR])


def test_this_computer_is_measured_and_left_as_it_was(tmp_path: Path) -> None:
    """Assert that wake-ups and governor are known, and that the cores of this thread do not change."""
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    computer = Computer(tmp_path)
    woken = computer.wake_ups_us(computer.cores()[-1], 0.005)
    assert len(woken.late_us) >= 1
    assert (woken.late_us > -1000.0).all()
    assert cores is None or os.sched_getaffinity(0) == cores
    assert computer.governor() is None
    file = tmp_path / "devices/system/cpu/cpu0/cpufreq/scaling_governor"
    file.parent.mkdir(parents=True)
    file.write_text("schedutil\n")
    assert computer.governor() == "schedutil"


def test_the_command_measures_and_ends_with_3_where_something_is_too_slow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "Computer", Made)
    fine = CliRunner().invoke(app, ["doctor", "speed", "--json"])
    assert (fine.exit_code, json.loads(fine.stdout)["summary"]) == (0, {"wrong": 0, "judged_events_per_s": 1_000_000})
    monkeypatch.setattr(speed, "Computer", lambda: Made(cores=[1]))
    slow = CliRunner().invoke(app, ["doctor", "speed"])
    assert slow.exit_code == 3
    assert "WRONG for this program" in slow.stdout
    unwritable = speed.run(Made(fails=InputError("no room")))
    assert unwritable.summary == {"wrong": 0, "judged_events_per_s": None}
    assert unwritable.rows[-1]["found"] == "not tried: no room"


@pytest.mark.parametrize(
    ("bears", "tried", "judged"),
    [
        (1_000_000, [1_000_000], 1_000_000),
        (999_999, [1_000_000, 300_000, 600_000], 600_000),
        (599_999, [1_000_000, 300_000, 600_000], 300_000),
        (299_999, [1_000_000, 300_000, 100_000], 100_000),
        (99_999, [1_000_000, 300_000, 100_000], 0),
    ],
)
def test_what_is_said_to_be_judged_was_tried(bears: int, tried: list[int], judged: int) -> None:
    """Assert that rates are tried until one is fine, that each is said to be fine or not, and the highest is judged."""
    reported = set()
    result = speed.run(
        Made(bears=bears),
        progress=lambda done, total, doing="": reported.add((total, doing)),
    )
    rows = {row["check"]: row for row in result.rows if row["device"] == "grasp"}
    last = rows.pop("judges in time")
    assert list(rows) == [f"at {rate:,}/s" for rate in tried]
    for rate, row in zip(tried, rows.values(), strict=True):
        assert row["ok"] == (rate <= bears)
        assert row["found"].startswith("fine: " if rate <= bears else "not fine: 101 of 10,000 slices late")
        assert "50 of 5,000 commands missed; 400 more by the virtual gripper; " in row["found"]
        assert "the detector takes 62 % of a core" in row["found"]
        assert (10.0, f"s of a grasp at {rate:,} events/s") in reported
    assert result.summary["judged_events_per_s"] == judged
    assert last["ok"] == (judged == 1_000_000)
    assert last["found"].startswith(f"{judged:,} events" if judged else "less than 100,000 events")


@pytest.mark.parametrize(
    "too_much",
    [{"late_slices": 101}, {"missed_by_us": 51}, {"behind_s": 0.51}, {"ended": "the recorder hangs", "late_slices": 0}],
)
def test_a_rate_is_not_fine_where_a_grasp_would_say_so(too_much: dict[str, Any]) -> None:
    """Assert that late slices, our own missed commands, a recorder that falls behind and an early end each count."""
    failed = wrong(bears=300_000, too_much=too_much)
    assert list(failed) == ["at 1,000,000/s", "at 600,000/s", "judges in time"]
    for row in failed.values():
        assert speed.CLOSE in row["fix"]
    if "ended" in too_much:
        assert failed["at 600,000/s"]["found"].startswith("not fine: the recorder hangs; ")


@pytest.mark.slow
def test_this_computer_grasps(tmp_path: Path) -> None:
    """Assert that a short grasp is made with all its figures, and that nothing is left of it."""
    seconds: list[float] = []
    tried = Computer().grasped(10_000, tmp_path, seconds.append, 2.5)
    assert tried.events_per_s == 10_000
    assert tried.slices > 0
    assert tried.commands > 0
    assert tried.ended or (tried.slices, seconds[-1]) == (2500, 2.5)
    assert tried.detector_share is None or 0.0 < tried.detector_share < 4.0
    assert list(tmp_path.iterdir()) == []
