"""Unpack the compressed messages, chunks and files of ROS bags, never to more than a stated size.

Why so: the libraries unpack each in one call, whatever comes of it, and a few kB may unpack to all memory or all of a
disk. One chunk or message of a camera holds a few MB; a file of a bag that is compressed as a whole may be long, but
not a thousand times its size.
"""

import bz2
from collections.abc import Callable
from importlib import import_module
from typing import Any, BinaryIO

MOST_UNPACKED_BYTES = 64 << 20  # of a message or chunk
MOST_PLAIN_BYTES = 512 << 20  # of a chunk that is not packed
MOST_TIMES = 1000  # larger than compressed, of a whole file; beyond MOST_UNPACKED_BYTES
BLOCK_BYTES = 1 << 20


class TooLarge(ValueError):
    """A part holds more than any that is read."""

    def __init__(self, most: int) -> None:
        super().__init__(f"a compressed part unpacks to more than {most / 1e6:,.0f} MB")


def unpack(packing: str, packed: bytes, size: int) -> bytes:
    """Unpack a chunk or message that says how large it is, by the name that bags give the way of packing.

    ValueError where it ends early or has another size, TooLarge where it is larger than any that is read.
    """
    plain = packing in ("", "none")
    most = MOST_PLAIN_BYTES if plain else MOST_UNPACKED_BYTES
    if size > most:
        raise TooLarge(most)
    unpacked = packed if plain else _unpacked(_decompressor(packing), packed)
    if len(unpacked) != size:
        raise ValueError(f"{len(unpacked):,} bytes, not {size:,}")
    return unpacked


def unpack_message(packed: bytes) -> bytes:
    """Unpack a message that was compressed by itself, with zstd; ValueError as above."""
    return _unpacked(_decompressor("zstd"), packed)


def unpack_file(packed: BinaryIO, size: int, target: BinaryIO) -> bool:
    """Unpack a file of so many bytes that was compressed as a whole, with zstd; returns whether it has its end.

    TooLarge as above.
    """
    left = most = MOST_UNPACKED_BYTES + MOST_TIMES * size
    with zstd_module().open(packed, "rb") as unpacked:
        try:
            while block := unpacked.read1(BLOCK_BYTES):
                left -= len(block)
                if left < 0:
                    raise TooLarge(most)
                target.write(block)
        except EOFError:
            return False
    return True


def _unpacked(new: Callable[[], Any], packed: bytes) -> bytes:
    """Unpack within the limit; `new` starts a decompressor."""
    parts: list[bytes] = []
    left = MOST_UNPACKED_BYTES
    while packed:  # several compressed streams may follow each other
        stream = new()
        try:
            parts.append(stream.decompress(packed, max_length=left + 1))
        except Exception as error:  # each library raises its own
            raise ValueError(f"not unpacked: {str(error)[:100]}") from None
        left -= len(parts[-1])
        if left < 0:
            raise TooLarge(MOST_UNPACKED_BYTES)
        if not stream.eof:
            raise ValueError("a compressed part ends early")
        packed = stream.unused_data or b""
    return b"".join(parts)


def _decompressor(packing: str) -> Callable[[], Any]:
    if packing == "zstd":
        return zstd_module().ZstdDecompressor  # type: ignore[no-any-return]
    if packing == "lz4":
        return import_module("lz4.frame").LZ4FrameDecompressor  # type: ignore[no-any-return]
    if packing == "bz2":
        return bz2.BZ2Decompressor
    raise ValueError(f"packed in a way that is not read here: {packing[:20]!r}")


def zstd_module() -> Any:
    """The module for zstd: Python's own from 3.14 on, before that the one that rosbags brings along."""
    try:
        return import_module("compression.zstd")
    except ImportError:
        return import_module("backports.zstd")
