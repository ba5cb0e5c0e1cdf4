"""The requests: what a robot's program is answered, and what whoever records is told."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from evetac_cli.store.recordings import streams
from evetac_cli.trials.listen.trial_requests import TrialRequests
from evetac_cli.trials.session import ABORTED, STOPPED

LONG_AGO_S = 100.0  # before now the recording began


def asked(requests: TrialRequests, command: str, **fields: Any) -> dict[str, Any]:
    """The answer, which has come."""
    return requests.ask({"token": "x", "command": command, **fields}).result(0)


def recording(requests: TrialRequests, slices: int = 1, zero_us: float | None = None) -> float:
    """Let a trial begin that began LONG_AGO_S before now; when that was, in us."""
    waiting = requests.ask({"command": "start", "name": "cup-01"})
    assert not waiting.done()
    assert requests.wanted() == "cup-01"
    began_us = 1e6 * (time.monotonic() - LONG_AGO_S) if zero_us is None else zero_us
    assert requests.recorded(slices, time.monotonic, began_us) == ""
    assert waiting.result(0)["state"] == "recording"
    return began_us


@pytest.mark.parametrize(
    ("command", "fields", "words"),
    [
        ("start", {"name": "../a"}, "not the name of a trial"),
        ("start", {"name": "a/b"}, "not the name of a trial"),
        ("start", {"name": ".hidden"}, "not the name of a trial"),
        ("start", {"name": "a\n"}, "not the name of a trial"),
        ("start", {"name": "a.recording.h5"}, "not the name of a trial"),
        ("start", {"name": "a" * 101}, "not the name of a trial"),
        ("start", {"name": 7}, "not the name of a trial"),
        ("start", {"name": "a", "force": True}, "start has no 'force'"),
        ("mark", {"text": "x"}, "nothing is being recorded"),
        ("stop", {}, "nothing is being recorded"),
        ("abort", {}, "nothing is being recorded"),
        ("fly", {}, "no such command"),
        (["start"], {}, "no such command"),
    ],
)
def test_what_cannot_be_granted_is_said(command: Any, fields: dict[str, Any], words: str) -> None:
    """Assert that names are names of files, and that a request says which part of it is wrong."""
    requests = TrialRequests()
    answer = asked(requests, command, **fields)
    assert not answer["ok"]
    assert words in answer["error"]
    assert (answer["state"], requests.wanted()) == ("idle", "")


def test_a_mark_lies_where_it_was_sent() -> None:
    """Assert that `at_s` is the mark's time, that without it it lies between sending and answer, and its slice."""
    requests = TrialRequests()
    began_us = recording(requests)
    at_s = time.monotonic() - 2.0
    told = asked(requests, "mark", text="told", at_s=at_s)
    assert abs(told["t_us"] - (1e6 * at_s - began_us)) < 1000
    sent_us = 1e6 * time.monotonic() - began_us
    came = asked(requests, "mark", text="camé")
    assert sent_us - 1000 < came["t_us"] <= 1e6 * time.monotonic() - began_us + 1000
    assert came["slice"] == came["t_us"] // 1000
    rows = requests.marked()
    assert [row["marks/t_us"] for row in rows] == [told["t_us"], came["t_us"]]
    assert rows == [] or bytes(rows[1]["marks/text"]).rstrip(b"\0").decode() == "camé"
    assert requests.marked() == []


@pytest.mark.parametrize("seconds", [-LONG_AGO_S - 1.0, 10.0, -3.0])
def test_a_mark_of_another_time_is_refused(seconds: float) -> None:
    """Assert that a time before the trial, after now, or before another mark is none."""
    requests = TrialRequests()
    recording(requests)
    asked(requests, "mark", text="before", at_s=time.monotonic() - 2.0)
    assert not asked(requests, "mark", text="x", at_s=time.monotonic() + seconds)["ok"]
    assert not asked(requests, "mark", text="x", at_s=True)["ok"]
    assert len(requests.marked()) == 1


def test_a_camera_without_a_clock_has_marks_all_the_same() -> None:
    """Assert that where nobody knows the time, a mark lies after the slices so far."""
    requests = TrialRequests()
    recording(requests, 42, math.nan)
    assert asked(requests, "mark", text="x")["t_us"] == 42_000


