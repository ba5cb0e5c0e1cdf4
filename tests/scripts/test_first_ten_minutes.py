"""The first ten minutes of docs/hardware.md: what they ask for with real devices runs with virtual ones."""

import os
import re
import shlex
import sys
from pathlib import Path

import pytest

from scripts import first_hour

ROOT = first_hour.ROOT
PAGE = (ROOT / "docs" / "hardware.md").read_text().partition("\n## Ten minutes\n")[2].partition("\n## ")[0]
# Of the real commands: what has another name, or none, with virtual devices.
REAL = {"dvxplorer": "virtual", "/dev/ttyUSB0": "virtual"}
MADE = ("hardware.json", "rest.recording.h5", "press.recording.h5", "gel.json", "first.recording.h5")


def commands(text: str) -> list[list[str]]:
    """The command lines of a text, as words."""
    return [shlex.split(line) for line in text.replace("\\\n", " ").splitlines() if line.strip().startswith("evetac ")]


def shown_with_real_devices() -> list[list[str]]:
    """The indented commands, which no test can run."""
    return commands("\n".join(re.findall(r"^    (.+)$", PAGE, re.MULTILINE)))


def test_it_stays_short() -> None:
    """Assert that it is short, and moves nothing real without --arm."""
    assert len(PAGE.splitlines()) <= 105
    real = shown_with_real_devices()
    moving = [words for words in real if "/dev/ttyUSB0" in words]
    assert len(real) == 8 and len(moving) == 4
    assert all("--arm" in words or "--dry-run" in words for words in moving)


def test_real_commands_are_tried_with_virtual_devices() -> None:
    """Assert that each command and flag of a real device is among those of the virtual ones, but for consent."""
    real = shown_with_real_devices()
    tried = [words for block in first_hour.blocks(PAGE) for words in commands(block.code)]
    for words in real:
        alike = [one for one in tried if one[1] == words[1]]
        flags = {REAL.get(word, word) for word in words if word.startswith("-") or word in REAL}
        flags -= {"--arm", "--dry-run", "--preview"}
        assert any(flags <= set(one) for one in alike), words


@pytest.mark.slow  # minutes: devices are virtual in real time
def test_the_page_comes_out_as_written(tmp_path: Path) -> None:
    """Assert that a newcomer's commands succeed one after the other, and leave what the page says to send."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    code, printed = first_hour.run(first_hour.blocks(PAGE), tmp_path, {**os.environ, "PATH": path})
    assert code == 0, printed[-1]
    assert [name for name in (*MADE, "likeness.report.h5") if not (tmp_path / name).is_file()] == []
    assert len(list((tmp_path / "slips").glob("*.labels.h5"))) == 2
    assert "all as expected; 18 steps" in printed[0]
