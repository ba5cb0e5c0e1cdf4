"""Unpack the compressed messages, chunks and files of ROS bags, never to more than a stated size.

Why so: rosbags unpacks each in one call, whatever comes of it, and a few kB may unpack to all memory or all of a disk.
It looks its functions up in tables and modules by name; `limit_unpacking` puts ours there. One chunk or message of a
camera holds a few MB; a file of a bag that is compressed as a whole may be long, but not a thousand times its size.
"""

import bz2
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

MOST_UNPACKED_BYTES = 64 << 20  # of a message or chunk
MOST_TIMES = 1000  # larger than compressed, of a whole file; beyond MOST_UNPACKED_BYTES


def unpack(new: Callable[[], Any], packed: bytes) -> bytes:
    """Unpack one message or chunk; `new` starts a decompressor. ValueError where it is too large or ends early."""
    parts: list[bytes] = []
    left = MOST_UNPACKED_BYTES
    while packed:  # several compressed streams may follow each other
        stream = new()
        parts.append(stream.decompress(packed, max_length=left + 1))
        left -= len(parts[-1])
        if left < 0:
            raise _too_large(MOST_UNPACKED_BYTES)
        if not stream.eof:
            raise ValueError("a compressed part ends early")
        packed = stream.unused_data or b""
    return b"".join(parts)


def limit_unpacking() -> None:
    """Make rosbags unpack within limits, in this process from now on; AttributeError if this rosbags is another."""
    reader1: Any = import_module("rosbags.rosbag1.reader")
    reader2: Any = import_module("rosbags.rosbag2.reader")
    mcap: Any = import_module("rosbags.rosbag2.storage_mcap")
    lz4: Any = import_module("lz4.frame")
    if isinstance(reader2.zstd, _LimitedZstd):
        return
    zstd = _LimitedZstd(reader2.zstd)
    mcap.DECOMPRESSORS["zstd"] = lambda packed, _: zstd.decompress(packed)
    mcap.DECOMPRESSORS["lz4"] = lambda packed, _: unpack(lz4.LZ4FrameDecompressor, packed)
    reader1.decompressors["lz4"] = lambda packed: unpack(lz4.LZ4FrameDecompressor, packed)
    reader1.decompressors["bz2"] = lambda packed: unpack(bz2.BZ2Decompressor, packed)
    reader2.zstd = zstd


class _LimitedZstd:
    """What rosbags uses of the module zstd: `decompress` for a message or chunk, `open` for a whole file."""

    def __init__(self, module: Any) -> None:
        self._module = module

    def decompress(self, packed: bytes) -> bytes:
        return unpack(self._module.ZstdDecompressor, packed)

    @contextmanager
    def open(self, file: BinaryIO, mode: str) -> Iterator["_LimitedReader"]:
        most = MOST_UNPACKED_BYTES + MOST_TIMES * Path(file.name).stat().st_size
        with self._module.open(file, mode) as unpacked:
            yield _LimitedReader(unpacked, most)


class _LimitedReader:
    """A file to read from, up to so many bytes; ValueError beyond."""

    def __init__(self, file: BinaryIO, most: int) -> None:
        self._file = file
        self._most = self._left = most

    def read(self, size: int = io.DEFAULT_BUFFER_SIZE) -> bytes:
        block = self._file.read(size)
        self._left -= len(block)
        if self._left < 0:
            raise _too_large(self._most)
        return block


def _too_large(most: int) -> ValueError:
    return ValueError(f"a compressed part unpacks to more than {most / 1e6:,.0f} MB")
