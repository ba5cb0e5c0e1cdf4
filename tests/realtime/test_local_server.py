"""Who is answered by a server on this computer, and who is not."""

import http.client
import json
import socket
import struct
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.realtime import local_server
from evetac_cli.realtime.local_server import MOST_BYTES, MOST_CONNECTIONS, PageServer, announce
from evetac_cli.stages.label_review import server as review
from evetac_cli.trials.live_view import process as live_view
from tests.patience import PATIENCE_S, until


@pytest.fixture
def took() -> list[dict[str, Any]]:
    """What the server of a test was sent."""
    return []


@pytest.fixture
def server(tmp_path: Path, took: list[dict[str, Any]]) -> Iterator[PageServer]:
    """A page of two files, whose only other requests are `POST press` and `GET much`."""
    files = tmp_path / "page.html", tmp_path / "page.js"
    for file in files:
        file.write_text(file.name)
    answers = {("POST", "press"): took.append, ("GET", "much"): lambda sent: bytes(8 << 20)}
    server = PageServer(files, answers)
    yield server
    server.close()


def ask(server: PageServer, path: str, sent: Any = None, **headers: str) -> tuple[int, bytes, Any]:
    """Status, body and headers of the answer; a POST from the page itself if something is sent."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE_S)
    own = {} if sent is None else {"Origin": f"http://127.0.0.1:{server.port}"}
    body = sent if sent is None or isinstance(sent, bytes) else json.dumps(sent)
    connection.request("GET" if sent is None else "POST", path, body, {**own, **headers})
    response = connection.getresponse()
    answer = response.status, response.read(), response.headers
    connection.close()
    return answer


def connected(server: PageServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.port), PATIENCE_S)


def test_only_the_token_opens_the_page(server: PageServer, took: list[dict[str, Any]]) -> None:
    """Assert that page, files and requests come by the token, and that no other address says anything."""
    token = server.token
    assert len(token) >= 32
    assert server.url == f"http://127.0.0.1:{server.port}/{token}/"
    assert ask(server, f"/{token}/")[:2] == (200, b"page.html")
    assert ask(server, f"/{token}/page.js")[:2] == (200, b"page.js")
    assert ask(server, f"/{token}/press", {"a": 1})[:2] == (200, b"null")
    wrong = token[:-1] + ("A" if token[-1] != "A" else "B")
    for path in ("/", f"/{wrong}/", f"/{wrong}/page.js", f"/x/{token}/", "/%C3%A9/", f"/?token={token}"):
        status, body, _ = ask(server, path)
        assert (status, b"page" in body) == (403, False), path
    assert ask(server, f"/{wrong}/press", {})[0] == 403
    for path in ("other", "press", "../../../etc/passwd", "page.html"):
        assert ask(server, f"/{token}/{path}")[0] == 404
    assert ask(server, f"/{token}/", {})[0] == 404
    assert took == [{"a": 1}]


def test_another_name_for_this_computer_is_refused(server: PageServer, took: list[dict[str, Any]]) -> None:
    """Assert that a site whose name suddenly stands for 127.0.0.1 gets nothing, token or not."""
    page, port = f"/{server.token}/", server.port
    for host in (f"evil.example:{port}", "evil.example", f"127.0.0.1.evil.example:{port}", "localhost.evil:1", ":", ""):
        assert ask(server, page, Host=host)[0] == 403, host
        assert ask(server, page + "press", {}, Host=host, Origin=f"http://{host}")[0] == 403, host
    for host in (f"localhost:{port}", "127.0.0.1:9999", f"[::1]:{port}"):  # ssh -L listens at others
        assert ask(server, page, Host=host)[0] == 200, host
    assert took == []


def test_only_the_page_itself_may_change_something(server: PageServer, took: list[dict[str, Any]]) -> None:
    """Assert that another Origin, none, and what is no small JSON object are refused."""
    press, own = f"/{server.token}/press", {"Origin": f"http://127.0.0.1:{server.port}"}
    for origin in ("http://evil.example", "http://127.0.0.1:1", "null", ""):
        assert ask(server, press, {}, Origin=origin)[0] == 403, origin
    for sent in (b"", b"[]", b"{", b"\xff", b"[" * MOST_BYTES, b'{"a": "%s"}' % (b"x" * MOST_BYTES)):
        assert ask(server, press, sent)[0] == 400, sent[:20]
    for length in ("-1", "x", "1e3"):
        assert ask(server, press, b"", **{"Content-Length": length})[0] == 400, length
    assert took == []
    assert ask(server, press, {}, **own)[0] == 200


def test_it_listens_on_127_0_0_1_alone(server: PageServer) -> None:
    """Assert that no other address of this computer answers."""
    connected(server).close()
    for other in ("127.0.0.2", "::1"):
        with pytest.raises(OSError), socket.create_connection((other, server.port), 1.0):
            pass


def test_the_page_loads_nothing_from_elsewhere(server: PageServer) -> None:
    """Assert that no page of evetac knows another address, and that no site may frame one, also of a refusal."""
    for file in (*live_view.FILES, *review.FILES):
        assert not any(part in file.read_text() for part in ("http://", "https://", "//cdn", "@import"))
    for path in (f"/{server.token}/", "/"):
        headers = ask(server, path)[2]
        assert {"default-src 'none'", "connect-src 'self'", "frame-ancestors 'none'"} <= set(
            map(str.strip, headers["Content-Security-Policy"].split(";"))
        )
        assert headers["Referrer-Policy"] == "no-referrer"


def test_a_browser_is_opened_with_an_address_that_works_once(
    server: PageServer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Assert that its argument has no token, leads to the page, and then to nothing; and that a terminal opens none."""
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SSH_CONNECTION"):
        monkeypatch.delenv(name, raising=False)
    announce(server.url, server.url_once, "live view")
    assert opened == []
    monkeypatch.setenv("DISPLAY", ":0")
    announce(server.url, server.url_once, "live view")
    assert capsys.readouterr().err == 2 * f"live view: {server.url}\n"
    (address,) = opened
    assert server.token not in address
    path = address.removeprefix(f"http://127.0.0.1:{server.port}")
    status, _, headers = ask(server, path)
    assert (status, headers["Location"]) == (302, f"/{server.token}/")
    assert [ask(server, path)[0], ask(server, "//")[0]] == [403, 403]


