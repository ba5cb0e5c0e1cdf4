"""What a terminal of 80 columns shows while commands work: the real program in a pseudo-terminal."""

import os
import pty
import re
import select
import struct
import subprocess
import sys
import time
from fcntl import ioctl
from pathlib import Path
from termios import TIOCSWINSZ
from typing import NamedTuple

import pytest

from evetac_cli.resources import PACKAGE
from tests.patience import PATIENCE_S

COLUMNS = 80
CTRL_C = b"\x03"


class Session(NamedTuple):
    """What a command wrote to its terminal, piece by piece with the time after its start, and how it ended."""

    pieces: list[tuple[float, str]]
    code: int
    ended_after_s: float  # since Ctrl-C was pressed, or since the start

    @property
    def text(self) -> str:
        return "".join(piece for _, piece in self.pieces)

    @property
    def plain(self) -> str:
        return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", self.text)

    def lines(self) -> list[str]:
        """All that ever stood on a line, without colours."""
        return [line.rstrip() for line in re.split(r"[\r\n]", self.plain)]

    @property
    def last_line(self) -> str:
        return [line for line in self.lines() if line][-1]

    def first_s(self, pattern: str) -> float:
        """When a text first stood there."""
        seen = ""
        for at_s, piece in self.pieces:
            seen += piece
            if re.search(pattern, seen):
                return at_s
        pytest.fail(f"{pattern} never stood there:\n{self.text}")


def session(folder: Path, *words: str | Path, press_at: str = "") -> Session:
    """Run evetac in a terminal of 80 columns; press Ctrl-C as soon as a text stands there."""
    leader, follower = pty.openpty()
    ioctl(follower, TIOCSWINSZ, struct.pack("HHHH", 24, COLUMNS, 0, 0))
    paths = os.pathsep.join([str(PACKAGE.parent), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "TERM": "xterm-256color", "PYTHONPATH": paths}
    for name in ("COLUMNS", "LINES", "NO_COLOR"):
        environment.pop(name, None)
    run = subprocess.Popen(
        # as a shell does it: so that Ctrl-C is a signal to all of its processes
        ["setsid", "--ctty", "--wait", sys.executable, "-m", "evetac_cli", *map(str, words)],
        cwd=folder,
        stdin=follower,
        stdout=follower,
        stderr=follower,
        env=environment,
    )
    os.close(follower)
    started_s = from_s = time.monotonic()
    pieces: list[tuple[float, str]] = []
    pressed = not press_at
    try:
        while time.monotonic() - started_s < PATIENCE_S:
            if select.select([leader], [], [], 0.1)[0]:
                try:
                    read = os.read(leader, 1 << 16)
                except OSError:  # the last process has closed it
                    break
                pieces.append((time.monotonic() - started_s, read.decode(errors="replace")))
            if not pressed and re.search(press_at, "".join(piece for _, piece in pieces)):
                os.write(leader, CTRL_C)
                pressed, from_s = True, time.monotonic()
        code = run.wait(timeout=PATIENCE_S)
    finally:
        run.kill()
        os.close(leader)
    return Session(pieces, code, time.monotonic() - from_s)


def check_bars(shown: Session, bars: int = 1) -> None:
    """Every bar stands on one line that fits."""
    assert shown.code == 0, shown.plain
    assert max(len(line) for line in shown.lines() if "━" in line) <= COLUMNS
    # A bar goes up a line to vanish at its end; one that wraps does so each time that it is drawn.
    assert shown.text.count("\x1b[1A") <= bars


@pytest.mark.slow
def test_a_session_at_80_columns(tmp_path: Path) -> None:
    """Assert that bars fit a line and reach their totals, and that the last line is what can be pasted."""
    shown = session(tmp_path, "record", "--object", "8,12", "--count", "2", "-o", "data")
    check_bars(shown, 4)
    counts = re.findall(r"record (\d) of 4: .*?([\d,]+)/([\d,]+) slices", shown.plain)
    for number in "1234":
        pairs = [(done, total) for trial, done, total in counts if trial == number]
        assert pairs and pairs[-1][0] == pairs[-1][1]
    assert shown.last_line == "data"

    for command in ("label", "track"):
        shown = session(tmp_path, command, "data", "--jobs", "2")
        check_bars(shown)
        assert re.search(f"{command} 4 files .*[0-4]/4 files", shown.plain)
        assert shown.first_s("starting 2 processes") < shown.first_s("/4 files")
    check_bars(session(tmp_path, "featurize", "data"), 4)
    shown = session(tmp_path, "train", "data", "--max-steps", "300", "--preset", "adam", "-o", "m.model.h5")
    check_bars(shown)
    assert "note: checkpoint and threshold are chosen on 1 trajectory" in " ".join(shown.plain.split())
    assert shown.first_s("loading torch|files inspected") < shown.first_s("files read") < shown.first_s("/300 steps")
    assert shown.last_line == "m.model.h5"
    shown = session(tmp_path, "grasp", "--lift-s", "1", "--balance-s", "1", "-o", "grasps")
    check_bars(shown)
    assert re.search(r"[\d,]+/[\d,]+ slices", shown.plain)
    assert shown.last_line == "grasps/lift-obj11-s0-000.recording.h5"


@pytest.mark.slow
def test_ctrl_c_ends_a_training(tmp_path: Path) -> None:
    """Assert that Ctrl-C in the terminal ends a training in words, while it reads and while it learns.

    On a computer that is not busy that takes less than 1 s; the times are printed (pytest -s).
    """
    session(tmp_path, "record", "--object", "8,12", "-o", "data")
    for command in ("label", "track", "featurize"):
        session(tmp_path, command, "data")
    for moment in ("loading torch", r"[1-9]\d\d?/[\d,]+ .*steps"):
        shown = session(tmp_path, "train", "data", "--epochs", "100000", "--max-steps", "1000000", press_at=moment)
        print(f"{moment}: {shown.ended_after_s:.2f} s")
        assert shown.code == 130, shown.plain
        assert "interrupted" in shown.plain
        assert "Traceback" not in shown.plain
        assert shown.ended_after_s < 20.0
