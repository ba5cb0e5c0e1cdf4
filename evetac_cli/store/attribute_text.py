"""How long a text attribute is, from the bytes of the file, before HDF5 reads it.

Why so: HDF5 takes memory for the length that the attribute announces, up to 4 GB, and only then looks how long the
text is; a single flipped bit is enough. It has no call that tells the length. So the one object whose texts are read,
the root of a file, is parsed here: the object header of versions 1 and 2 with its continuations, as in the HDF5 File
Format Specification, sections IV.A.1 and IV.A.2.m.
"""

import os
from collections.abc import Iterator
from pathlib import Path

ATTRIBUTE, CONTINUATION = 0x0C, 0x10
MOST_HEADER_BYTES = 16 << 20
SHARED = 2


def text_bytes(path: Path, address: int, name: str) -> int:
    """Bytes of the text attribute `name` of the object at `address`; ValueError if it is not stored in its header."""
    with open(path, "rb") as file:
        for kind, flags, data in _messages(file.fileno(), address):
            if kind == ATTRIBUTE and not flags & SHARED and (length := _length(data, name.encode())) is not None:
                return length
    raise ValueError(f"the attribute {name} is stored in a way that is not read")


def _messages(file: int, address: int) -> Iterator[tuple[int, int, bytes]]:
    """Type, flags and bytes of each message of an object header."""
    start = os.pread(file, 64, address)
    second = start[:4] == b"OHDR"
    if second:
        flags = start[5]
        at = 6 + 16 * bool(flags & 0x20) + 4 * bool(flags & 0x10)
        width = 1 << (flags & 3)
        blocks = [(address + at + width, int.from_bytes(start[at : at + width], "little"))]
        head = 4 + 2 * bool(flags & 4)
    else:
        blocks, head = [(address + 16, int.from_bytes(start[8:12], "little"))], 8
    total = 0
    while blocks:
        where, size = blocks.pop(0)
        total += size + 16  # also continuations that lead in a circle come to an end
        if total > MOST_HEADER_BYTES:
            raise ValueError("its object header is too long")
        block, at = os.pread(file, size, where), 0
        while at + head <= len(block):
            kind = block[at] if second else int.from_bytes(block[at : at + 2], "little")
            length = int.from_bytes(block[at + 1 : at + 3] if second else block[at + 2 : at + 4], "little")
            flags = block[at + 3] if second else block[at + 4]
            data = block[at + head : at + head + length]
            at += head + length
            if kind == CONTINUATION:
                more, count = int.from_bytes(data[:8], "little"), int.from_bytes(data[8:16], "little")
                blocks.append((more + 4, count - 8) if second else (more, count))  # less signature and checksum
            yield kind, flags, data


def _length(data: bytes, name: bytes) -> int | None:
    """Length of the text in an attribute message, its first four bytes; None if it has another name."""
    version = data[0]
    sizes = [int.from_bytes(data[at : at + 2], "little") for at in (2, 4, 6)]  # of name, type, shape
    at = 9 if version == 3 else 8
    if data[at : at + sizes[0]].rstrip(b"\0") != name:
        return None
    padded = [-(-size // 8) * 8 for size in sizes] if version == 1 else sizes
    at += sum(padded)
    return int.from_bytes(data[at : at + 4], "little")
