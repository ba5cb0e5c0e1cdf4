"""Read MCAP files of ROS 2 (CDR) or ROS 1, closed or not, with or without an index, using records of the library mcap.

A file is a magic number followed by records, each with a type (1 byte), a length (8 bytes) and its content. Messages
are in chunks or separate. Each chunk is followed by one index per channel. At the end there are a summary, a footer
with the position of the summary, and the magic number again: https://mcap.dev/spec
"""

import struct
from collections.abc import Iterator
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import BinaryIO
from zlib import crc32

from evetac_cli.formats.read.bags.bag_chunks import MOST_RECORD_BYTES, BagChunk, ChunkedFile, Connection, Record
from evetac_cli.formats.read.bags.message_definitions import full_name

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, STATISTICS = 2, 3, 4, 5, 6, 7, 8, 11
HEAD = struct.Struct("<BQ")  # type and length
CHUNK_HEAD = struct.Struct("<QQQII")  # first and last time, unpacked size, checksum, length of the compression's name
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
INDEX_HEAD = struct.Struct("<HI")  # channel, size of the rest
INDEX_ROW = struct.Struct("<QQ")  # of a message: log time, position in the chunk
SUMMARY_AT = struct.Struct("<Q")  # the first field of the footer
COUNT = struct.Struct("<Q")  # the first field of the statistics
FOOTER_BYTES = HEAD.size + 20 + len(MAGIC)
CHUNK_AT_BYTE = 16  # offset of the position in a chunk's entry in the summary
MOST_PACKING_BYTES = 32  # of the name of a compression
DEFINED_AS = ("ros1msg", "ros2msg")  # encodings of definitions that message_definitions reads


class McapFile(ChunkedFile):
    """An MCAP file."""

    def __init__(self, path: Path, where: str) -> None:
        self._schemas: dict[int, tuple[str, str]] = {}  # name and definition
        super().__init__(path, where)

    def _walk(self, file: BinaryIO, size: int) -> tuple[int, bool]:
        at = len(MAGIC)
        while at + HEAD.size <= size:
            file.seek(at)
            kind, length = HEAD.unpack(file.read(HEAD.size))
            end = at + HEAD.size + length
            if kind and end <= size and self._take(file, kind, at, length):
                at = end
                if kind == FOOTER:
                    file.seek(at)
                    return (size, True) if file.read(len(MAGIC)) == MAGIC else (at, False)
                continue
            later = self._past(at, partial(_listed, file, size))
            if later is None:
                break
            at = later
        return at, False

    def _take(self, file: BinaryIO, kind: int, at: int, length: int) -> bool:
        """Add a record to the table; return False if its content does not match its type."""
        if kind == CHUNK:
            return self._take_head(file, at + HEAD.size, length)
        if kind == MESSAGE:
            content = file.read(MESSAGE_HEAD.size)
            if len(content) < MESSAGE_HEAD.size or length < MESSAGE_HEAD.size:
                return False
            number, _, time_ns, _ = MESSAGE_HEAD.unpack(content)
            self._take_message(at, HEAD.size + length, number, time_ns)
            return True
        if kind not in (SCHEMA, CHANNEL, MESSAGE_INDEX, STATISTICS):
            return True
        if length > MOST_RECORD_BYTES:
            return False
        content = file.read(length)
        try:
            if kind == MESSAGE_INDEX:
                number, index_bytes = INDEX_HEAD.unpack_from(content)
                rows = content[INDEX_HEAD.size : INDEX_HEAD.size + index_bytes]
                self._take_index(number, list(INDEX_ROW.iter_unpack(rows)))
            elif kind == STATISTICS:
                (self.stated,) = COUNT.unpack_from(content)
            elif (connection := self._defined(kind, content)) is not None:
                self.table.connections.setdefault(connection.number, connection)
        except (struct.error, ValueError):
            return False
        return True

    def _take_head(self, file: BinaryIO, at: int, length: int) -> bool:
        head = file.read(CHUNK_HEAD.size + MOST_PACKING_BYTES + 8)
        if len(head) < CHUNK_HEAD.size:
            return False
        start_ns, _, unpacked, crc, name_bytes = CHUNK_HEAD.unpack_from(head)
        begin = CHUNK_HEAD.size + name_bytes + 8
        if name_bytes > MOST_PACKING_BYTES or begin > length or begin > len(head):
            return False
        packing = head[CHUNK_HEAD.size : begin - 8].decode(errors="replace")
        (packed,) = struct.unpack_from("<Q", head, begin - 8)
        if begin + packed > length:
            return False
        self._take_chunk(BagChunk(at + begin, packed, packing, unpacked, crc, start_ns, None))
        return True

    def _records(self, content: bytes) -> Iterator[Connection | Record]:
        view = memoryview(content)
        end = 0
        while end < len(content):
            if end + HEAD.size > len(content):
                raise ValueError("a record ends early")
            kind, length = HEAD.unpack_from(content, end)
            at, end = end + HEAD.size, end + HEAD.size + length
            if end > len(content):
                raise ValueError("a record ends early")
            if kind == MESSAGE:
                if length < MESSAGE_HEAD.size:
                    raise ValueError("a message has no header")
                number, _, time_ns, _ = MESSAGE_HEAD.unpack_from(content, at)
                yield number, time_ns, view[at + MESSAGE_HEAD.size : end]
            elif kind in (SCHEMA, CHANNEL) and (connection := self._defined(kind, content[at:end])) is not None:
                yield connection

    def _defined(self, kind: int, content: bytes) -> Connection | None:
        """Parse a schema or channel record; return a channel's connection; raise ValueError if it is damaged."""
        from mcap.data_stream import ReadDataStream
        from mcap.exceptions import McapError
        from mcap.records import Channel, Schema

        try:
            if kind == SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(content)))
                text = schema.data.decode(errors="replace") if schema.encoding in DEFINED_AS else ""
                self._schemas.setdefault(schema.id, (full_name(schema.name), text))
                return None
            channel = Channel.read(ReadDataStream(BytesIO(content)))
        except (McapError, struct.error) as error:
            raise ValueError(f"a definition is damaged: {error}") from None
        name, text = self._schemas.get(channel.schema_id, ("", ""))
        return Connection(channel.id, channel.topic, name, channel.message_encoding, text)

    def _crc(self, content: bytes) -> int:
        return crc32(content)


def _listed(file: BinaryIO, size: int) -> Iterator[int]:
    """Yield the positions of the chunks from the summary at the end of the file, if there is one."""
    file.seek(max(0, size - FOOTER_BYTES))
    footer = file.read(FOOTER_BYTES)
    if len(footer) < FOOTER_BYTES or footer[0] != FOOTER or not footer.endswith(MAGIC):
        return
    (at,) = SUMMARY_AT.unpack_from(footer, HEAD.size)
    while len(MAGIC) < at < size - FOOTER_BYTES:
        file.seek(at)
        kind, length = HEAD.unpack(file.read(HEAD.size))
        if kind == CHUNK_INDEX and length >= CHUNK_AT_BYTE + 8:
            (chunk_at,) = struct.unpack("<Q", file.read(CHUNK_AT_BYTE + 8)[CHUNK_AT_BYTE:])
            if chunk_at < size:
                yield chunk_at
        at += HEAD.size + length
