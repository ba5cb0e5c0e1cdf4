"""A server for pages of commands, accessible only to the user on this computer.

One message to a page can switch off a gripper's torque or write a file. Protection against others:
- The server listens only on 127.0.0.1, at a port that the system chooses.
- Every address begins with a random token. The terminal shows it. A browser that is opened here gets it from a file
  that only this user can read, and not as an argument, which every user of the computer can see (page_address.py).
- A request whose Host is not this computer is refused. This stops another site's name that resolves to 127.0.0.1 (DNS
  rebinding). Requests from another site's page are refused by their Origin.
- No other site may show the page in a frame, where users could be tricked into clicking on it.
- A connection without a request with the token is closed after some seconds, or earlier if there are many, the oldest
  first. Other users of this computer can connect too, and must not use up all connections.
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
OWN_NAMES = ("127.0.0.1", "localhost", "[::1]")  # with any port: ssh -L may listen at another one
MOST_BYTES = 4096  # largest message or request to the server
REQUEST_S = 5.0  # time within which a connection must send a request
MOST_WAITING = 256  # connections without a request; twice the number that tornado accepts before it reads from any
BACKLOG = 1024  # connections that the system holds until they are accepted
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
    """Serves files at `url`, and further routes of a page; used within a running asyncio loop.

    content: the files by name, with "" for the page itself. routes: further (pattern, handler, handler arguments). A
    pattern begins with the token as its first group, and a handler is a subclass of `Guarded`.
    """

    def __init__(self, content: Content, routes: Sequence[tuple[str, type["Guarded"], dict[str, Any]]] = ()) -> None:
        """Start to listen."""
        for name in ("tornado.general", "tornado.access"):  # refused requests are not shown on the terminal
            logging.getLogger(name).addHandler(logging.NullHandler())
            logging.getLogger(name).propagate = False
        self.token = secrets.token_urlsafe(24)
        self.content = content
        own = {"server": self}
        every = [(pattern, handler, own | options) for pattern, handler, options in routes]
        application = web.Application(
            [*every, (r"/([^/]*)/([^/]*)", _Page, own)],
            default_handler_class=Guarded,  # refuses requests without the token
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
        """The address of the page."""
        return f"http://{ADDRESS}:{self.port}/{self.token}/"


class _Door(httpserver.HTTPServer):
    """A server that keeps at most MOST_WAITING connections that have not yet sent the token."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        self.waiting: dict[Any, None] = {}  # streams of these connections, the oldest first
        super().initialize(*args, **kwargs)

    def handle_stream(self, stream: Any, address: Any) -> None:
        """Accept a connection; if too many are waiting, close the oldest of them."""
        self.waiting[stream] = None
        if len(self.waiting) > MOST_WAITING:
            oldest = next(iter(self.waiting))
            del self.waiting[oldest]
            oldest.close()
        super().handle_stream(stream, address)

    def on_close(self, server_conn: Any) -> None:
        """Forget a connection that has ended or became a websocket."""
        self.waiting.pop(server_conn.stream, None)
        super().on_close(server_conn)


class Guarded(web.RequestHandler):
    """Refuses requests without the token, or with a Host that is not this computer."""

    def initialize(self, server: OwnServer) -> None:
        """Keep the server."""
        self._page_server = server

    def prepare(self) -> None:
        """Refuse such requests before anything else is done."""
        token = str(self.path_args[0]) if self.path_args else ""
        if _host_name(self.request.host) not in OWN_NAMES:
            raise web.HTTPError(403)
        if not compare_digest(token.encode(), self._page_server.token.encode()):
            raise web.HTTPError(403)
        connection: Any = self.request.connection
        self._page_server.waiting.pop(connection.stream, None)

    def set_default_headers(self) -> None:
        """Set headers so that the page loads nothing from other sites, appears in no frame, and is not cached."""
        for name, value in HEADERS.items():
            own = self.request.host if _host_name(self.request.host) in OWN_NAMES else ADDRESS
            self.set_header(name, value.replace("{host}", own))
        self.clear_header("Server")

    def write_error(self, status_code: int, **about: Any) -> None:
        """Send only the status code."""
        self.finish(f"{status_code}\n")

    def is_from_here(self) -> bool:
        """Whether the request comes from a page of this server, by its Origin."""
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
    """Return NAME of `Host: NAME:PORT`."""
    return host if host.endswith("]") else host.rpartition(":")[0] or host
