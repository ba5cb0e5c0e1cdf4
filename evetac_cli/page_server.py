"""Serves pages on this computer to its user alone: what every page that a command serves has in common.

What keeps others out, since one message to a page can take a gripper's torque away, or write a file:
- it listens on 127.0.0.1 alone, at a port that the system chooses;
- every address begins with a random token; the terminal shows it, and a browser that is opened here gets it from a file
  that nobody else can read, and not as an argument, which every user of the computer sees (page_address.py);
- a request whose Host is not this computer is refused: another site's name that suddenly stands for 127.0.0.1 (DNS
  rebinding) does not get through; nor does what another site's page sends (Origin);
- no other site may show the page in a frame, where somebody could be made to click on it;
- a connection that has not asked for something with the token after some seconds is closed, and the oldest of these
  where there are many: other users of this computer may connect too, and shall not use up what there is of them.
"""

import logging
import secrets
from collections.abc import Mapping, Sequence
from hmac import compare_digest
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from tornado import httpserver, netutil, web

ADDRESS = "127.0.0.1"
OWN_NAMES = ("127.0.0.1", "localhost", "[::1]")  # by any port: ssh -L may listen at another one
MOST_BYTES = 4096  # of a message, or a request, to here
REQUEST_S = 5.0  # in which a connection has to ask for something
MOST_WAITING = 256  # connections that have not; twice of what tornado takes on before it looks at any of them
BACKLOG = 1024  # connections that the system holds until they are taken on
Content = Mapping[str, tuple[Path, str]]  # name in the address -> file and its type
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:;"
    " connect-src 'self' ws://{host}; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class OwnServer:
    """Files at `url`, and what else a page asks for; used within a running asyncio loop.

    content: the files, "" the page itself. routes: (pattern, handler, what it is given) beside them; a pattern begins
    with the token as its first group, and a handler is a `Guarded`.
    """

    def __init__(self, content: Content, routes: Sequence[tuple[str, type["Guarded"], dict[str, Any]]] = ()) -> None:
        """Begin to listen."""
        for name in ("tornado.general", "tornado.access"):  # a refused request is no news for the terminal
            logging.getLogger(name).addHandler(logging.NullHandler())
            logging.getLogger(name).propagate = False
        self.token = secrets.token_urlsafe(24)
        self.content = content
        own = {"server": self}
        every = [(pattern, handler, own | given) for pattern, handler, given in routes]
        application = web.Application(
            [*every, (r"/([^/]*)/([^/]*)", _Page, own)],
            default_handler_class=Guarded,  # which refuses what has no token
            default_handler_args=own,
            log_function=lambda _: None,
            websocket_max_message_size=MOST_BYTES,
        )
        self.door = _Door(
            application,
            max_body_size=MOST_BYTES,
            max_header_size=16 * MOST_BYTES,
            idle_connection_timeout=REQUEST_S,
            body_timeout=REQUEST_S,
        )
        self.waiting = self.door.waiting
        sockets = netutil.bind_sockets(0, ADDRESS, backlog=BACKLOG)
        self.door.add_sockets(sockets)
        self.port = int(sockets[0].getsockname()[1])

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{ADDRESS}:{self.port}/{self.token}/"


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


class Guarded(web.RequestHandler):
    """Refuses whoever does not know the token, or comes by another name than this computer's."""

    def initialize(self, server: OwnServer) -> None:
        """Keep the server."""
        self._page_server = server

    def prepare(self) -> None:
        """Refuse, before anything else is done."""
        token = str(self.path_args[0]) if self.path_args else ""
        if _host_name(self.request.host) not in OWN_NAMES:
            raise web.HTTPError(403)
        if not compare_digest(token.encode(), self._page_server.token.encode()):
            raise web.HTTPError(403)
        connection: Any = self.request.connection
        self._page_server.waiting.pop(connection.stream, None)

    def set_default_headers(self) -> None:
        """Load nothing from elsewhere, be shown in no frame, be kept nowhere."""
        for name, value in HEADERS.items():
            own = self.request.host if _host_name(self.request.host) in OWN_NAMES else ADDRESS
            self.set_header(name, value.replace("{host}", own))
        self.clear_header("Server")

    def write_error(self, status_code: int, **about: Any) -> None:
        """Say the number alone."""
        self.finish(f"{status_code}\n")

    def is_from_here(self) -> bool:
        """Whether a page that came from here asks, by its Origin."""
        origin = str(self.request.headers.get("Origin", ""))
        return urlsplit(origin).netloc == self.request.host


class _Page(Guarded):
    """The page and its files."""

    def get(self, token: str, name: str) -> None:
        if name not in self._page_server.content:
            raise web.HTTPError(404)
        file, kind = self._page_server.content[name]
        self.set_header("Content-Type", f"{kind}; charset=utf-8")
        self.finish(file.read_bytes())


def _host_name(host: str) -> str:
    """The name of `Host: NAME:PORT`."""
    return host if host.endswith("]") else host.rpartition(":")[0] or host
