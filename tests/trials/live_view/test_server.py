"""Who gets to see the page, and who may press its button."""

import asyncio
import gc
import http.client
import json
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from tests.patience import PATIENCE_S, until

pytest.importorskip("tornado")
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

from evetac_cli import page_server
from evetac_cli.trials.live_view.server import CONTENT, MOST_CLIENTS, PageServer


class Served:
    """A server in a thread of its own, whose loop sends a picture to whoever waits."""

    def __init__(self, image: bytes = b"image") -> None:
        self.let_go = 0
        self.image = image
        self.uncaught: list[dict[str, Any]] = []  # what the loop would print as a traceback
        self.loop = asyncio.new_event_loop()
        self._started = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        assert self._started.wait(PATIENCE_S)

    def _run(self) -> None:
        asyncio.set_event_loop(self.loop)
        self.loop.run_until_complete(self._serve())

    async def _serve(self) -> None:
        def let_go() -> None:
            self.let_go += 1

        self.loop.set_exception_handler(lambda loop, about: self.uncaught.append(about))
        self.server = PageServer(let_go)
        self.stop = asyncio.Event()
        self._started.set()
        number = 0
        while not self.stop.is_set():
            number += 1
            if self.server.is_asked:
                self.server.send({"number": number}, self.image, lambda: {"about": "known"}, 1)
            await asyncio.sleep(0.005)
        await self.server.end({"ended": "it is over"})

    def close(self) -> None:
        self.loop.call_soon_threadsafe(self.stop.set)
        self._thread.join(PATIENCE_S)
        self.loop.close()


@pytest.fixture
def served() -> Iterator[Served]:
    served = Served()
    try:
        yield served
    finally:
        served.close()
        gc.collect()
        assert served.uncaught == []


def answer(served: Served, path: str, host: str | None = None, method: str = "GET", **headers: str) -> tuple[int, str]:
    """Status and body of a request."""
    connection = http.client.HTTPConnection("127.0.0.1", served.server.port, timeout=PATIENCE_S)
    connection.request(method, path, headers={"Host": host or f"127.0.0.1:{served.server.port}", **headers})
    response = connection.getresponse()
    body = response.read().decode()
    connection.close()
    return response.status, body


def connect(served: Served, token: str, **headers: str) -> Any:
    """A websocket with these headers; call within a running loop."""
    url = f"ws://127.0.0.1:{served.server.port}/{token}/pictures"
    return websocket_connect(HTTPRequest(url, headers=headers, request_timeout=PATIENCE_S))


async def close(socket_: Any) -> None:
    """Close a websocket, and wait until the other side has closed it too."""
    socket_.close()
    while await asyncio.wait_for(socket_.read_message(), PATIENCE_S) is not None:
        pass


def news_of(message: bytes) -> tuple[dict[str, Any], bytes]:
    size = int.from_bytes(message[:4], "little")
    return json.loads(message[4 : 4 + size]), message[4 + size :]


def test_only_the_token_opens_the_page(served: Served) -> None:
    """Assert that page and files come by the token, and that no other address says anything, POST included."""
    token = served.server.token
    assert len(token) >= 32
    for name in CONTENT:
        status, body = answer(served, f"/{token}/{name}")
        assert status == 200
        assert body
    wrong = token[:-1] + ("A" if token[-1] != "A" else "B")
    for path in (
        "/",
        f"/{wrong}/",
        f"/{wrong}/page.js",
        f"/{wrong}/pictures",
        f"/x/{token}/",
        "//",
        "/?token=" + token,
    ):
        assert answer(served, path) == (403, "403\n"), path
    assert answer(served, f"/{token}/../../../etc/passwd")[0] == 403
    assert answer(served, f"/{token}/other")[0] == 404
    assert answer(served, f"/{token}/", method="POST")[0] in (403, 405)


def test_another_name_for_this_computer_is_refused(served: Served) -> None:
    """Assert that a site whose name suddenly stands for 127.0.0.1 gets nothing, token or not."""
    page, port = f"/{served.server.token}/", served.server.port
    for host in (
        f"evil.example:{port}",
        "evil.example",
        f"127.0.0.1.evil.example:{port}",
        f"localhost.evil:{port}",
        ":",
    ):
        assert answer(served, page, host)[0] in (400, 403), host
        upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
        status, _ = answer(served, page + "pictures", host, **upgrade, **{"Sec-WebSocket-Key": "eA==" * 6})
        assert status in (400, 403), host
    for host in (f"localhost:{port}", "127.0.0.1:9999", "localhost:8080", f"[::1]:{port}"):  # ssh -L listens at others
        assert answer(served, page, host)[0] == 200, host


