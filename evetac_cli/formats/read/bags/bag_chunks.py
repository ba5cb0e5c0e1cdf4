"""The common part of ROS 1 bags and MCAP files: connections, and consecutive chunks of messages.

Why this is not left to rosbags or mcap: both skip or refuse data that the index at the end of a file does not list, but
a recorder that was killed wrote no index. They also unpack all chunks that claim the same time at once. Instead, a
table of the chunks is built here by walking from record to record, as for AEDAT4, and all complete chunks are read. The
notes report missing data.
"""

import heapq
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

from evetac_cli.errors import InputError
from evetac_cli.formats.read.bags.rosbag_unpacking import TooLarge, unpack

MOST_HELD_BYTES = 256 << 20  # of messages that wait for earlier messages of a later chunk
MOST_RECORD_BYTES = 1 << 24  # of a record other than chunks and messages: a definition has some kB
RUN_BYTES = 1 << 20  # of messages outside of chunks that are treated as one chunk

Record = tuple[int, int, bytes | memoryview]  # number of the connection, time of reception in ns, message


class Connection(NamedTuple):
    """A topic of one file with the type of its messages.

    - number: within the file
    - msgtype: as `package/msg/Name`
    - encoding: of the messages; cdr in ROS 2, ros1 in ROS 1
    - definition, digest: of the type, as text, and its checksum in ROS 1; each empty if it is unknown
    """

    number: int
    topic: str
    msgtype: str
    encoding: str
    definition: str = ""
    digest: str = ""
    msgcount: int = 0

    @property
    def ros2(self) -> bool:
        """Whether its messages have the encoding of ROS 2."""
        return self.encoding == "cdr"


class BagChunk(NamedTuple):
    """The position of a chunk's content in the file, its compression, and the messages in it.

    counts: messages by the number of their connection; None if the file does not state them.
    """

    at: int
    size: int
    packing: str
    unpacked: int
    crc: int  # of the unpacked content; 0: unknown
    start_ns: int
    counts: dict[int, int] | None


@dataclass
class Table:
    """The contents of a file, notes on missing data, and whether data is known to be missing."""

    connections: dict[int, Connection] = field(default_factory=dict)
    chunks: list[BagChunk] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    cut_short: bool = False
    # Connections whose messages may be stored in another order than they were received.
    disordered: set[int] = field(default_factory=set)
    spans_ns: dict[int, tuple[int, int]] = field(default_factory=dict)  # reception of their first and last message


