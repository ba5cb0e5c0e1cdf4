"""Messages between processes: whole, in order, and without waiting."""

import multiprocessing
import os
from collections.abc import Iterator
from multiprocessing.connection import Connection

import numpy as np
import pytest

from evetac_cli.realtime.message_pipe import MessageReader, MessageWriter


@pytest.fixture
def pipe() -> Iterator[tuple[Connection, Connection]]:
    reading, writing = multiprocessing.Pipe(duplex=False)
    yield reading, writing
    for end in (reading, writing):
        end.close()


def test_all_arrive_in_order_whatever_their_size(pipe: tuple[Connection, Connection]) -> None:
    """Assert that messages larger than the pipe arrive whole and in order, as the reader makes room."""
    reader, writer = MessageReader(pipe[0]), MessageWriter(pipe[1])
    sent = [np.arange(size) for size in (0, 1, 1_000_000, 3, 300_000)]
    for message in sent:
        assert writer.put(message)
    came: list[np.ndarray] = []
    while writer.waiting_bytes:
        writer.send()
        came += reader.take()
    came += reader.take()
    assert [message.tolist() for message in came] == [message.tolist() for message in sent]
    assert not reader.ended


def test_a_full_pipe_keeps_nobody_waiting(pipe: tuple[Connection, Connection]) -> None:
    """Assert that `send` returns with the rest waiting, and that too much is refused, but for last words."""
    writer = MessageWriter(pipe[1], most_bytes=10_000_000)
    assert writer.put(bytes(9_000_000))
    writer.send()
    assert 0 < writer.waiting_bytes < 9_000_100
    assert not writer.flush(0.01)
    waiting = writer.waiting_bytes
    assert not writer.put(bytes(9_000_000))
    assert writer.waiting_bytes == waiting
    assert writer.put("last words", always=True)
    assert writer.waiting_bytes > waiting


def test_what_is_not_taken_stays(pipe: tuple[Connection, Connection]) -> None:
    """Assert that a reader may stop after any message, and finds the next ones at the next call."""
    reader, writer = MessageReader(pipe[0]), MessageWriter(pipe[1])
    for number in range(5):
        writer.put(number)
    assert writer.flush(1.0)
    assert next(reader.take()) == 0
    assert next(reader.take()) == 1
    assert list(reader.take()) == [2, 3, 4]
    assert list(reader.take()) == []


def test_a_writer_that_died(pipe: tuple[Connection, Connection]) -> None:
    """Assert that the end is noticed, and that a message which the writer died over is not delivered."""
    reader, writer = MessageReader(pipe[0]), MessageWriter(pipe[1])
    writer.put("whole")
    writer.flush(1.0)
    os.write(pipe[1].fileno(), (100).to_bytes(8, "little") + b"half")
    pipe[1].close()
    assert list(reader.take()) == ["whole"]
    assert reader.ended
    assert list(reader.take()) == []


def test_a_reader_that_died(pipe: tuple[Connection, Connection]) -> None:
    """Assert that a writer is told that nobody reads any more."""
    writer = MessageWriter(pipe[1])
    writer.put("anything")
    pipe[0].close()
    with pytest.raises(BrokenPipeError):
        writer.send()