def test_the_number_of_connections_has_a_limit(server: PageServer) -> None:
    """Assert that one too many is answered with 503, and that there is room again."""
    with ExitStack() as opened:
        silent = [opened.enter_context(connected(server)) for _ in range(MOST_CONNECTIONS)]
        assert until(lambda: len(server._open) == MOST_CONNECTIONS)
        assert opened.enter_context(connected(server)).recv(100).startswith(b"HTTP/1.0 503")
        silent[0].close()
        assert until(lambda: len(server._open) < MOST_CONNECTIONS)
        assert ask(server, f"/{server.token}/")[0] == 200


@pytest.mark.parametrize("said", [b"", b"GET / HT", b"GET /x/ HTTP/1.0\r\nHost: 127.0.0.1\r\n"])
def test_who_says_nothing_is_sent_away(said: bytes, server: PageServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a connection that sends no whole request is closed."""
    monkeypatch.setattr(local_server._PageRequest, "timeout", 0.1)
    with connected(server) as connection:
        connection.sendall(said)
        connection.settimeout(PATIENCE_S)
        assert connection.recv(100) == b""
    assert until(lambda: not server._open)


@pytest.mark.parametrize("reset", [True, False])
def test_a_client_that_goes_during_an_answer_is_no_error(
    reset: bool, server: PageServer, capsys: pytest.CaptureFixture[str]
) -> None:
    """Assert that nothing comes up on the terminal, and that others are served."""
    connection = connected(server)
    connection.sendall(f"GET /{server.token}/much HTTP/1.0\r\nHost: 127.0.0.1\r\n\r\n".encode())
    assert connection.recv(100)
    if reset:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()
    assert until(lambda: not server._open)
    assert ask(server, f"/{server.token}/")[0] == 200
    assert capsys.readouterr().err == ""
