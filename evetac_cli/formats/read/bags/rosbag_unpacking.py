"""Unpack the compressed messages, chunks and files of ROS bags, never to more than a stated size.

Reason: the libraries unpack in one call without a limit, and a few kB may fill the memory or a disk. A chunk or message
of a camera has a few MB. A file that is compressed as a whole may be long, but not a thousand times its size.
"""

import bz2
from collections.abc import Callable
from importlib import import_module
from typing import Any, BinaryIO

MOST_UNPACKED_BYTES = 64 << 20  # of a message or chunk
MOST_PLAIN_BYTES = 512 << 20  # of a chunk that is not compressed
MOST_TIMES = 1000  # largest ratio of unpacked to packed size of a whole file larger than MOST_UNPACKED_BYTES
BLOCK_BYTES = 1 << 20


class TooLarge(ValueError):
    """A compressed part is larger than the limit."""

    def __init__(self, most: int) -> None:
        super().__init__(f"a compressed part unpacks to more than {most / 1e6:,.0f} MB")


def unpack(packing: str, packed: bytes, size: int) -> bytes:
    """Unpack a chunk or message of stated size; packing: the compression's name in bags.

    Raises ValueError if it ends early or has another size, TooLarge if it exceeds the limit.
    """
    plain = packing in ("", "none")
    most = MOST_PLAIN_BYTES if plain else MOST_UNPACKED_BYTES
    if size > most:
        raise TooLarge(most)
    unpacked = packed if plain else _unpacked(_decompressor(packing), packed)
    if len(unpacked) != size:
        raise ValueError(f"unpacks to {len(unpacked):,} bytes, not {size:,}")
    return unpacked


def unpack_message(packed: bytes) -> bytes:
    """Unpack a message that was compressed separately, with zstd; raise ValueError if it is damaged."""
    return _unpacked(_decompressor("zstd"), packed)


def unpack_file(packed: BinaryIO, size: int, target: BinaryIO) -> bool:
    """Unpack a file of `size` bytes that was compressed as a whole, with zstd; return whether it is complete.

    Raises TooLarge if it exceeds the limit.
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
    while packed:  # there may be several consecutive compressed streams
        stream = new()
        try:
            parts.append(stream.decompress(packed, max_length=left + 1))
        except Exception as error:  # each library has its own exceptions
            raise ValueError(f"cannot be unpacked: {str(error)[:100]}") from None
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
    raise ValueError(f"unsupported compression {packing[:20]!r}")


def zstd_module() -> Any:
    """Import the module for zstd: Python's own since 3.14, before that the one that rosbags depends on."""
    try:
        return import_module("compression.zstd")
    except ImportError:
        return import_module("backports.zstd")