def test_it_listens_on_127_0_0_1_alone(served: Served) -> None:
    """Assert that no other address of this computer answers."""
    with socket.create_connection(("127.0.0.1", served.server.port), PATIENCE_S):
        pass
    for other in ("127.0.0.2", "::1"):
        with pytest.raises(OSError), socket.create_connection((other, served.server.port), 1.0):
            pass


def test_the_page_loads_nothing_from_elsewhere(served: Served) -> None:
    """Assert that neither the files nor the policy know another address, and that no site may frame the page."""
    bodies = [answer(served, f"/{served.server.token}/{name}")[1] for name in CONTENT]
    assert not any(part in body for body in bodies for part in ("http://", "https://", "//cdn", "@import"))
    connection = http.client.HTTPConnection("127.0.0.1", served.server.port, timeout=PATIENCE_S)
    connection.request("GET", f"/{served.server.token}/")
    headers = connection.getresponse().headers
    connection.close()
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert f"connect-src 'self' ws://127.0.0.1:{served.server.port};" in policy
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["Referrer-Policy"] == "no-referrer"


def test_the_button_needs_the_token_and_the_page_itself(served: Served) -> None:
    """Assert that only a websocket with the token, and of no other site's page, can let go; other words do nothing."""
    own = f"http://127.0.0.1:{served.server.port}"

    async def press(token: str, *words: str, **headers: str) -> None:
        socket_ = await connect(served, token, **headers)
        for word in words:
            await socket_.write_message(word)
        await socket_.write_message("next")
        assert await asyncio.wait_for(socket_.read_message(), PATIENCE_S)
        await close(socket_)

    for token, headers in (
        ("x" * 32, {"Origin": own}),
        ("", {}),
        (served.server.token, {"Origin": "http://evil.example"}),
        (served.server.token, {"Origin": "http://127.0.0.1:1"}),
        (served.server.token, {"Origin": "null"}),
    ):
        with pytest.raises(HTTPClientError, match="403"):
            asyncio.run(press(token, "let go", **headers))
    asyncio.run(press(served.server.token, "letgo", '{"let go": true}', Origin=own))
    assert served.let_go == 0
    asyncio.run(press(served.server.token, "let go", Origin=own))
    assert served.let_go == 1


def test_a_picture_for_every_request_and_no_more(served: Served) -> None:
    """Assert that a client that asks for nothing gets nothing, and what is known is told once; then why it ended."""

    async def watch() -> None:
        socket_ = await connect(served, served.server.token)
        waiting = asyncio.ensure_future(socket_.read_message())
        await asyncio.sleep(0.05)
        assert not waiting.done()
        await socket_.write_message("next")
        first, image = news_of(await asyncio.wait_for(waiting, PATIENCE_S))
        assert image == b"image"
        assert first["about"] == "known"
        await socket_.write_message("next")
        second, _ = news_of(await asyncio.wait_for(socket_.read_message(), PATIENCE_S))
        assert second["number"] > first["number"]
        assert "about" not in second
        served.loop.call_soon_threadsafe(served.stop.set)
        last, image = news_of(await asyncio.wait_for(socket_.read_message(), PATIENCE_S))
        assert last == {"ended": "it is over"}
        assert image == b""
        assert await asyncio.wait_for(socket_.read_message(), PATIENCE_S) is None  # closed
        socket_.close()

    asyncio.run(watch())


def test_no_more_than_a_few_look_at_once(served: Served) -> None:
    """Assert that one client more than there may be is sent away."""

    async def watch() -> None:
        sockets = [await connect(served, served.server.token) for _ in range(MOST_CLIENTS)]
        for each in sockets:  # all are in
            await each.write_message("next")
            assert await asyncio.wait_for(each.read_message(), PATIENCE_S)
        further = await connect(served, served.server.token)
        assert await asyncio.wait_for(further.read_message(), PATIENCE_S) is None
        further.close()
        for each in sockets:
            await close(each)

    asyncio.run(watch())


# --- whoever is slow, silent or gone ----------------------------------------------------------------------------------


def plain_socket(served: Served) -> socket.socket:
    """A connection that has said nothing yet."""
    return socket.create_connection(("127.0.0.1", served.server.port), PATIENCE_S)


