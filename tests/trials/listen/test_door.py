"""The door: whoever has the token is answered; nobody else gets anything, and nobody keeps another out."""

import json
import socket
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from typing import Any

import pytest

from evetac_cli.errors import InputError
from evetac_cli.trials.listen import door as doors
from evetac_cli.trials.listen.door import REFUSED, Door
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
def door(asked: Asked) -> Iterator[Door]:
    door = Door(asked, 0)
    yield door
    door.close()


def connected(door: Door) -> socket.socket:
    return socket.create_connection((doors.ADDRESS, door.port), timeout=PATIENCE_S)


def line(door: Door, **fields: Any) -> bytes:
    return json.dumps({"token": door.token, **fields}).encode() + b"\n"


def everything(connection: socket.socket) -> bytes:
    """All that comes until the other side closes the connection."""
    parts = []
    try:
        while part := connection.recv(4096):
            parts.append(part)
    except ConnectionResetError:  # it was closed before all that was sent had been read
        pass
    return b"".join(parts)


def test_each_line_has_its_answer(door: Door) -> None:
    """Assert that lines of one connection are answered in their order, however they are cut."""
    with connected(door) as connection, connection.makefile("rb") as answers:
        both = line(door, number=1) + line(door, number=2)
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
        b'{"token": null, "command": "status"}\n',
        b'["token"]\n',
        b"[" * 4000 + b"\n",
        b"\xff\xfe\n",
        b"\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    ],
)
def test_without_the_token_there_is_a_refusal_and_no_more(said: bytes, door: Door, asked: Asked) -> None:
    """Assert that such a line ends the connection, also before a line that has the token, and nobody is asked."""
    with connected(door) as connection:
        connection.sendall(said + line(door, command="start", name="a"))
        assert everything(connection) in (REFUSED, b"")
    assert asked.requests == []


def test_a_page_gets_nothing(door: Door, asked: Asked) -> None:
    """Assert that an HTTP request is refused by its first line, whatever its body holds."""
    body = line(door, command="start", name="a")
    head = f"POST / HTTP/1.1\r\nHost: 127.0.0.1:{door.port}\r\nContent-Length: {len(body)}\r\n\r\n".encode()
    with connected(door) as connection:
        connection.sendall(head + body)
        assert b"HTTP" not in everything(connection)
    assert asked.requests == []


def test_an_endless_line_is_cut_off(door: Door, asked: Asked) -> None:
    """Assert that a line has a bounded length, also of whoever has the token."""
    with connected(door) as connection:
        connection.sendall(line(door, text="x" * doors.MOST_BYTES))
        assert everything(connection) in (REFUSED, b"")
    assert asked.requests == []


def test_who_says_nothing_is_sent_away(asked: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a silent connection is closed, one that has shown the token is not."""
    monkeypatch.setattr(doors, "STRANGER_S", 0.2)
    door = Door(asked, 0)
    try:
        with connected(door) as known, connected(door) as stranger, known.makefile("rb") as answers:
            known.sendall(line(door, number=1))
            answers.readline()
            assert everything(stranger) == b""
            known.sendall(line(door, number=2))
            assert json.loads(answers.readline())["number"] == 2
    finally:
        door.close()


def test_many_silent_connections_keep_nobody_out(door: Door) -> None:
    """Assert that the oldest of too many strangers make room, and that whoever has the token keeps the connection."""
    with connected(door) as known, known.makefile("rb") as answers:
        known.sendall(line(door, number=0))
        answers.readline()
        strangers = [connected(door) for _ in range(2 * doors.MOST_STRANGERS)]
        with connected(door) as another, another.makefile("rb") as others:
            another.sendall(line(door, number=1))
            assert json.loads(others.readline())["number"] == 1
        known.sendall(line(door, number=2))
        assert json.loads(answers.readline())["number"] == 2
        for stranger in strangers:
            stranger.close()


def test_who_waits_is_answered_before_the_door_closes(asked: Asked) -> None:
    """Assert that an answer that is there when the door closes still comes, and that the thread ends."""
    door = Door(asked, 0)
    with connected(door) as connection:
        connection.sendall(line(door, command="later"))
        assert until(lambda: asked.later)
        asked.later[0].set_result({"ok": True})
        door.close()
        assert everything(connection) == b'{"ok": true}\n'
    assert not any(thread.name == "listen" for thread in threading.enumerate())


def test_a_port_that_is_taken_is_said(door: Door, asked: Asked) -> None:
    """Assert that a port of somebody else's is an error in words, and a free one is taken."""
    with pytest.raises(InputError, match=rf"--listen-port {door.port}: cannot listen"):
        Door(asked, door.port)


def test_tokens_are_long_and_differ(door: Door, asked: Asked) -> None:
    """Assert that no two doors have the same token."""
    other = Door(asked, 0)
    other.close()
    assert len(door.token) >= 32
    assert door.token != other.token
