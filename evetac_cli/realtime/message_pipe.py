"""Messages from one process to another that never make the writer wait.

Why so: whoever keeps a beat of 1 or 2 ms cannot wait for a recorder that is writing a file. So what does not fit into
the pipe stays with the writer, and goes with a later `send`. A pipe tells the reader at once when the writer has died,
and a message that it died over is never delivered.
"""

import contextlib
import itertools
import os
import pickle
import struct
import time
from collections import deque
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any

MOST_BYTES = 64 << 20
_PIPE_BYTES = 1 << 20
_LENGTH = struct.Struct("<Q")
_READ_BYTES = 1 << 18
_MOST_READ_BYTES = 4 << 20  # at once: a writer that catches up must not keep its reader from all else
_MOST_PARTS = 64  # of messages that are written by one call
_PAUSE_S = 1e-3


class PeerGone(BrokenPipeError):
    """The process at the other end of a pipe of ours is gone: not what a camera or a file raises by the same name."""


def take_order(orders: Connection, timeout_s: float = 0.0) -> bool:
    """Whether an order has come in this time, which is taken; PeerGone if nobody gives orders any more."""
    if not orders.poll(timeout_s):
        return False
    try:
        orders.recv()
    except (EOFError, OSError):
        raise PeerGone("whoever gives orders is gone") from None
    return True


class MessageWriter:
    """The writing end; takes messages at any time and sends them when there is room."""

    def __init__(self, pipe: Connection, most_bytes: int = MOST_BYTES) -> None:
        """most_bytes: how much may wait in memory until the pipe has room."""
        self._pipe = pipe
        self._waiting: deque[memoryview] = deque()
        self._most_bytes = most_bytes
        self.waiting_bytes = 0
        os.set_blocking(pipe.fileno(), False)
        with contextlib.suppress(ImportError, OSError):  # more room in the pipe means fewer calls; only Linux has it
            import fcntl

            fcntl.fcntl(pipe.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def fileno(self) -> int:
        """For select: writable when there is room in the pipe."""
        return self._pipe.fileno()

    def put(self, message: Any, *, always: bool = False) -> bool:
        """Take a message, to be sent later; False, and it is not taken, if too much is waiting.

        always: take it however much is waiting, as a last message that says so.
        """
        data = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
        size = _LENGTH.size + len(data)
        if self.waiting_bytes + size > self._most_bytes and not always:
            return False
        self._waiting += (memoryview(_LENGTH.pack(len(data))), memoryview(data))
        self.waiting_bytes += size
        return True

    def send(self) -> None:
        """Send as much as there is room for; PeerGone if there is no reader any more."""
        while self._waiting:
            try:
                sent = os.writev(self._pipe.fileno(), list(itertools.islice(self._waiting, _MOST_PARTS)))
            except BlockingIOError:
                return
            except BrokenPipeError:
                raise PeerGone("whoever reads is gone") from None
            self.waiting_bytes -= sent
            while self._waiting and sent >= len(self._waiting[0]):
                sent -= len(self._waiting.popleft())
            if sent:
                self._waiting[0] = self._waiting[0][sent:]

    def flush(self, timeout_s: float) -> bool:
        """Send everything, waiting for room; False if not all of it went in time."""
        end_s = time.monotonic() + timeout_s
        self.send()
        while self._waiting and time.monotonic() < end_s:
            time.sleep(_PAUSE_S)
            self.send()
        return not self._waiting


class MessageReader:
    """The reading end; takes what has come whole, and never waits."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._data = bytearray()
        self.ended = False  # the writer is gone, and what it sent is here

    def fileno(self) -> int:
        """For select: readable when there is something to take, or the writer has gone."""
        return self._pipe.fileno()

    def take(self) -> Iterator[Any]:
        """The messages that have come whole, oldest first; what is not taken now is there for the next call."""
        os.set_blocking(self._pipe.fileno(), False)
        came = 0
        while not self.ended and came < _MOST_READ_BYTES:
            try:
                data = os.read(self._pipe.fileno(), _READ_BYTES)
            except BlockingIOError:
                break
            self._data += data
            came += len(data)
            self.ended = not data
        while len(self._data) >= _LENGTH.size:
            end = _LENGTH.size + _LENGTH.unpack_from(self._data)[0]
            if len(self._data) < end:
                break
            with memoryview(self._data) as whole:
                message = pickle.loads(whole[_LENGTH.size : end])  # from a process of our own
            del self._data[:end]
            yield message
