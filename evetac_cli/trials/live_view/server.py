"""Serve the page of a live view, and send a picture to each client that requests the next one.

A client gets a picture only after it has drawn the previous one and requests the next. So a slow browser, or a hidden
tab, gets fewer pictures, and nothing piles up. The page is `page.html` with `page.js`, `page.css`, and the touch map
drawing of the `view` page; it loads nothing else. local_server.py controls access.
"""

import json
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from evetac_cli.local_server import PageServer
from evetac_cli.resources import DATA

HERE = Path(__file__).parent
FILES = (HERE / "page.html", HERE / "page.js", HERE / "page.css", DATA / "touch_map.js")
LAST_S = 0.5  # time for clients that draw a picture to request the last message


class PictureServer(PageServer):
    """The page at `url` and its clients."""

    def __init__(self, let_go: Callable[[], None]) -> None:
        """Begin to listen; let_go: called when the user presses the button."""

        def pressed(sent: dict[str, Any]) -> dict[str, Any]:
            let_go()
            return {}

        self._lock = threading.Lock()
        self._waiting: list[tuple[str, Future[bytes]]] = []  # the version that a client knows, and its answer
        self._ended = b""
        super().__init__(FILES, {("GET", "pictures"): self._picture, ("POST", "let-go"): pressed})

    def _picture(self, sent: dict[str, Any]) -> bytes:
        """Return the next picture; sent: the version of the description that the client knows."""
        picture: Future[bytes] = Future()
        with self._lock:
            if self._ended:
                return self._ended
            self._waiting.append((sent.get("known", ""), picture))
        return picture.result()

    @property
    def is_asked(self) -> bool:
        """Whether a client waits for a picture."""
        return bool(self._waiting)

    def send(
        self, news: Mapping[str, Any], image: bytes, description: Callable[[], Mapping[str, Any]], version: int
    ) -> None:
        """Send a picture to every client that waits for one.

        image: one byte per pixel; description: data that a client needs before its first picture, and again when its
        version changes.
        """
        with self._lock:
            waiting, self._waiting = self._waiting, []
        for known, picture in waiting:
            more = {} if known == str(version) else description()
            picture.set_result(_message({**news, **more, "version": version}, image))

    def end(self, why: str) -> None:
        """Send every client the reason for the end, and close."""
        with self._lock:
            self._ended = _message({"ended": why}, b"")
        for _, picture in self._waiting:
            picture.set_result(self._ended)
        time.sleep(LAST_S)
        self.close()


def _message(news: Mapping[str, Any], image: bytes) -> bytes:
    """Return the news as JSON, preceded by its length and followed by the picture."""
    text = json.dumps(news, allow_nan=False, separators=(",", ":")).encode()
    return len(text).to_bytes(4, "little") + text + image