class ChunkedFile:
    """A file of chunks: its table, and its messages. Subclasses find the records in a file and in a chunk."""

    def __init__(self, path: Path, where: str) -> None:
        """Read the table; raise InputError if the file is incomplete and has no readable message.

        where: the file's name in messages.
        """
        self.path, self.where = path, where
        self.table = Table()
        self.stated: int | None = None  # number of messages that the file states
        self._run: BagChunk | None = None  # of messages outside of chunks
        self._listed: list[int] | None = None  # positions of chunks in the index of the file
        self._damages: list[tuple[int, int]] = []  # position and number of damaged bytes
        with path.open("rb") as file:
            size = file.seek(0, 2)
            end, closed = self._walk(file, size)
            self._end_run()
            if not closed:
                self._distrust_last_index()
            broken = self._count(file)
        self._say_what_is_missing(size - end, closed, broken)
        self.connections = [
            one._replace(msgcount=sum((chunk.counts or {}).get(number, 0) for chunk in self.table.chunks))
            for number, one in sorted(self.table.connections.items())
        ]

    def messages(self, numbers: Collection[int], lost: Counter[str], *, by_reception: bool) -> Iterator[Record]:
        """Yield all messages of some connections in the file's order; damaged chunks are counted in `lost`.

        by_reception: in order of reception instead. Chunks overlap in time. A message waits until no later chunk can
        contain an earlier one, or too many wait.
        """
        waiting: list[tuple[int, int, int, bytes]] = []
        waiting_bytes = count = 0
        wanted = [chunk for chunk in self.table.chunks if any((chunk.counts or {}).get(one) for one in numbers)]
        if by_reception:
            wanted.sort(key=lambda chunk: chunk.start_ns)
        with self.path.open("rb") as file:
            for chunk in wanted:
                while waiting and (waiting[0][0] < chunk.start_ns or waiting_bytes > MOST_HELD_BYTES):
                    time_ns, _, number, message = heapq.heappop(waiting)
                    waiting_bytes -= len(message)
                    yield number, time_ns, message
                try:
                    records = list(self._records(self._content(file, chunk)))
                except TooLarge:
                    raise
                except ValueError as error:
                    lost[str(error)] += 1
                    continue
                for record in records:
                    if isinstance(record, Connection) or record[0] not in numbers:
                        continue
                    message = bytes(record[2])
                    if not by_reception:
                        yield record[0], record[1], message
                        continue
                    heapq.heappush(waiting, (record[1], count, record[0], message))
                    count, waiting_bytes = count + 1, waiting_bytes + len(message)
        while waiting:
            time_ns, _, number, message = heapq.heappop(waiting)
            yield number, time_ns, message

    def _walk(self, file: BinaryIO, size: int) -> tuple[int, bool]:
        """Fill the table record by record; return the end of the last complete one, and whether the file was closed.

        Raises InputError for a file that cannot be read at all.
        """
        raise NotImplementedError

    def _records(self, content: bytes) -> Iterator[Connection | Record]:
        """Yield the connections and messages of an unpacked chunk; raise ValueError if it is damaged."""
        raise NotImplementedError

    def _crc(self, content: bytes) -> int:
        """Return the checksum of a chunk's content as the format defines it."""
        raise NotImplementedError

    def _take_message(self, at: int, size: int, number: int, time_ns: int) -> None:
        """Add a message outside of chunks: it is joined with the messages right before it, as one chunk."""
        self._take_times(number, [time_ns])
        run = self._run
        if run is None or run.at + run.size != at or run.size + size > RUN_BYTES:
            self._end_run()
            run = BagChunk(at, 0, "", 0, 0, time_ns, {})
        counts = run.counts or {}
        counts[number] = counts.get(number, 0) + 1
        length = run.size + size
        self._run = run._replace(size=length, unpacked=length, start_ns=min(run.start_ns, time_ns), counts=counts)

    def _end_run(self) -> None:
        if self._run is not None:
            self.table.chunks.append(self._run)
            self._run = None

    def _take_chunk(self, chunk: BagChunk) -> None:
        self._end_run()
        self.table.chunks.append(chunk)

    def _take_index(self, number: int, rows: list[tuple[int, int]]) -> None:
        """Store the messages of a connection in the last chunk, each with its time of reception and position."""
        if not self.table.chunks:
            return
        chunk = self.table.chunks[-1]
        times = [time_ns for time_ns, _ in sorted(rows, key=lambda row: row[1])]
        self._take_times(number, times)
        if times:
            start_ns = min(times) if chunk.counts is None else min(*times, chunk.start_ns)
            chunk = chunk._replace(start_ns=start_ns)
        self.table.chunks[-1] = chunk._replace(counts={**(chunk.counts or {}), number: len(rows)})

    def _take_times(self, number: int, times_ns: list[int]) -> None:
        """Note whether the next messages of a connection were received before those stored before them."""
        for time_ns in times_ns:
            first_ns, latest_ns = self.table.spans_ns.get(number, (time_ns, time_ns))
            if time_ns < latest_ns:
                self.table.disordered.add(number)
            self.table.spans_ns[number] = first_ns, time_ns

    def _distrust_last_index(self) -> None:
        """Mark the last chunk before damaged bytes to be counted: some of its indexes may be missing."""
        if self.table.chunks:
            self.table.chunks[-1] = self.table.chunks[-1]._replace(counts=None)

    def _past(self, at: int, listed: Callable[[], Iterable[int]]) -> int | None:
        """Return the begin of the next chunk after damaged bytes, from the index of the file; None without an entry."""
        if self._listed is None:
            self._listed = sorted(set(listed()))
        following = bisect_right(self._listed, at)
        if following == len(self._listed):
            return None
        self._end_run()
        self._distrust_last_index()
        self._damages.append((at, self._listed[following] - at))
        return self._listed[following]

    def _content(self, file: BinaryIO, chunk: BagChunk) -> bytes:
        file.seek(chunk.at)
        packed = file.read(chunk.size)
        if len(packed) < chunk.size:
            raise ValueError("the file has become shorter")
        content = unpack(chunk.packing, packed, chunk.unpacked)
        if chunk.crc and self._crc(content) != chunk.crc:
            raise ValueError("the checksum does not match")
        return content

    def _count(self, file: BinaryIO) -> Counter[str]:
        """Count the messages of chunks that the file does not index; damaged chunks are removed and counted."""
        broken: Counter[str] = Counter()
        whole: list[BagChunk] = []
        for chunk in self.table.chunks:
            if chunk.counts is not None and chunk.counts.keys() <= self.table.connections.keys():
                whole.append(chunk)
                continue
            counts: Counter[int] = Counter()
            start_ns = None
            try:
                for record in self._records(self._content(file, chunk)):
                    if isinstance(record, Connection):
                        self.table.connections.setdefault(record.number, record)
                    else:
                        counts[record[0]] += 1
                        start_ns = record[1] if start_ns is None else min(start_ns, record[1])
            except TooLarge:
                raise
            except ValueError as error:
                broken[str(error)] += 1
                continue
            self.table.disordered.update(counts)  # unknown without an index
            whole.append(chunk._replace(counts=dict(counts), start_ns=start_ns or 0))
        self.table.chunks = whole
        return broken

    def _say_what_is_missing(self, lost_bytes: int, closed: bool, broken: Counter[str]) -> None:
        table = self.table
        count = sum(sum((chunk.counts or {}).values()) for chunk in table.chunks)
        if (not closed or broken) and not count:
            found = next(iter(broken), f"{lost_bytes:,} bytes that are not a complete chunk")
            message = "no message can be read: the bag is cut short or damaged"
            raise InputError(message, where=self.where, found=found)
        if self._damages:
            sizes = f"{sum(size for _, size in self._damages):,} bytes, the first at byte {self._damages[0][0]:,}"
            table.notes.append(f"damaged: lost {sizes}; reading continued after them with the file's index")
        if broken:
            table.notes.append(f"left out {broken.total():,} damaged chunks ({next(iter(broken))})")
        if not closed and lost_bytes:
            table.notes.append(
                f"cut short or damaged: kept {count:,} messages of complete chunks;"
                f" the last {lost_bytes:,} bytes are lost"
            )
        elif not closed:
            table.notes.append(
                f"the bag was not closed, probably because its recorder was killed: kept {count:,} messages"
            )
        elif self.stated is not None and self.stated != count and not broken and not self._damages:
            table.notes.append(f"the file states {self.stated:,} messages but has {count:,}")
        table.cut_short = not closed or bool(broken) or bool(self._damages)
