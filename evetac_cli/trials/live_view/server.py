"""Serves the page of a live view on this computer, and sends pictures to whoever asks for the next one.

A client gets a picture only when it has drawn the one before and asks: so a slow browser, or a tab that nobody looks
at, gets fewer, and nothing piles up. The page is `page.html` with `page.js` and `page.css`, and what draws touch maps
on the page of `view` too; it loads nothing else.

What keeps others out, since one message from here takes a gripper's torque away:
- it listens on 127.0.0.1 alone, at a port that the system chooses;
- every address begins with a random token; the terminal shows it, and a browser that is opened here gets it from a file
  that nobody else can read, and not as an argument, which every user of the computer sees;
- a request whose Host is not this computer is refused: another site's name that suddenly stands for 127.0.0.1 (DNS
  rebinding) does not get through; nor does a websocket that another site's page opens (Origin);
- no other site may show the page in a frame, where somebody could be made to click on it;
- a connection that has not asked for something with the token after some seconds is closed, and the oldest of these
  where there are many: other users of this computer may connect too, and shall not use up what there is of them.
"""

import asyncio
import json
import logging
import secrets
from collections.abc import Callable, Mapping
from hmac import compare_digest
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from tornado import httpserver, netutil, web, websocket

from evetac_cli.resources import DATA

HERE = Path(__file__).parent
ADDRESS = "127.0.0.1"
OWN_NAMES = ("127.0.0.1", "localhost", "[::1]")  # by any port: ssh -L may listen at another one
MOST_CLIENTS = 4
MOST_BYTES = 4096  # of a message, or a request, to here
REQUEST_S = 5.0  # in which a connection has to ask for something
MOST_WAITING = 256  # connections that have not; twice of what tornado takes on before it looks at any of them
BACKLOG = 1024  # connections that the system holds until they are taken on
LAST_S = 0.3  # for the last words to arrive
NEXT, LET_GO = "next", "let go"  # all that a client can say
CONTENT: dict[str, tuple[Path, str]] = {
    "": (HERE / "page.html", "text/html"),
    "page.js": (HERE / "page.js", "text/javascript"),
    "page.css": (HERE / "page.css", "text/css"),
    "touch_map.js": (DATA / "touch_map.js", "text/javascript"),
}
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:;"
    " connect-src 'self' ws://{host}; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class PageServer:
    """The page at `url`, and the clients that look at it; used within a running asyncio loop."""

    def __init__(self, let_go: Callable[[], None]) -> None:
        """Begin to listen; let_go: called when somebody presses the button."""
        for name in ("tornado.general", "tornado.access"):  # a refused request is no news for the terminal
            logging.getLogger(name).addHandler(logging.NullHandler())
            logging.getLogger(name).propagate = False
        self.token = secrets.token_urlsafe(24)
        self.let_go = let_go
        self.clients: set[_Pictures] = set()
        own = {"server": self}
        routes = [(r"/([^/]*)/pictures", _Pictures, own), (r"/([^/]*)/([^/]*)", _Page, own)]
        application = web.Application(
            routes,
            default_handler_class=_Guarded,  # which refuses what has no token
            default_handler_args=own,
            log_function=lambda _: None,
            websocket_max_message_size=MOST_BYTES,
        )
        self._server = _Door(
            application,
            max_body_size=MOST_BYTES,
            max_header_size=16 * MOST_BYTES,
            idle_connection_timeout=REQUEST_S,
            body_timeout=REQUEST_S,
        )
        self.waiting = self._server.waiting
        sockets = netutil.bind_sockets(0, ADDRESS, backlog=BACKLOG)
        self._server.add_sockets(sockets)
        self.port = int(sockets[0].getsockname()[1])

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{ADDRESS}:{self.port}/{self.token}/"

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
        self._server.stop()
        await asyncio.sleep(LAST_S)
        await self._server.close_all_connections()


class _Door(httpserver.HTTPServer):
    """A server that holds no more than MOST_WAITING connections of which it does not know that they have the token."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        self.waiting: dict[Any, None] = {}  # their streams, the oldest first
        super().initialize(*args, **kwargs)

    def handle_stream(self, stream: Any, address: Any) -> None:
        """Take on a connection; the oldest of those that wait makes room for it."""
        self.waiting[stream] = None
        if len(self.waiting) > MOST_WAITING:
            oldest = next(iter(self.waiting))
            del self.waiting[oldest]
            oldest.close()
        super().handle_stream(stream, address)

    def on_close(self, server_conn: Any) -> None:
        """A connection has ended, or became a websocket."""
        self.waiting.pop(server_conn.stream, None)
        super().on_close(server_conn)


class _Guarded(web.RequestHandler):
    """Refuses whoever does not know the token, or comes by another name than this computer's."""

    def initialize(self, server: PageServer) -> None:
        self._page_server = server

    def prepare(self) -> None:
        token = str(self.path_args[0]) if self.path_args else ""
        if _host_name(self.request.host) not in OWN_NAMES:
            raise web.HTTPError(403)
        if not compare_digest(token.encode(), self._page_server.token.encode()):
            raise web.HTTPError(403)
        connection: Any = self.request.connection
        self._page_server.waiting.pop(connection.stream, None)

    def set_default_headers(self) -> None:
        for name, value in HEADERS.items():
            own = self.request.host if _host_name(self.request.host) in OWN_NAMES else ADDRESS
            self.set_header(name, value.replace("{host}", own))
        self.clear_header("Server")

    def write_error(self, status_code: int, **about: Any) -> None:
        self.finish(f"{status_code}\n")


class _Page(_Guarded):
    """The page and its files."""

    def get(self, token: str, name: str) -> None:
        if name not in CONTENT:
            raise web.HTTPError(404)
        file, kind = CONTENT[name]
        self.set_header("Content-Type", f"{kind}; charset=utf-8")
        self.finish(file.read_bytes())


class _Pictures(_Guarded, websocket.WebSocketHandler):
    """One client that looks at the page."""

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


def _host_name(host: str) -> str:
    """The name of `Host: NAME:PORT`."""
    return host if host.endswith("]") else host.rpartition(":")[0] or host
