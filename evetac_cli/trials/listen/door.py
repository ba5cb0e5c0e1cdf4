"""The door for a robot's program: a TCP port that takes one JSON object per line, and the file that leads to it.

All users of a computer share 127.0.0.1, and a page of any site that is open in a browser can send to it. So each line
carries the token, which is in a file of mode 0600. A line without it, for example an HTTP request, is refused and its
connection closed.
"""

import json
import os
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from pathlib import Path
from socketserver import StreamRequestHandler, ThreadingTCPServer
from typing import Any

from evetac_cli import console
from evetac_cli.errors import InputError
from evetac_cli.text_files import parse_json

ADDRESS = "127.0.0.1"
MOST_BYTES = 4096  # longest line
MOST_CONNECTIONS = 32
TOKEN_S = 5.0  # time within which a connection must show the token
END_S = 1.0  # time for the last answers
POLL_S = 0.1
LINE = re.compile(rb"127\.0\.0\.1 ([0-9]{1,5}) [A-Za-z0-9_-]{20,100}\n")
REFUSED = f"refused: expected one JSON object per line, up to {MOST_BYTES:,} bytes, with the token of this run"
FULL = f"refused: {MOST_CONNECTIONS} connections are open"
Answer = Mapping[str, Any]


class Door(ThreadingTCPServer):
    """Listens until it is closed. ask: takes a request and returns the future of its answer."""

    allow_reuse_address = True
    daemon_threads = True
    request_queue_size = MOST_CONNECTIONS

    def __init__(self, ask: Callable[[Answer], "Future[dict[str, Any]]"], port: int) -> None:
        """Begin to listen, at a port that the system chooses if it is 0; InputError if the port is in use."""
        self.token = secrets.token_urlsafe(24)
        self.ask = ask
        self._open: set[socket.socket] = set()
        try:
            super().__init__((ADDRESS, port), _Connection)
        except OSError as error:
            raise InputError(f"cannot listen: {error.strerror}", where=f"--listen-port {port}") from None
        self.port = int(self.server_address[1])
        threading.Thread(target=self.serve_forever, args=(POLL_S,), name="listen", daemon=True).start()

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
                request.sendall(_line({"ok": False, "error": FULL}))
            return False
        self._open.add(request)
        return True

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        super().shutdown_request(request)
        self._open.discard(request)


class _Connection(StreamRequestHandler):
    """Answers the lines of one connection until it ends, or lacks the token."""

    server: Door
    timeout = TOKEN_S

    def handle(self) -> None:
        with suppress(OSError):  # the client has gone, or has not shown the token in time
            while line := self.rfile.readline(MOST_BYTES + 1):
                request = self._read(line)
                if request is None:
                    self.wfile.write(_line({"ok": False, "error": REFUSED}))
                    return
                self.connection.settimeout(None)
                self.wfile.write(_line(self.server.ask(request).result()))

    def _read(self, line: bytes) -> Answer | None:
        """Return the request of a line; None if it is not a request or lacks the token."""
        try:
            request: Any = parse_json(line.decode()) if line.endswith(b"\n") else None
            token = request.get("token") if isinstance(request, dict) else None
            known = isinstance(token, str) and secrets.compare_digest(token.encode(), self.server.token.encode())
        except ValueError:
            return None
        return request if known else None


def _line(answer: Answer) -> bytes:
    return json.dumps(answer).encode() + b"\n"


@contextmanager
def address_file(path: Path, door: Door) -> Iterator[None]:
    """Write address, port and token on one line of a file that only this user can read, and remove it at the end.

    The file of a killed process is replaced. InputError if another process listens here, or evetac did not write it.
    """
    line = f"{ADDRESS} {door.port} {door.token}\n".encode()
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        _check_replaceable(path, door.port)
        with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(line)
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", where=str(path)) from None
    try:
        yield
    finally:
        with suppress(OSError):
            if path.read_bytes() == line:
                path.unlink()


def _check_replaceable(path: Path, own_port: int) -> None:
    """Raise InputError unless the path is free, or has the file of a process that no longer listens."""
    if not os.path.lexists(path):
        return
    hint = "-o FOLDER listens elsewhere"
    old = LINE.fullmatch(path.read_bytes()) if path.is_file() and not path.is_symlink() else None
    if old is None:
        raise InputError("this is not a file that evetac made", where=str(path), hint=hint)
    port = int(old[1])
    if port != own_port:
        with suppress(OSError, OverflowError), socket.create_connection((ADDRESS, port), TOKEN_S):
            raise InputError("another evetac is listening here", where=str(path), hint=f"end it first, or {hint}")
    console.say(f"{path}: replaced; it was left by a run that was killed")
