"""The door for a robot's program: a local socket with one JSON object per line, for holders of the token only.

All users of a computer share 127.0.0.1, and a page of any site that is open in a browser can send to it. So each line
carries the token. A line without it, for example an HTTP request, is refused and its connection closed. Connections
without a token get a few seconds, are few in number and per second, and may send only short lines. So they cannot
disturb the recording program.
"""

import asyncio
import json
import secrets
import socket
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from hmac import compare_digest
from typing import Any

from evetac_cli.errors import InputError
from evetac_cli.text_files import parse_json

ADDRESS = "127.0.0.1"
MOST_BYTES = 4096  # longest line
STRANGER_S = 5.0  # time within which a connection must show the token
MOST_STRANGERS, MOST_KNOWN = 16, 16  # most connections without and with token; the oldest is closed for a new one
BACKLOG = 128  # connections that the system queues until they are accepted
PAUSE_S = 2e-3  # pause between accepting two connections
SEND_S = 5.0  # timeout for an answer that is not read
END_S = 1.0  # time for the last answers
REFUSED = b'{"ok": false, "error": "refused"}\n'


class Door:
    """Listens until it is closed. ask: takes a request and returns the future of its answer."""

    def __init__(self, ask: Callable[[Mapping[str, Any]], "Future[dict[str, Any]]"], port: int) -> None:
        """Begin to listen, at a port that the system chooses if it is 0; InputError if the port is in use."""
        self.token = secrets.token_urlsafe(24)
        self._ask = ask
        try:
            self._socket = socket.create_server((ADDRESS, port), backlog=BACKLOG)
        except OSError as error:
            raise InputError(f"cannot listen: {error.strerror}", where=f"--listen-port {port}") from None
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])
        self._strangers: dict[asyncio.StreamWriter, None] = {}  # oldest first
        self._known: dict[asyncio.StreamWriter, None] = {}
        self._answering: set[asyncio.Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        self._over = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="listen", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Accept no more requests, and close all connections after the waiting ones have their answers."""
        self._loop.call_soon_threadsafe(self._over.set)
        self._thread.join(2 * END_S)

    def _run(self) -> None:
        self._loop.run_until_complete(self._serve())
        self._loop.close()

    async def _serve(self) -> None:
        taking = self._loop.create_task(self._take())
        await self._over.wait()
        taking.cancel()
        self._socket.close()
        if self._answering:
            await asyncio.wait(self._answering, timeout=END_S)
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _take(self) -> None:
        """Accept connections."""
        while True:
            try:
                connection, _ = await self._loop.sock_accept(self._socket)
                reader, writer = await asyncio.open_connection(sock=connection, limit=MOST_BYTES)
            except OSError:  # the connection has gone again, or this process has too many open files
                await asyncio.sleep(PAUSE_S)
                continue
            self._strangers[writer] = None
            _drop_oldest(self._strangers, MOST_STRANGERS)
            task = self._loop.create_task(self._talk(reader, writer))
            self._answering.add(task)
            task.add_done_callback(self._answering.discard)
            await asyncio.sleep(PAUSE_S)

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer the lines of one connection until it ends, or lacks the token."""
        task = asyncio.current_task()
        assert task is not None
        try:
            while not self._over.is_set():
                self._answering.discard(task)
                line = await asyncio.wait_for(reader.readline(), STRANGER_S if writer in self._strangers else None)
                request = self._read(line)
                if request is None:
                    writer.write(REFUSED if line else b"")
                    break
                self._answering.add(task)
                if writer in self._strangers:
                    del self._strangers[writer]
                    self._known[writer] = None
                    _drop_oldest(self._known, MOST_KNOWN)
                answer = await asyncio.wrap_future(self._ask(request))
                writer.write(json.dumps(answer).encode() + b"\n")
                await asyncio.wait_for(writer.drain(), SEND_S)
        except ValueError:  # a line is too long
            writer.write(REFUSED)
        except (TimeoutError, OSError):
            pass
        finally:
            self._strangers.pop(writer, None)
            self._known.pop(writer, None)
            with suppress(OSError):
                writer.close()

    def _read(self, line: bytes) -> Mapping[str, Any] | None:
        """Return the request of a line; None if it is not a request or lacks the token."""
        try:
            request: Any = parse_json(line.decode()) if line.endswith(b"\n") else None
        except ValueError:
            return None
        token = request.get("token") if isinstance(request, dict) else None
        if not isinstance(token, str) or not compare_digest(token.encode(), self.token.encode()):
            return None
        return request if isinstance(request, dict) else None


def _drop_oldest(connections: dict[asyncio.StreamWriter, None], most: int) -> None:
    """Close the oldest connections if there are more than `most`."""
    while len(connections) > most:
        oldest = next(iter(connections))
        del connections[oldest]
        oldest.transport.abort()
