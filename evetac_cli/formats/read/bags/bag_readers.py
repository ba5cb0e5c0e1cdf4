"""Read one file of a bag in the order of the file: ROS 1 by rosbags, MCAP by mcap, and SQLite (`.db3`).

Why SQLite and not rosbags for `.db3`: rosbags sorts by the time of reception, and a recorder's clock may be set back.
Its ROS 1 reader sorts too, but takes its index as a list, which is put in the order of the file here.
"""

import bz2
import io
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from evetac_cli.errors import EvetacError, InputError
from evetac_cli.formats.read.damage import read_in_words, refuse_too_much, unpacked

MOST_RECORD_BYTES = 1 << 30  # of a record of MCAP, or a value of SQLite
DEFINED_AS = ("ros1msg", "ros2msg")  # encodings of definitions that `checksum` reads
MOST_DEFINITION_BYTES = 1 << 16  # those of ROS have a few thousand
OF_ROS1 = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
SQLITE_HEAD_BYTES, PAGE_BYTES_AT, PAGES_AT = 100, 16, 28  # size of the file's head, and offsets in it
REINDEX = "`rosbag reindex FILE` restores its index; it is part of ROS 1"

Record = tuple[int, int, bytes]  # number of the connection, time of reception in ns, message


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


def checksum(kind: str, text: str) -> str:
    """Return the checksum of a message type; empty if the text is not a definition or lacks an inner message.

    The checksum identifies a layout independently of its package's name. ROS 1 writes it into its bags; here rosbags
    computes it from a definition, also of ROS 2, in which times and headers, which ROS 2 writes differently, count as
    in ROS 1. A text is only parsed: nothing is registered, which would turn it into code.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not text.strip() or len(text) > MOST_DEFINITION_BYTES:
        return ""
    name, store, ros1 = full_name(kind), get_typestore(Stores.EMPTY), get_typestore(Stores.ROS1_NOETIC)
    try:
        store.fielddefs.update(get_types_from_msg(text.replace("\r", ""), name))
        store.fielddefs.update({of_ros1: ros1.fielddefs[of_ros1] for of_ros1 in OF_ROS1})
        return store.generate_msgdef(name)[1]
    except Exception:  # rosbags raises all kinds for texts that are no definitions
        return ""


def full_name(kind: str) -> str:
    """Return a type as `package/msg/Name`; ROS 1 leaves out `msg`."""
    package, _, name = kind.partition("/")
    return f"{package}/msg/{name}" if name and "/" not in name else kind


class BagFile:
    """A file of a bag: its connections and messages, notes on missing data, and whether data is known to be missing."""

    def __init__(self, path: Path, where: str) -> None:
        """Read the list of messages; raise InputError if none can be read. where: the file's name in messages."""
        self.path, self.where = path, where
        self.notes: list[str] = []
        self.cut_short = False
        self._counts: Counter[int] = Counter()
        self.connections = [one._replace(msgcount=self._counts[one.number]) for one in self._read()]

    def messages(self, numbers: Collection[int]) -> Iterator[Record]:
        """Yield all messages of some connections in the order of the file."""
        raise NotImplementedError

    def _read(self) -> list[Connection]:
        """Return the connections, having counted the messages of each."""
        raise NotImplementedError


class Rosbag1File(BagFile):
    """A bag of ROS 1, version 2.0."""

    def messages(self, numbers: Collection[int]) -> Iterator[Record]:
        """Yield all messages of some connections in the order of the file."""
        import lz4.frame
        from rosbags.rosbag1 import Reader

        decompressors = {bz2.decompress: bz2.BZ2Decompressor, lz4.frame.decompress: lz4.frame.LZ4FrameDecompressor}
        with Reader(self.path) as reader:
            for at, chunk in reader.chunks.items():
                if chunk.decompressor in decompressors:
                    limited = partial(unpacked, decompressors[chunk.decompressor], where=self.where)
                    reader.chunks[at] = chunk._replace(decompressor=limited)
            rows = [row for number in numbers for row in reader.indexes[number]]
            rows.sort(key=lambda row: (row.chunk_pos, row.offset))
            first = next((one for one in reader.connections if one.id in numbers), None)
            if first is not None:
                reader.indexes[first.id] = rows
                for connection, time_ns, message in reader.messages([first]):
                    yield connection.id, time_ns, message

    def _read(self) -> list[Connection]:
        from rosbags.rosbag1 import Reader

        with read_in_words(self.where, "the bag is cut short or damaged", REINDEX), Reader(self.path) as reader:
            self._counts.update({number: len(index) for number, index in reader.indexes.items()})
            return [
                Connection(one.id, one.topic, one.msgtype, "ros1", one.msgdef.data, one.digest)
                for one in reader.connections
            ]


