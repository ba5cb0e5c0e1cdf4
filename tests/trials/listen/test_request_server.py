"""The server: whoever has the token, which is in a file for its user alone, is answered; nobody else gets anything."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.errors import InputError
from evetac_cli.realtime.local_server import ADDRESS, MOST_BYTES
from evetac_cli.resources import PACKAGE
from evetac_cli.trials.listen.request_server import REFUSED, RequestServer, address_file
from tests.patience import PATIENCE_S, until


class Asked:
    """Takes requests, and answers them at once, those for later when it is told to."""

    def __init__(self) -> None:
        self.requests: list[Mapping[str, Any]] = []
        self.later: list[Future[dict[str, Any]]] = []

    def __call__(self, request: Mapping[str, Any]) -> "Future[dict[str, Any]]":
        self.requests.append(request)
        answer: Future[dict[str, Any]] = Future()
        if request.get("command") == "later":
            self.later.append(answer)
        else:
            answer.set_result({"ok": True, "number": request.get("number")})
        return answer


@pytest.fixture
def asked() -> Asked:
    return Asked()


@pytest.fixture
def server(asked: Asked) -> Iterator[RequestServer]:
    server = RequestServer(asked, 0)
    yield server
    server.close()


def connected(server: RequestServer) -> socket.socket:
    return socket.create_connection((ADDRESS, server.port), timeout=PATIENCE_S)


def line(server: RequestServer, **fields: Any) -> bytes:
    return json.dumps({"token": server.token, **fields}).encode() + b"\n"


def refusal(why: str) -> bytes:
    return json.dumps({"ok": False, "error": why}).encode() + b"\n"


def everything(connection: socket.socket) -> bytes:
    """All that comes until the other side closes the connection."""
    parts = []
    try:
        while part := connection.recv(4096):
            parts.append(part)
    except ConnectionResetError:  # it was closed before all that was sent had been read
        pass
    return b"".join(parts)


def test_each_line_has_its_answer(server: RequestServer) -> None:
    """Assert that lines of one connection are answered in their order, however they are cut."""
    with connected(server) as connection, connection.makefile("rb") as answers:
        both = line(server, number=1) + line(server, number=2)
        connection.sendall(both[:20])
        connection.sendall(both[20:])
        assert [json.loads(answers.readline())["number"] for _ in range(2)] == [1, 2]


@pytest.mark.parametrize(
    "said",
    [
        b'{"command": "status"}\n',
        b'{"token": "x", "command": "status"}\n',
        b'{"token": "", "command": "status"}\n',
        '{"token": "ä", "command": "status"}\n'.encode(),
        b'{"token": "\\ud800", "command": "status"}\n',
        b'{"token": null, "command": "status"}\n',
        b'["token"]\n',
        b"[" * 4000 + b"\n",
        b"\xff\xfe\n",
        b"\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    ],
)
def test_without_the_token_there_is_a_refusal_and_no_more(said: bytes, server: RequestServer, asked: Asked) -> None:
    """Assert that such a line ends the connection, also before a line that has the token, and nobody is asked."""
    with connected(server) as connection:
        connection.sendall(said + line(server, command="start", name="a"))
        assert everything(connection) in (refusal(REFUSED), b"")
    assert asked.requests == []


def test_an_endless_line_is_cut_off(server: RequestServer, asked: Asked) -> None:
    """Assert that a line has a bounded length, also of whoever has the token."""
    with connected(server) as connection:
        connection.sendall(line(server, text="x" * MOST_BYTES))
        assert everything(connection) in (refusal(REFUSED), b"")
    assert asked.requests == []


def test_who_waits_is_answered_before_the_door_closes(asked: Asked) -> None:
    """Assert that an answer that is there when the server closes still comes, and that the thread ends."""
    server = RequestServer(asked, 0)
    with connected(server) as connection:
        connection.sendall(line(server, command="later"))
        assert until(lambda: asked.later)
        asked.later[0].set_result({"ok": True})
        server.close()
        assert everything(connection) == b'{"ok": true}\n'
    assert not any(thread.name == "local server" for thread in threading.enumerate())


def test_a_port_that_is_taken_is_said(server: RequestServer, asked: Asked) -> None:
    """Assert that a port of somebody else's is an error in words, and a free one is taken."""
    with pytest.raises(InputError, match=rf"--listen-port {server.port}: cannot listen"):
        RequestServer(asked, server.port)


def test_the_file_is_for_its_user_alone_and_goes_at_the_end(server: RequestServer, tmp_path: Path) -> None:
    """Assert one line, mode 0600 whatever the umask, nothing beside it, and nothing after it."""
    path = tmp_path / "evetac.listen"
    before = os.umask(0)
    try:
        with address_file(path, server):
            assert path.read_text() == f"127.0.0.1 {server.port} {server.token}\n"
            assert path.stat().st_mode & 0o7777 == 0o600
            assert list(tmp_path.iterdir()) == [path]
    finally:
        os.umask(before)
    assert list(tmp_path.iterdir()) == []


def test_another_that_listens_is_not_replaced(server: RequestServer, asked: Asked, tmp_path: Path) -> None:
    """Assert that a second one in the same folder is refused, and the first file stays as it is."""
    path, second = tmp_path / "evetac.listen", RequestServer(asked, 0)
    with address_file(path, server):
        with pytest.raises(InputError, match="another evetac"), address_file(path, second):
            pass
        assert path.read_text().split()[1] == str(server.port)
        assert list(tmp_path.iterdir()) == [path]
    second.close()


def test_what_a_killed_one_left_is_replaced_and_said(
    server: RequestServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Assert that the file of a process that was killed stands in nobody's way, also if the port is the same again."""
    path = tmp_path / "evetac.listen"
    code = (
        "import os, sys; from pathlib import Path;"
        "from evetac_cli.trials.listen.request_server import RequestServer, address_file;"
        " file = address_file(Path(sys.argv[1]), RequestServer(print, 0)); file.__enter__(); os.kill(os.getpid(), 9)"
    )
    killed = subprocess.run([sys.executable, "-c", code, str(path)], cwd=PACKAGE.parent, check=False)
    assert killed.returncode == -signal.SIGKILL
    for left in (path.read_text(), f"127.0.0.1 {server.port} {'a' * 32}\n", f"127.0.0.1 99999 {'a' * 32}\n"):
        path.write_text(left)
        with address_file(path, server):
            assert path.read_text().split()[2] == server.token
        assert "left by a run that was killed" in capsys.readouterr().err
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["text", "empty", "link", "folder", "pipe"])
def test_what_is_not_ours_stays(kind: str, server: RequestServer, tmp_path: Path) -> None:
    """Assert that a file that evetac did not make, a link, a folder and a pipe are refused, and untouched."""
    path, other = tmp_path / "evetac.listen", tmp_path / "other"
    other.write_text(f"127.0.0.1 1 {'a' * 32}\n")
    make: dict[str, Callable[[], object]] = {
        "text": lambda: path.write_text("my notes\n"),
        "empty": path.touch,
        "link": lambda: path.symlink_to(other),
        "folder": path.mkdir,
        "pipe": lambda: os.mkfifo(path),
    }
    make[kind]()
    before = path.lstat()
    with pytest.raises(InputError, match="not a file that evetac made"), address_file(path, server):
        pass
    assert os.path.samestat(before, path.lstat())
    assert other.read_text() == f"127.0.0.1 1 {'a' * 32}\n"
    assert sorted(tmp_path.iterdir()) == [path, other]