def is_closed(connection: socket.socket) -> bool:
    """Wait until the server closes a connection, whatever it says before."""
    connection.settimeout(PATIENCE_S)
    try:
        while connection.recv(1 << 16):
            pass
    except ConnectionResetError:
        pass
    connection.close()
    return True


def unread_websocket(served: Served) -> socket.socket:
    """A client that asks for a picture and takes none of it."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.settimeout(PATIENCE_S)
    connection.connect(("127.0.0.1", served.server.port))
    head = f"GET /{served.server.token}/pictures HTTP/1.1\r\nHost: 127.0.0.1:{served.server.port}\r\n"
    head += "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    connection.sendall(f"{head}Sec-WebSocket-Key: {'eA==' * 6}\r\n\r\n".encode())
    answered = b""
    while not answered.endswith(b"\r\n\r\n"):
        answered += connection.recv(1)
    word = b"next"
    connection.sendall(bytes([0x81, 0x80 | len(word)]) + bytes(4) + word)  # masked by zeros
    return connection


@pytest.mark.parametrize("end", ["reset", "shut", "close frame"])
def test_a_client_that_goes_while_a_picture_is_on_its_way(end: str) -> None:
    """Assert that nothing comes up on the terminal, however the connection ends, and that others are served."""
    served = Served(bytes(8 << 20))  # more than the system takes for a client that does not read
    try:
        connection = unread_websocket(served)
        assert until(lambda: len(served.server.clients) == 1 and not served.server.is_asked)
        connection.recv(1 << 10)
        if end == "reset":
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        elif end == "shut":
            connection.shutdown(socket.SHUT_WR)
        else:
            connection.sendall(bytes([0x88, 0x80]) + bytes(4))
        connection.close()
        assert until(lambda: not served.server.clients)
        assert answer(served, f"/{served.server.token}/")[0] == 200
    finally:
        served.close()
    gc.collect()
    assert served.uncaught == []


SILENT = {
    "nothing": b"",
    "half a line": b"GET / HT",
    "headers without an end": b"GET /x/ HTTP/1.1\r\nHost: 127.0.0.1\r\n",
    "a body that does not come": b"GET /x/ HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 100\r\n\r\n",
    "a request without the token": b"GET /x/ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    "a websocket without the token": b"GET /x/pictures HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n"
    b"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: eA==\r\n\r\n",
}


@pytest.mark.parametrize("said", SILENT.values(), ids=SILENT.keys())
def test_a_connection_without_a_request_is_closed(said: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that whoever has not asked for something after a while, and with the token, is not held."""
    monkeypatch.setattr(page_server, "REQUEST_S", 0.1)
    served = Served()
    try:
        connection = plain_socket(served)
        connection.sendall(said)
        assert is_closed(connection)
        assert until(lambda: not served.server.waiting)
    finally:
        served.close()
    assert served.uncaught == []


def test_a_slow_trickle_is_no_request(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that bytes that go on coming do not hold a connection for longer."""
    monkeypatch.setattr(page_server, "REQUEST_S", 0.3)
    served = Served()
    try:
        connection = plain_socket(served)
        connection.sendall(b"GET / HTTP/1.1\r\n")
        with pytest.raises(OSError):  # the other end closes it
            end_s = time.monotonic() + PATIENCE_S
            while time.monotonic() < end_s:
                connection.sendall(b"X-A: b\r\n")
                time.sleep(0.02)
        connection.close()
    finally:
        served.close()


def test_who_waits_in_hundreds_shuts_nobody_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the page comes however many connections say nothing, and that the oldest of them go for new ones."""
    monkeypatch.setattr(page_server, "MOST_WAITING", 130)
    monkeypatch.setattr(page_server, "REQUEST_S", 3600.0)  # on a busy machine, too, only their number ends them
    served = Served()
    with ExitStack() as opened:
        opened.callback(served.close)

        def silent(count: int) -> list[socket.socket]:
            return [opened.enter_context(plain_socket(served)) for _ in range(count)]

        def open_page() -> None:
            assert answer(served, f"/{served.server.token}/")[0] == 200

        first = silent(2 * page_server.MOST_WAITING)
        assert until(lambda: len(served.server.waiting) == page_server.MOST_WAITING)
        open_page()

        async def look_on() -> None:
            socket_ = await connect(served, served.server.token)
            silent(2 * page_server.MOST_WAITING)
            await socket_.write_message("next")
            assert await asyncio.wait_for(socket_.read_message(), PATIENCE_S)  # who looks is never closed for others
            await close(socket_)

        asyncio.run(look_on())
        assert all(map(is_closed, first))
        open_page()
    assert served.uncaught == []
