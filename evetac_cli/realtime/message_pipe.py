"""Send messages from one process to another without ever making the writer wait.

Reason: a process with a period of 1 or 2 ms cannot wait for a recorder that is writing a file. So messages that do not
fit into the pipe stay with the writer until a later `send`. The reader notices immediately when the writer has died,
and an incomplete message is never delivered.
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
ORDER_S = 0.1  # how long a process waits for an order before it looks for signals
FLUSH_S = 5.0
LAST_FLUSH_S = 60.0  # time for the last messages to a busy recorder, which needs them to know how the grasp ended
_PIPE_BYTES = 1 << 20
_LENGTH = struct.Struct("<Q")
_READ_BYTES = 1 << 18
_MOST_READ_BYTES = 4 << 20  # at once: a writer that catches up must not block its reader
_MOST_PARTS = 64  # parts of messages that are written by one call
_PAUSE_S = 1e-3


class PeerGone(BrokenPipeError):
    """The process at the other end of a message pipe has ended; distinct from a BrokenPipeError of a camera or file."""


def take_order(orders: Connection, timeout_s: float = 0.0) -> bool:
    """Whether an order arrived in this time; it is consumed. Raise PeerGone if the process that sends orders ended."""
    if not orders.poll(timeout_s):
        return False
    try:
        orders.recv()
    except (EOFError, OSError):
        raise PeerGone("the process that sends orders has ended") from None
    return True


class MessageWriter:
    """The writing end; accepts messages at any time and sends them when there is room."""

    def __init__(self, pipe: Connection, most_bytes: int = MOST_BYTES) -> None:
        """most_bytes: size of messages that may wait in memory until the pipe has room."""
        self._pipe = pipe
        self._waiting: deque[memoryview] = deque()
        self._most_bytes = most_bytes
        self.waiting_bytes = 0
        os.set_blocking(pipe.fileno(), False)
        with contextlib.suppress(ImportError, OSError):  # a larger pipe needs fewer calls; only Linux supports this
            import fcntl

            fcntl.fcntl(pipe.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def fileno(self) -> int:
        """Return the descriptor for select: writable when there is room in the pipe."""
        return self._pipe.fileno()

    def put(self, message: Any, *, always: bool = False) -> bool:
        """Queue a message; return False without queuing it if too much is waiting.

        always: queue it however much is waiting, for example as the last message that reports this.
        """
        data = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
        size = _LENGTH.size + len(data)
        if self.waiting_bytes + size > self._most_bytes and not always:
            return False
        self._waiting += (memoryview(_LENGTH.pack(len(data))), memoryview(data))
        self.waiting_bytes += size
        return True

    def send(self) -> None:
        """Send as much as there is room for; raise PeerGone if the reader has ended."""
        while self._waiting:
            try:
                sent = os.writev(self._pipe.fileno(), list(itertools.islice(self._waiting, _MOST_PARTS)))
            except BlockingIOError:
                return
            except BrokenPipeError:
                raise PeerGone("the process that reads has ended") from None
            self.waiting_bytes -= sent
            while self._waiting and sent >= len(self._waiting[0]):
                sent -= len(self._waiting.popleft())
            if sent:
                self._waiting[0] = self._waiting[0][sent:]

    def flush(self, timeout_s: float) -> bool:
        """Send everything, waiting for room; return False if that was not possible in time."""
        end_s = time.monotonic() + timeout_s
        self.send()
        while self._waiting and time.monotonic() < end_s:
            time.sleep(_PAUSE_S)
            self.send()
        return not self._waiting


class MessageReader:
    """The reading end; returns complete messages and never waits."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._data = bytearray()
        self.ended = False  # the writer has ended, and all that it sent has been read

    def fileno(self) -> int:
        """Return the descriptor for select: readable when there is data, or the writer has ended."""
        return self._pipe.fileno()

    def take(self) -> Iterator[Any]:
        """Yield the complete messages, oldest first; those not consumed are there for the next call."""
        os.set_blocking(self._pipe.fileno(), False)
        read = 0
        while not self.ended and read < _MOST_READ_BYTES:
            try:
                data = os.read(self._pipe.fileno(), _READ_BYTES)
            except BlockingIOError:
                break
            self._data += data
            read += len(data)
            self.ended = not data
        while len(self._data) >= _LENGTH.size:
            end = _LENGTH.size + _LENGTH.unpack_from(self._data)[0]
            if len(self._data) < end:
                break
            with memoryview(self._data) as whole:
                message = pickle.loads(whole[_LENGTH.size : end])  # safe: written by another process of evetac
            del self._data[:end]
            yield message
