"""What a client of a live view is sent, and what its button does."""

import http.client
import json
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from evetac_cli.trials.live_view.process import PictureServer
from tests.patience import PATIENCE_S, until


class Client:
    """A program in the place of a page."""

    def __init__(self, url: str) -> None:
        self._host, self._token = url.removeprefix("http://").strip("/").split("/")
        self._known = ""

    def ask(self, name: str, sent: bytes | None = None) -> bytes:
        """The answer to a request, a POST if something is sent."""
        connection = http.client.HTTPConnection(self._host, timeout=PATIENCE_S)
        origin = {"Origin": f"http://{self._host}"}
        try:
            connection.request("GET" if sent is None else "POST", f"/{self._token}/{name}", sent, origin)
            response = connection.getresponse()
            assert response.status == 200
            return response.read()
        finally:
            connection.close()

    def next(self) -> tuple[dict[str, Any], bytes]:
        """The next news and picture."""
        message = self.ask(f"pictures?known={self._known}")
        size = int.from_bytes(message[:4], "little")
        news: dict[str, Any] = json.loads(message[4 : 4 + size])
        self._known = str(news.get("version", ""))
        return news, message[4 + size :]

    def let_go(self) -> None:
        """Press the button."""
        self.ask("let-go", b"{}")


class Served:
    """A server, and a thread that sends a picture to whoever waits."""

    def __init__(self, image: bytes = b"image") -> None:
        self.let_go = 0
        self.image = image
        self.server = PictureServer(self._let_go)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _let_go(self) -> None:
        self.let_go += 1

    def _serve(self) -> None:
        number = 0
        while not self._stop.is_set():
            number += 1
            if self.server.is_asked:
                self.server.send({"number": number}, self.image, lambda: {"about": "known"}, 1)
            time.sleep(0.005)
        self.server.end("it is over")

    def close(self) -> None:
        """End it."""
        self._stop.set()
        self._thread.join(PATIENCE_S)


@pytest.fixture
def served() -> Iterator[Served]:
    served = Served()
    yield served
    served.close()


def test_a_picture_for_every_request_and_no_more(served: Served) -> None:
    """Assert that nothing is made without a request, what is known is told once, and each client hears the end."""
    assert not served.server.is_asked
    client, other = Client(served.server.url), Client(served.server.url)
    first, image = client.next()
    assert (first["about"], image) == ("known", b"image")
    second, _ = client.next()
    assert second["number"] > first["number"]
    assert "about" not in second
    assert other.next()[0]["about"] == "known"
    served._stop.set()
    assert until(lambda: served.server._ended)
    assert client.next() == other.next() == ({"ended": "it is over"}, b"")


def test_who_waits_hears_the_end() -> None:
    """Assert that a client that waits for a picture when there are no more is told why."""
    server = PictureServer(lambda: None)
    with ThreadPoolExecutor() as pool:
        waiting = pool.submit(Client(server.url).next)
        assert until(lambda: server.is_asked)
        server.end("interrupted")
        assert waiting.result(PATIENCE_S) == ({"ended": "interrupted"}, b"")


def test_the_button_lets_go(served: Served) -> None:
    """Assert that it does so at once, and each time it is pressed."""
    Client(served.server.url).let_go()
    assert served.let_go == 1
