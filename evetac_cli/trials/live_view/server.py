"""Serves the page of a live view on this computer, and sends pictures to whoever asks for the next one.

A client gets a picture only when it has drawn the one before and asks: so a slow browser, or a tab that nobody looks
at, gets fewer, and nothing piles up. The page is `page.html` with `page.js` and `page.css`, and what draws touch maps
on the page of `view` too; it loads nothing else. Who may look at it is told by page_server.py.
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
LAST_S = 0.3  # for the last words to arrive
NEXT, LET_GO = "next", "let go"  # all that a client can say
CONTENT: dict[str, tuple[Path, str]] = {
    "": (HERE / "page.html", "text/html"),
    "page.js": (HERE / "page.js", "text/javascript"),
    "page.css": (HERE / "page.css", "text/css"),
    "touch_map.js": (DATA / "touch_map.js", "text/javascript"),
}


class PageServer(OwnServer):
    """The page at `url`, and the clients that look at it; used within a running asyncio loop."""

    def __init__(self, let_go: Callable[[], None]) -> None:
        """Begin to listen; let_go: called when somebody presses the button."""
        self.let_go = let_go
        self.clients: set[_Pictures] = set()
        super().__init__(CONTENT, [(r"/([^/]*)/pictures", _Pictures, {})])

    @property
    def is_asked(self) -> bool:
        """Whether a client waits for a picture."""
        return any(client.waits for client in self.clients)

    def send(self, news: Mapping[str, Any], image: bytes, known: Callable[[], Mapping[str, Any]], version: int) -> None:
        """Send a picture to every client that waits for one.

        image: a byte for each pixel; known: what a client has to know before its first picture, and again when its
        version changes.
        """
        for client in list(self.clients):
            if client.waits:
                client.waits = False
                more = {} if client.version == version else dict(known())
                client.version = version
                client.say({**news, **more}, image)

    async def end(self, news: Mapping[str, Any]) -> None:
        """Tell every client why there will be no more pictures, and close."""
        for client in list(self.clients):
            client.say(news, b"")
            client.close()
        self.door.stop()
        await asyncio.sleep(LAST_S)
        await self.door.close_all_connections()


class _Pictures(Guarded, websocket.WebSocketHandler):
    """One client that looks at the page."""

    _page_server: PageServer
    waits = False
    version = -1

    def check_origin(self, origin: str) -> bool:
        """Whether a page that came from here asks; a program that is no browser names no origin."""
        return urlsplit(origin).netloc == self.request.host

    def open(self, *args: str, **kwargs: str) -> None:
        if len(self._page_server.clients) >= MOST_CLIENTS:
            self.close(1013, f"{MOST_CLIENTS} pages show this already")
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
        """Send news as JSON, its length before it, and the picture behind it."""
        text = json.dumps(news, allow_nan=False, separators=(",", ":")).encode()
        try:
            sent = self.write_message(len(text).to_bytes(4, "little") + text + image, binary=True)
        except websocket.WebSocketClosedError:
            self._page_server.clients.discard(self)
        else:
            sent.add_done_callback(self._notice)

    def _notice(self, sent: "asyncio.Future[None]") -> None:
        """A message has gone, or the client has while it was on its way: then this is what says so."""
        if not sent.cancelled() and sent.exception() is not None:
            self._page_server.clients.discard(self)
