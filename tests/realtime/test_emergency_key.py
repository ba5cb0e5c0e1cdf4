"""The emergency key, pressed at a pseudo terminal."""

import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator

import pytest

from evetac_cli.realtime.emergency_key import emergency_key
from evetac_cli.resources import PACKAGE
from tests.patience import PATIENCE_S

PROGRAM = """
import sys, time
from evetac_cli.realtime.emergency_key import emergency_key
with emergency_key() as key:
    print("there" if key.exists else "not there", flush=True)
    while not key.pressed:
        time.sleep(0.001)
    print("pressed", flush=True)
    if sys.argv[1] == "fails":
        raise ValueError
    if sys.argv[1] == "waits":
        time.sleep(60)
"""


class AtATerminal:
    """The program, with a pseudo terminal as its stdin and its controlling terminal."""

    def __init__(self, how: str) -> None:
        self.ours, self.theirs = pty.openpty()
        self.before = termios.tcgetattr(self.theirs)
        environment = {**os.environ, "PYTHONPATH": str(PACKAGE.parent)}
        self.run = subprocess.Popen(
            ["setsid", "--ctty", "--wait", sys.executable, "-c", PROGRAM, how],
            stdin=self.theirs, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment,
        )  # fmt: skip

    def says(self) -> str:
        assert self.run.stdout is not None
        assert select.select([self.run.stdout], [], [], PATIENCE_S)[0]
        return self.run.stdout.readline().strip()

    def press(self, keys: bytes) -> None:
        os.write(self.ours, keys)

    def close(self) -> None:
        self.run.kill()
        self.run.communicate()
        for end in (self.ours, self.theirs):
            os.close(end)


@pytest.fixture
def terminal(request: pytest.FixtureRequest) -> Iterator[AtATerminal]:
    made = AtATerminal(request.param)
    yield made
    made.close()


def restored(terminal: AtATerminal) -> bool:
    """Whether the terminal is as it was, once the program has ended."""
    terminal.run.wait(PATIENCE_S)
    return termios.tcgetattr(terminal.theirs) == terminal.before


@pytest.mark.skipif(sys.platform != "linux", reason="setsid gives a process a terminal of its own")
@pytest.mark.parametrize("terminal", ["ends", "fails"], indirect=True)
def test_it_comes_at_once_and_the_terminal_is_as_it_was(terminal: AtATerminal) -> None:
    """Assert that the space bar counts without Enter, other keys do not, and that an error restores the terminal."""
    assert terminal.says() == "there"
    terminal.press(b"x")
    time.sleep(0.05)
    assert terminal.run.poll() is None
    terminal.press(b" ")
    assert terminal.says() == "pressed"
    assert restored(terminal)


@pytest.mark.skipif(sys.platform != "linux", reason="setsid gives a process a terminal of its own")
@pytest.mark.parametrize("terminal", ["waits"], indirect=True)
def test_ctrl_c_works_and_restores_the_terminal(terminal: AtATerminal) -> None:
    """Assert that Ctrl-C is no key like any other, and that the terminal is then as it was."""
    assert terminal.says() == "there"
    terminal.press(b"\x03")
    assert restored(terminal)
    assert terminal.run.returncode in (1, 130, 128 + signal.SIGINT, -signal.SIGINT)


def test_without_a_terminal_there_is_no_key(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a pipe, no stdin and a closed one have no key, and that nothing is read from them."""
    reading, writing = os.pipe()
    os.write(writing, b" ")
    with os.fdopen(reading) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        with emergency_key() as key:
            assert not key.exists
            assert not key.pressed
    for gone in (None, stdin):
        monkeypatch.setattr(sys, "stdin", gone)
        with emergency_key() as key:
            assert not key.exists
    os.close(writing)
