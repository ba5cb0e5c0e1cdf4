"""scripts/attack/other_user.py: that it sees what it would reach, and says so where it may not become other users."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.realtime.local_server import PageServer
from evetac_cli.trials.listen.request_server import RequestServer
from scripts.attack import other_user


def test_who_may_not_become_others_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert exit code 2, and that nothing was tried, where users cannot be changed."""

    def refuse(*words: Any, **more: Any) -> Any:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(sys, "argv", ["other_user.py"])
    monkeypatch.setattr(subprocess, "run", refuse)
    assert other_user.main() == 2
    assert "nothing was tried" in capsys.readouterr().err


def test_an_answer_is_reached_and_a_refusal_is_not(tmp_path: Path) -> None:
    """Assert that a port that says anything else than a refusal, and what is done, count as reached."""
    page = tmp_path / "page.html"
    page.touch()
    asked = b"GET / HTTP/1.0\r\nHost: 127.0.0.1\r\n\r\n"
    for server in (PageServer([page], {}), RequestServer(lambda request: pytest.fail(), 0)):
        assert not other_user.refused("port", lambda port=server.port: other_user.reply_to(port, asked))["reached"]
        server.close()
    server = PageServer([page], {})
    asked = asked.replace(b"/ ", f"/{server.token}/ ".encode())
    assert other_user.refused("port", lambda: other_user.reply_to(server.port, asked))["reached"]
    server.close()
    assert other_user.refused("file", page.read_bytes)["reached"]
    assert not other_user.refused("file", (tmp_path / "none").read_bytes)["reached"]
