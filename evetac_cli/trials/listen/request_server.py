"""The server for a robot's program: a TCP port that takes one JSON object per line, and the file that leads to it.

All users of a computer share 127.0.0.1, and a page of any site that is open in a browser can send to it. So each line
carries the token, which is in a file of mode 0600. A line without it, for example an HTTP request, is refused and its
connection closed.
"""

import json
import os
import re
import socket
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from pathlib import Path
from socketserver import StreamRequestHandler
from typing import Any

from evetac_cli import console
from evetac_cli.errors import InputError
from evetac_cli.realtime.local_server import ADDRESS, MOST_BYTES, MOST_CONNECTIONS, REQUEST_S, LocalServer
from evetac_cli.text_files import parse_json

LINE = re.compile(rb"127\.0\.0\.1 ([0-9]{1,5}) [A-Za-z0-9_-]{20,100}\n")
REFUSED = f"refused: expected one JSON object per line, up to {MOST_BYTES:,} bytes, with the token of this run"
Answer = Mapping[str, Any]


def _line(answer: Answer) -> bytes:
    return json.dumps(answer).encode() + b"\n"


class RequestServer(LocalServer):
    """Listens until it is closed. ask: takes a request and returns the future of its answer."""

    full = _line({"ok": False, "error": f"refused: {MOST_CONNECTIONS} connections are open"})

    def __init__(self, ask: Callable[[Answer], "Future[dict[str, Any]]"], port: int) -> None:
        """Begin to listen, at a port that the system chooses if it is 0; InputError if the port is in use."""
        self.ask = ask
        try:
            super().__init__(_Connection, port)
        except OSError as error:
            raise InputError(f"cannot listen: {error.strerror}", where=f"--listen-port {port}") from None


class _Connection(StreamRequestHandler):
    """Answers the lines of one connection until it ends, or lacks the token."""

    server: RequestServer
    timeout = REQUEST_S

    def handle(self) -> None:
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
            known = isinstance(token, str) and self.server.is_token(token)
        except ValueError:
            return None
        return request if known else None


@contextmanager
def address_file(path: Path, server: RequestServer) -> Iterator[None]:
    """Write address, port and token on one line of a file that only this user can read, and remove it at the end.

    The file of a killed process is replaced. InputError if another process listens here, or evetac did not write it.
    """
    line = f"{ADDRESS} {server.port} {server.token}\n".encode()
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        _check_replaceable(path, server.port)
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
        with suppress(OSError, OverflowError), socket.create_connection((ADDRESS, port), REQUEST_S):
            raise InputError("another evetac is listening here", where=str(path), hint=f"end it first, or {hint}")
    console.say(f"{path}: replaced; it was left by a run that was killed")
