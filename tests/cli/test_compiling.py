"""The line about compiling: after some patience, as often as it takes long, and not at all if quiet."""

import gc

import pytest
from numba.core import event

from evetac_cli.cli import workers


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time that the announcer sees, in s."""
    now = [100.0]
    monkeypatch.setattr(workers.time, "monotonic", lambda: now[0])
    return now


def compile_for(clock: list[float], inner_s: float, outer_s: float) -> None:
    """A function that takes some time, within which another one that it needs is compiled."""
    with event.trigger_event("numba:compile"):
        with event.trigger_event("numba:compile"):
            clock[0] += inner_s
            assert not gc.isenabled()
        clock[0] += outer_s


def test_a_long_wait_is_announced(clock: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that nothing is said of a short wait, and of a long one once and again."""
    with workers.announced(quiet=False):
        compile_for(clock, 0.5, 0.5)
        clock[0] += 60.0  # in which something else is done
        assert capsys.readouterr().err == ""
        compile_for(clock, 2.0, 1.0)
        assert capsys.readouterr().err == "compiling, once after installing: 3 functions so far, 3 s\n"
        compile_for(clock, 1.0, 5.0)
        assert capsys.readouterr().err == "compiling, once after installing: 6 functions so far, 10 s\n"
    with event.trigger_event("numba:compile"):
        clock[0] += 60.0
        assert gc.isenabled()
    assert capsys.readouterr().err == ""


def test_an_interrupt_that_was_swallowed_comes_up_after_the_function(clock: list[float]) -> None:
    """Assert that it is raised again by the next function, but neither while it ends the command nor in cleaning up."""
    pressed: list[bool] = []
    ended = []
    with pytest.raises(KeyboardInterrupt), workers.announced(quiet=True, interrupted=lambda: bool(pressed)):
        compile_for(clock, 1.0, 1.0)
        ended.append("before")
        with event.trigger_event("numba:compile"), event.trigger_event("numba:compile"):
            pressed.append(True)
        ended.append("after")
    assert ended == ["before"]
    with workers.announced(quiet=True, interrupted=lambda: True):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            compile_for(clock, 1.0, 1.0)
    assert gc.isenabled()
