"""Read ROS 1 bags, version 2.0, closed or not: records of a header and data.

    length, header: fields `name=value`, each with its length; length, data
    op 3 bag header    5 chunk: connections (7) and messages (2)    4 index of one connection of the chunk before
    op 7 connection    6 position of a chunk, and its times         http://wiki.ros.org/Bags/Format/2.0

While a chunk is being written, its record has length 0, so its content that was not packed follows as records.
"""

import re
import struct
from collections.abc import Iterator, Mapping
from functools import partial
from typing import BinaryIO

from evetac_cli.errors import InputError
from evetac_cli.formats.read.bags.bag_chunks import MOST_RECORD_BYTES, BagChunk, ChunkedFile, Connection, Record
from evetac_cli.formats.read.bags.message_definitions import full_name

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG, INDEX, CHUNK, CHUNK_PLACE, CONNECTION = 2, 3, 4, 5, 6, 7
LENGTH = struct.Struct("<I")
PLACE = struct.Struct("<Q")
TIME = struct.Struct("<II")  # s, ns
INDEX_ROW = struct.Struct("<8sI")  # of a message: time, position in the chunk
MOST_HEADER_BYTES = 1 << 16

Header = Mapping[bytes, bytes]


class Rosbag1File(ChunkedFile):
    """A bag of ROS 1."""

    def _walk(self, file: BinaryIO, size: int) -> tuple[int, bool]:
        at = len(MAGIC)
        self._index_at = self._places = self._stated_places = 0
        while at < size:
            record = _record(file, at, size)
            if record is not None and self._take(file, at, *record):
                at = record[2]
                continue
            later = self._past(at, partial(_listed, file, self._index_at, size))
            if later is None:
                return at, False
            at = later
        return at, self._index_at > 0 and self._places == self._stated_places

    def _take(self, file: BinaryIO, at: int, header: Header, begin: int, end: int) -> bool:
        """Add a record to the table; return False if its content does not match its type."""
        try:
            kind = _number(header, b"op")
            if kind == BAG:
                if header.get(b"encryptor"):
                    raise InputError("the bag is encrypted", where=self.where, found=_text(header, b"encryptor"))
                self._index_at = PLACE.unpack(header[b"index_pos"])[0]
                self._stated_places = _number(header, b"chunk_count")
            elif kind == CHUNK:
                packing, unpacked = _text(header, b"compression"), _number(header, b"size")
                if end > begin:
                    self._take_chunk(BagChunk(begin, end - begin, packing, unpacked, 0, 0, None))
            elif kind == MESSAGE:
                self._take_message(at, end - at, _number(header, b"conn"), _time_ns(header[b"time"]))
            elif kind == CHUNK_PLACE:
                self._places += 1
            elif kind in (INDEX, CONNECTION):
                if end - begin > MOST_RECORD_BYTES:
                    return False
                file.seek(begin)
                content = file.read(end - begin)
                if kind == CONNECTION:
                    connection = _connection(header, content)
                    self.table.connections.setdefault(connection.number, connection)
                else:
                    rows = [(_time_ns(time), at) for time, at in INDEX_ROW.iter_unpack(content)]
                    self._take_index(_number(header, b"conn"), rows)
            return kind in (MESSAGE, BAG, INDEX, CHUNK, CHUNK_PLACE, CONNECTION)
        except (KeyError, struct.error, ValueError):
            return False

    def _records(self, content: bytes) -> Iterator[Connection | Record]:
        view = memoryview(content)
        end = 0
        try:
            while end < len(content):
                header, begin = _header(content, end)
                (length,) = LENGTH.unpack_from(content, begin)
                begin, end = begin + LENGTH.size, begin + LENGTH.size + length
                if end > len(content):
                    raise ValueError("a record ends early")
                kind = _number(header, b"op")
                if kind == MESSAGE:
                    yield _number(header, b"conn"), _time_ns(header[b"time"]), view[begin:end]
                elif kind == CONNECTION:
                    yield _connection(header, content[begin:end])
        except (KeyError, struct.error) as error:
            raise ValueError(f"a record is damaged: {error}") from None

    def _crc(self, content: bytes) -> int:
        return 0


def _record(file: BinaryIO, at: int, size: int) -> tuple[Header, int, int] | None:
    """Return the header of a record, and begin and end of its data; None if the record is incomplete."""
    file.seek(at)
    start = file.read(LENGTH.size)
    length = LENGTH.unpack(start)[0] if len(start) == LENGTH.size else 0
    if not 0 < length <= MOST_HEADER_BYTES:
        return None
    rest = file.read(length + LENGTH.size)
    if len(rest) < length + LENGTH.size:
        return None
    try:
        header, _ = _header(start + rest, 0)
    except (struct.error, ValueError):
        return None
    begin = at + LENGTH.size + length + LENGTH.size
    end = begin + LENGTH.unpack(rest[length:])[0]
    return (header, begin, end) if end <= size else None


def _header(content: bytes, at: int) -> tuple[Header, int]:
    """Return the fields of a header and its end; raise ValueError or struct.error if it is damaged."""
    (length,) = LENGTH.unpack_from(content, at)
    at += LENGTH.size
    stop = at + length
    if stop > len(content):
        raise ValueError("a header ends early")
    fields: dict[bytes, bytes] = {}
    while at < stop:
        (length,) = LENGTH.unpack_from(content, at)
        at += LENGTH.size
        if at + length > stop:
            raise ValueError("a field ends early")
        name, _, value = content[at : at + length].partition(b"=")
        fields[name] = value
        at += length
    return fields, stop


def _connection(header: Header, content: bytes) -> Connection:
    fields, _ = _header(LENGTH.pack(len(content)) + content, 0)
    topic = re.sub("/+", "/", _text(header, b"topic")).rstrip("/")
    kind, text = full_name(_text(fields, b"type")), _text(fields, b"message_definition")
    return Connection(_number(header, b"conn"), topic, kind, "ros1", text, _text(fields, b"md5sum"))


def _number(header: Header, name: bytes) -> int:
    return int.from_bytes(header[name], "little")


def _text(header: Header, name: bytes) -> str:
    return header[name].decode(errors="replace")


def _time_ns(value: bytes) -> int:
    seconds, nanoseconds = TIME.unpack(value)
    return int(seconds) * 10**9 + int(nanoseconds)


def _listed(file: BinaryIO, at: int, size: int) -> Iterator[int]:
    """Yield the positions of the chunks from the index at the end of the bag, if there is one."""
    while 0 < at < size and (record := _record(file, at, size)) is not None:
        header, _, at = record
        if header.get(b"op") == bytes([CHUNK_PLACE]) and len(header.get(b"chunk_pos", b"")) == PLACE.size:
            (chunk_at,) = PLACE.unpack(header[b"chunk_pos"])
            if chunk_at < size:
                yield chunk_at