def test_stop_waits_for_the_slice_of_its_moment() -> None:
    """Assert that all up to the moment of `stop` is recorded, that its answer is the file, and comes again if asked."""
    requests = TrialRequests()
    began_us = recording(requests)
    stopped = requests.ask({"command": "stop"})
    slices = int((1e6 * time.monotonic() - began_us) / 1000) + 1
    assert requests.recorded(slices - 1000, time.monotonic, began_us) == ""
    assert not asked(requests, "mark", text="late")["ok"]
    assert requests.recorded(slices + 1, time.monotonic, began_us) == STOPPED
    assert not stopped.done()
    requests.marked(last=True)
    assert asked(requests, "status")["state"] == "saving"
    assert "too late" in asked(requests, "abort")["error"]
    assert "is being recorded" in asked(requests, "start", name="b")["error"]
    again = requests.ask({"command": "stop"})
    requests.ended("/data/cup-01.recording.h5", STOPPED, slices)
    for answer in (stopped.result(0), again.result(0), asked(requests, "stop")):
        assert answer["ok"]
        assert (answer["file"], answer["slices"]) == ("/data/cup-01.recording.h5", slices)
        assert (answer["trials"], answer["state"], answer["last"]) == (1, "idle", answer["file"])


def test_a_camera_that_is_late_does_not_keep_stop_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a trial ends some time after `stop`, also where the slice of its moment does not come."""
    requests = TrialRequests()
    began_us = recording(requests)
    requests.ask({"command": "stop"})
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s + 1.5)
    assert requests.recorded(2, lambda: now_s, began_us) == STOPPED


def test_abort_ends_at_once_and_counts_as_no_trial() -> None:
    """Assert that an aborted trial has no file, and that the next may have its name."""
    requests = TrialRequests()
    began_us = recording(requests)
    waiting = requests.ask({"command": "abort"})
    assert requests.recorded(2, time.monotonic, began_us) == ABORTED
    requests.ended(None, ABORTED)
    answer = waiting.result(0)
    assert answer["ok"]
    assert (answer["file"], answer["trials"], answer["last"]) == (None, 0, None)
    recording(requests)


def test_a_start_that_fails_is_told_to_whoever_waits() -> None:
    """Assert that `start` and a `stop` behind it get the error, and another trial may start."""
    requests = TrialRequests()
    waiting = [requests.ask({"command": "start", "name": "a"}), requests.ask({"command": "stop"})]
    requests.ended(None, "nothing was recorded", error="the camera is unplugged")
    for answer in waiting:
        assert not answer.result(0)["ok"]
        assert answer.result(0)["error"] == "the camera is unplugged"
    assert "unplugged" in asked(requests, "stop")["error"]
    assert asked(requests, "status")["state"] == "idle"


def test_a_trial_that_nobody_stops_ends() -> None:
    """Assert that the longest time ends a trial, in words, and only then."""
    requests = TrialRequests(longest_s=2.0)
    began_us = recording(requests)
    assert requests.recorded(1999, time.monotonic, began_us) == ""
    assert "no stop command" in requests.recorded(2000, time.monotonic, began_us)


def test_rows_hold_texts_as_they_are() -> None:
    """Assert that a text comes back from its bytes, and that a longer one is refused and not cut."""
    row = streams.mark_row(1500, "gehoben: 2 µm")

    class File:
        def has(self, path: str) -> bool:
            return True

        def read(self, path: str) -> Any:
            return np.array([row[path]])

    assert streams.marks_of(File()) == [streams.Mark(1, 1500, "gehoben: 2 µm")]
    with pytest.raises(ValueError, match="more than 120"):
        streams.mark_row(0, "x" * 121)


def test_a_wait_ends_with_a_start() -> None:
    """Assert that whoever waits for a name has it as soon as it is asked for."""
    requests = TrialRequests()
    assert requests.wanted(0.001) == ""
    held: Callable[..., Any] = requests.ask
    held({"command": "start", "name": "a"})
    assert requests.wanted(600.0) == "a"


@pytest.mark.parametrize(("command", "why"), [("stop", STOPPED), ("abort", ABORTED)])
def test_what_is_called_off_before_it_begins_is_known(command: str, why: str) -> None:
    """Assert that whoever records sees it before anything moves, that start is refused, and that the next is free."""
    requests = TrialRequests()
    starting = requests.ask({"command": "start", "name": "a"})
    assert requests.end_reason == ""
    ending = requests.ask({"command": command})
    assert requests.end_reason == why
    requests.ended(None, requests.end_reason)
    assert (starting.result(0)["ok"], starting.result(0)["error"]) == (False, why)
    assert (ending.result(0)["ok"], ending.result(0)["file"], ending.result(0)["ended"]) == (True, None, why)
    requests.ask({"command": "start", "name": "b"})
    assert requests.end_reason == ""


def test_signals_during_a_trial_are_remembered() -> None:
    """Assert that one that came is not forgotten for a later trial without, and that 0 is none."""
    requests = TrialRequests()
    requests.record_signals([0])
    assert not requests.interrupted
    requests.record_signals([2, 0])
    requests.record_signals([])
    assert requests.interrupted
