"""Serve the page of a live view on this computer, and send a picture to each client that requests the next one.

A client gets a picture only after it has drawn the previous one and requests the next. So a slow browser, or a hidden
tab, gets fewer pictures, and nothing piles up. The page is `page.html` with `page.js`, `page.css`, and the touch map
drawing of the `view` page; it loads nothing else. page_server.py controls access.
"""

import asyncio
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from tornado import websocket

from evetac_cli.page_server import Guarded, OwnServer
from evetac_cli.resources import DATA

HERE = Path(__file__).parent
MOST_CLIENTS = 4
LAST_S = 0.3  # time for the last messages to arrive
NEXT, LET_GO = "next", "let go"  # the only messages from a client
CONTENT: dict[str, tuple[Path, str]] = {
    "": (HERE / "page.html", "text/html"),
    "page.js": (HERE / "page.js", "text/javascript"),
    "page.css": (HERE / "page.css", "text/css"),
    "touch_map.js": (DATA / "touch_map.js", "text/javascript"),
}


class PageServer(OwnServer):
    """The page at `url` and its clients; used within a running asyncio loop."""

    def __init__(self, let_go: Callable[[], None]) -> None:
        """Begin to listen; let_go: called when the user presses the button."""
        self.let_go = let_go
        self.clients: set[_Pictures] = set()
        super().__init__(CONTENT, [(r"/([^/]*)/pictures", _Pictures, {})])

    @property
    def is_asked(self) -> bool:
        """Whether a client waits for a picture."""
        return any(client.waits for client in self.clients)

    def send(
        self, news: Mapping[str, Any], image: bytes, description: Callable[[], Mapping[str, Any]], version: int
    ) -> None:
        """Send a picture to every client that waits for one.

        image: one byte per pixel; description: data that a client needs before its first picture, and again when its
        version changes.
        """
        for client in list(self.clients):
            if client.waits:
                client.waits = False
                more = {} if client.version == version else dict(description())
                client.version = version
                client.say({**news, **more}, image)

    async def end(self, news: Mapping[str, Any]) -> None:
        """Send every client the reason for the end, and close."""
        for client in list(self.clients):
            client.say(news, b"")
            client.close()
        self.door.stop()
        await asyncio.sleep(LAST_S)
        await self.door.close_all_connections()


class _Pictures(Guarded, websocket.WebSocketHandler):
    """One client of the page."""

    _page_server: PageServer
    waits = False
    version = -1

    def check_origin(self, origin: str) -> bool:
        """Return whether the request comes from the page served here.

        A program other than a browser sends no origin.
        """
        return urlsplit(origin).netloc == self.request.host

    def open(self, *args: str, **kwargs: str) -> None:
        if len(self._page_server.clients) >= MOST_CLIENTS:
            self.close(1013, f"{MOST_CLIENTS} pages already show this")
            return
        self._page_server.clients.add(self)

    def on_message(self, message: str | bytes) -> None:
        if self not in self._page_server.clients:
            return
        if message == NEXT:
            self.waits = True
        elif message == LET_GO:
            self._page_server.let_go()

    def on_close(self) -> None:
        self._page_server.clients.discard(self)

    def say(self, news: Mapping[str, Any], image: bytes) -> None:
        """Send the news as JSON, preceded by its length and followed by the picture."""
        text = json.dumps(news, allow_nan=False, separators=(",", ":")).encode()
        try:
            sent = self.write_message(len(text).to_bytes(4, "little") + text + image, binary=True)
        except websocket.WebSocketClosedError:
            self._page_server.clients.discard(self)
        else:
            sent.add_done_callback(self._notice)

    def _notice(self, sent: "asyncio.Future[None]") -> None:
        """Handle the end of a transmission; this is where a client that left meanwhile is noticed."""
        if not sent.cancelled() and sent.exception() is not None:
            self._page_server.clients.discard(self)
