"""Servers for this computer: of pages that commands show, and of programs that control them.

All users of a computer share 127.0.0.1, and any site that is open in a browser can send requests there. One message can
switch off a gripper's torque or write a file. So:
- A client shows a random token. Of a page, it is the first part of the address.
- A request whose Host is not this computer is refused. This stops another site's name that resolves to 127.0.0.1 (DNS
  rebinding). A request that changes something is refused unless its Origin is this page.
- No other site may show a page in a frame, where users could be tricked into clicking on it.
- The arguments of a browser are visible to all users, so the one that is opened here gets an address that works once.

It is on the ground floor and not among the pages, because trials and stages, which are below the pages, use it.
"""

import json
import os
import secrets
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from socketserver import BaseRequestHandler, ThreadingTCPServer
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from evetac_cli import console
from evetac_cli.text_files import parse_json

ADDRESS = "127.0.0.1"
OWN_NAMES = ("127.0.0.1", "localhost", "[::1]")  # with any port: ssh -L may listen at another one
MOST_BYTES = 4096  # longest message to a server
MOST_CONNECTIONS = 32
REQUEST_S = 5.0  # time within which a connection must show the token
END_S = 1.0  # time for the last answers
POLL_S = 0.1
TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:;"
    " connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class LocalServer(ThreadingTCPServer):
    """Listens on 127.0.0.1 until it is closed, with a thread for each connection and a limit on their number."""

    allow_reuse_address = True
    daemon_threads = True
    request_queue_size = MOST_CONNECTIONS
    full = b""  # the answer to one connection too many

    def __init__(self, handler: type[BaseRequestHandler], port: int = 0) -> None:
        """Begin to listen, at a port that the system chooses if it is 0; OSError if the port is in use."""
        self.token = secrets.token_urlsafe(24)
        self._open: set[socket.socket] = set()
        super().__init__((ADDRESS, port), handler)
        self.port = int(self.server_address[1])
        threading.Thread(target=self.serve_forever, args=(POLL_S,), name="local server", daemon=True).start()

    def is_token(self, text: str) -> bool:
        """Whether a client shows the token."""
        return secrets.compare_digest(text.encode(), self.token.encode())

    def close(self) -> None:
        """Accept no more requests, and close all connections after the waiting ones have their answers."""
        self.shutdown()
        self.server_close()
        for connection in list(self._open):
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RD)
        end_s = time.monotonic() + END_S
        while self._open and time.monotonic() < end_s:
            time.sleep(1e-2)

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Return whether one more connection is taken."""
        if len(self._open) >= MOST_CONNECTIONS:
            with suppress(OSError):
                request.sendall(self.full)
            return False
        self._open.add(request)
        return True

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        super().shutdown_request(request)
        self._open.discard(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print an error, but not that a client has gone."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class RequestRefused(Exception):
    """A request that a page server refuses, with the status that it answers."""


class PageServer(LocalServer):
    """Serves a page at `url`, and answers its requests.

    files: the page, then the files that it loads. answers: functions by method and name. Each takes the query or the
    JSON object that was sent. It returns bytes or an object for JSON, or raises a RequestRefused.
    """

    full = b"HTTP/1.0 503 Service Unavailable\r\n\r\n"

    def __init__(
        self, files: Sequence[Path], answers: Mapping[tuple[str, str], Callable[[dict[str, Any]], Any]]
    ) -> None:
        """Begin to listen."""
        self.files = {"": files[0]} | {file.name: file for file in files[1:]}
        self.answers = answers
        self._once = secrets.token_urlsafe(24)
        super().__init__(_PageRequest)
        self.url = f"http://{ADDRESS}:{self.port}/{self.token}/"
        self.url_once = f"http://{ADDRESS}:{self.port}/{self._once}/"

    def is_first(self, text: str) -> bool:
        """Whether a browser comes by the address that works once."""
        first = bool(self._once) and secrets.compare_digest(text.encode(), self._once.encode())
        self._once = "" if first else self._once
        return first


class _PageRequest(BaseHTTPRequestHandler):
    server: PageServer
    timeout = REQUEST_S

    def do_GET(self) -> None:
        """Answer a request, or refuse it with a status."""
        url = urlsplit(self.path)
        token, _, name = url.path.removeprefix("/").partition("/")
        host = self.headers.get("Host", "")
        try:
            if _name(host) not in OWN_NAMES:
                raise RequestRefused(HTTPStatus.FORBIDDEN)
            if self.server.is_first(token):
                self.send_response(HTTPStatus.FOUND)
                self.send_header("Location", f"/{self.server.token}/")
                self.end_headers()
                return
            if not self.server.is_token(token):
                raise RequestRefused(HTTPStatus.FORBIDDEN)
            content, kind = self._content(name, dict(parse_qsl(url.query)), host)
        except RequestRefused as refusal:
            self.send_error(refusal.args[0])
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.connection.settimeout(None)
        self.wfile.write(content)

    do_POST = do_GET

    def _content(self, name: str, query: dict[str, Any], host: str) -> tuple[bytes, str]:
        """Return the answer and its type."""
        if self.command == "GET" and name in self.server.files:
            file = self.server.files[name]
            return file.read_bytes(), f"{TYPES[file.suffix]}; charset=utf-8"
        answer = self.server.answers.get((self.command, name))
        if answer is None:
            raise RequestRefused(HTTPStatus.NOT_FOUND)
        answered = answer(query if self.command == "GET" else self._sent(host))
        if isinstance(answered, bytes):
            return answered, "application/octet-stream"
        return json.dumps(answered, allow_nan=False).encode(), "application/json"

    def _sent(self, host: str) -> dict[str, Any]:
        """Return the JSON object of a request that comes from this page."""
        if urlsplit(self.headers.get("Origin", "")).netloc != host:
            raise RequestRefused(HTTPStatus.FORBIDDEN)
        try:
            length = int(self.headers.get("Content-Length", ""))
            sent = parse_json(self.rfile.read(length).decode()) if 0 <= length <= MOST_BYTES else None
        except ValueError:
            sent = None
        if not isinstance(sent, dict):
            raise RequestRefused(HTTPStatus.BAD_REQUEST)
        return sent

    def end_headers(self) -> None:
        """Send headers so that the page loads nothing from other sites, appears in no frame, and is not cached."""
        for name, value in HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, *_: object) -> None:
        """Show no requests on the terminal."""


def _name(host: str) -> str:
    """Return NAME of `Host: NAME:PORT`."""
    return host if host.endswith("]") else host.rpartition(":")[0] or host


def announce(url: str, url_once: str, name: str) -> None:
    """Print the address of a page, and show it in a browser if there is a display; url_once: what this one opens."""
    console.say(f"{name}: {url}")
    has_display = sys.platform == "darwin" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if has_display and "SSH_CONNECTION" not in os.environ:
        webbrowser.open(url_once)