class McapFile(BagFile):
    """An MCAP file of ROS 2 (CDR) or ROS 1, closed or not; without an index, because it is read from the start."""

    def messages(self, numbers: Collection[int]) -> Iterator[Record]:
        """Yield all messages of some connections in the order of the file."""
        from mcap.records import Message

        for record in self._records():
            if isinstance(record, Message) and record.channel_id in numbers:
                yield record.channel_id, record.log_time, record.data

    def _read(self) -> list[Connection]:
        from mcap.records import Channel, Message, Schema

        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for record in self._records():
            if isinstance(record, Message):
                self._counts[record.channel_id] += 1
            elif isinstance(record, Schema):
                schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                channels.setdefault(record.id, record)
        kept = f"kept {self._counts.total():,} messages"
        if not self._counts and self.cut_short:
            found = f"{self._lost_bytes:,} bytes that are not a complete chunk"
            message = "no message can be read: the bag is cut short or damaged"
            raise InputError(message, where=self.where, found=found)
        if self._lost_bytes:
            lost = f"the last {self._lost_bytes:,} bytes are lost, unless `mcap recover` saves some"
            self.notes.append(f"cut short or damaged: {kept} of complete chunks; {lost}")
        elif self.cut_short:
            self.notes.append(f"the bag was not closed, probably because its recorder was killed: {kept}")
        connections = []
        for channel in channels.values():
            schema = schemas.get(channel.schema_id)
            name = full_name(schema.name) if schema else ""
            text = schema.data.decode(errors="replace") if schema and schema.encoding in DEFINED_AS else ""
            connections.append(Connection(channel.id, channel.topic, name, channel.message_encoding, text))
        return connections

    def _records(self) -> Iterator[Any]:
        """Yield all records up to the end or the first damage, and note the loss."""
        import zstandard
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader, breakup_chunk

        self._lost_bytes = 0  # after the last whole record
        with self.path.open("rb", buffering=0) as raw, _ExactReader(raw) as file:
            end = 0
            try:
                for record in StreamReader(file, emit_chunks=True, record_size_limit=MOST_RECORD_BYTES).records:
                    if isinstance(record, Chunk):
                        own = zstandard.frame_content_size(record.data) if record.compression == "zstd" else 0
                        refuse_too_much(max(record.uncompressed_size, own), len(record.data), self.where)
                        yield from breakup_chunk(record, validate_crc=True)
                    else:
                        yield record
                    end = file.tell()
            except (EvetacError, MemoryError, OSError):
                raise
            except Exception:  # mcap and the libraries that unpack raise all kinds where a file is cut or damaged
                self.cut_short, self._lost_bytes = True, file.seek(0, 2) - end


class _ExactReader(io.BufferedReader):
    """A file whose end within a record is an error; mcap itself takes what is left of a message for a whole one."""

    def read(self, size: int | None = -1) -> bytes:
        content = super().read(size)
        if size is not None and len(content) < size:
            raise EOFError
        return content


class Db3File(BagFile):
    """A file of SQLite: its table is read, never an index, and no view or function that the file defines is run."""

    def messages(self, numbers: Collection[int]) -> Iterator[Record]:
        """Yield all messages of some connections in the order of the file."""
        with closing(self._connected()) as database:
            marks = ", ".join("?" * len(numbers))
            query = f"SELECT topic_id, timestamp, data FROM messages NOT INDEXED WHERE topic_id IN ({marks})"
            for number, time_ns, content in database.execute(f"{query} ORDER BY rowid", tuple(numbers)):
                if not isinstance(content, bytes):
                    raise ValueError("a row has no message")
                yield number, time_ns, content

    def _read(self) -> list[Connection]:
        try:
            with closing(self._connected()) as database:
                definitions = self._check_tables(database)
                for number, time_ns in database.execute("SELECT topic_id, timestamp FROM messages ORDER BY rowid"):
                    if type(number) is not int or type(time_ns) is not int:
                        raise InputError("topic or time of a message is no number", where=self.where)
                    self._counts[number] += 1
                rows = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        except sqlite3.DatabaseError as error:
            missing = _missing_bytes(self.path)
            lost = f"; {missing:,} bytes at its end are missing" if missing > 0 else ""
            hint = "if the original is longer, copy it again; else `sqlite3 FILE .recover` saves what can still be read"
            message = "the bag is cut short or damaged"
            raise InputError(message, where=self.where, found=f"{error}{lost}", hint=hint) from None
        return [
            Connection(int(number), str(name), str(kind), str(encoding), definitions.get(kind, ""))
            for number, name, kind, encoding in rows
        ]

    def _connected(self) -> sqlite3.Connection:
        uri = f"file:{quote(str(self.path.resolve()))}?mode=ro&immutable=1"
        database = sqlite3.connect(uri, uri=True)
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_RECORD_BYTES // 2)
        database.execute("PRAGMA trusted_schema = OFF")
        return database

    def _check_tables(self, database: sqlite3.Connection) -> dict[str, str]:
        """Return the definitions of message types; InputError unless topics and messages are plain tables.

        A view or virtual table could be anything.
        """
        rows = database.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0").fetchall()
        names = {str(name) for (name,) in rows}
        if not {"topics", "messages"} <= names:
            found = ", ".join(sorted(names))[:200] or "no table"
            raise InputError("not a ROS 2 bag", where=self.where, expected="tables topics and messages", found=found)
        if _missing_bytes(self.path) > 0:
            raise sqlite3.DatabaseError("the file is shorter than it states")
        if "message_definitions" not in names:
            return {}
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        return {str(kind): str(text) for kind, how, text in database.execute(query) if how == "ros2msg"}


def _missing_bytes(path: Path) -> int:
    """Return the bytes by which a file of SQLite is shorter than its head states."""
    with path.open("rb") as file:
        head = file.read(SQLITE_HEAD_BYTES)
        size = file.seek(0, 2)
    page_bytes = int.from_bytes(head[PAGE_BYTES_AT : PAGE_BYTES_AT + 2])
    return int.from_bytes(head[PAGES_AT : PAGES_AT + 4]) * (1 << 16 if page_bytes == 1 else page_bytes) - size
