"""scripts/attack/other_user.py: that it sees what it would reach, and says so where it may not become other users."""

import json
import os
import pickle
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ATTACK = Path(__file__).resolve().parents[2] / "scripts" / "attack"
sys.path.insert(0, str(ATTACK))
import other_user  # noqa: E402
import tries_as_other_user as tries  # noqa: E402


def ended(name: str, arguments: dict[str, Any]) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-P", str(ATTACK / "tries_as_other_user.py"), name, json.dumps(arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_who_may_not_become_others_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert exit code 2, and that nothing was tried, for a user without rights, and where users cannot be changed."""
    monkeypatch.setattr(sys, "argv", ["other_user.py", "--only", "devices"])
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert other_user.main() == 2
    assert "needs root" in capsys.readouterr().err

    def refuse(*words: Any, **more: Any) -> Any:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(other_user, "running", lambda: 0)
    monkeypatch.setattr(subprocess, "run", refuse)
    assert other_user.main() == 2
    assert "may not become another user" in capsys.readouterr().err


def test_one_that_is_reached_is_a_row_and_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Assert a row for each try, as text and as JSON, and that one that was reached among many makes the exit code."""

    def door(stage: Any) -> Iterator[dict[str, Any]]:
        yield {"tried": "the front", "came_of_it": "shut", "reached": False}
        yield {"tried": "the back", "came_of_it": "open", "reached": True}

    monkeypatch.setattr(other_user, "why_not", lambda python: "")
    monkeypatch.setattr(other_user, "Stage", lambda *where: None)
    monkeypatch.setattr(other_user, "DOORS", {"house": door})
    monkeypatch.setattr(sys, "argv", ["other_user.py", "--json"])
    assert other_user.main() == 1
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(row["door"], row["tried"], row["reached"]) for row in rows] == [
        ("house", "the front", False),
        ("house", "the back", True),
    ]
    monkeypatch.setattr(sys, "argv", ["other_user.py"])
    assert other_user.main() == 1
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["held", "REACHED"]


@pytest.mark.skipif(os.geteuid() != 0, reason="needs rights of its own")
def test_with_rights_nothing_is_tried() -> None:
    """Assert that tries by somebody who has rights, which would prove nothing, are refused."""
    done = ended("files", {"owner": 0, "folder": "/", "seconds": 0.0})
    assert done.returncode == 1 and "without rights" in done.stderr


def test_what_is_open_is_seen(tmp_path: Path) -> None:
    """Assert that files and folders that can be taken are called reached, each by what was done, and others not."""
    (tmp_path / "open").write_text("secret")
    taken = {one["tried"].split()[-1]: one["reached"] for one in tries._takes(tmp_path / "open")}
    assert taken == {"read": True, "write": True, "rename": True}
    (tmp_path / "folder").mkdir()
    taken = {one["tried"].split()[-1]: one["reached"] for one in tries._takes(tmp_path / "folder")}
    assert taken == {"list": True, "add": True, "rename": True}
    assert not any(one["reached"] for one in tries._takes(tmp_path / "none"))
    tried = tries.summed("all", [tries.row("a", "no", reached=False), tries.row("b", "done", reached=True)])
    assert tried["reached"] and "b" in tried["came_of_it"] and "2 tried" in tried["came_of_it"]
    assert not tries.summed("all", [tries.row("a", "no", reached=False)])["reached"]


def test_a_trap_is_one(tmp_path: Path) -> None:
    """Assert that what is laid as a kernel runs where it is unpickled, and says as whom."""
    mark = tmp_path / "mark"
    pickle.loads(pickle.dumps(tries.Mark(str(mark))))
    assert mark.read_text() == str(os.geteuid())


def test_ports_and_arguments_are_seen() -> None:
    """Assert that ports at which a user's programs listen, and their arguments, are found as everybody can."""
    me = os.geteuid()
    with socket.create_server(("127.0.0.1", 0)) as listening:
        assert listening.getsockname()[1] in tries.listening(me)
        assert listening.getsockname()[1] not in tries.listening(other_user.OTHER)
    assert any("pytest" in line for line in tries.command_lines(me))


def test_links_are_laid_under_the_names_of_this_edition(tmp_path: Path) -> None:
    """Assert that the names that are guessed are those that were written under once, but for what is random now."""
    from evetac_cli.store.hdf5 import disk

    name = disk.temporary_name(tmp_path / "a.tracks.h5").name
    guessed = f".a.tracks.h5.{tries.platform.node()}.{os.getpid()}-{disk._started(os.getpid())}"
    assert name.startswith(guessed + ".") and name != f"{guessed}.tmp"
