"""Texts of an HDF5 file, read from its bytes: attributes of the root, and scalar datasets.

HDF5 allocates memory for the length that a text announces, up to 4 GB, before it checks how long the text is. If the
sizes in its heap of texts are damaged, it loops forever. One flipped bit is enough for either, and HDF5 has no call
that returns only the length. So these few structures are read here according to the HDF5 File Format Specification:
object headers of versions 1 and 2 (IV.A.1), attributes (IV.A.2.m), the global heap (III.E).
Anything that does not fit raises ValueError.
"""

import os
from collections.abc import Iterator
from pathlib import Path

ATTRIBUTE, CONTINUATION = 0x0C, 0x10
SHARED = 2  # flag: the message is stored elsewhere
MOST_HEADER_BYTES = 16 << 20
MOST_HEAP_OBJECTS = 1 << 16  # they have 16-bit numbers
REFERENCE_BYTES = 16


class TextTooLong(ValueError):
    """A text announces more bytes than allowed."""


def attribute_text(path: Path, address: int, name: str, most_bytes: int) -> str:
    """Return the text attribute `name` of the object whose header is at `address`."""
    with open(path, "rb") as file:
        _require_eight_bytes(file.fileno())
        for kind, flags, data in _messages(file.fileno(), address):
            if kind == ATTRIBUTE and not flags & SHARED:
                reference = _value(data, name.encode())
                if reference is not None:
                    return _text(file.fileno(), reference, most_bytes)
    raise ValueError(f"the attribute {name} is stored in an unsupported form")


def dataset_text(path: Path, address: int, most_bytes: int) -> str:
    """Return the text of a scalar dataset whose bytes are at `address`."""
    with open(path, "rb") as file:
        _require_eight_bytes(file.fileno())
        return _text(file.fileno(), _bytes(file.fileno(), REFERENCE_BYTES, address), most_bytes)


def _require_eight_bytes(file: int) -> None:
    """Raise ValueError unless addresses and lengths have 8 bytes, as HDF5 libraries write by default."""
    start = _bytes(file, 16, 0)
    sizes = start[13:15] if start[8:9] in (b"\0", b"\1") else start[9:11]
    if start[:4] != b"\x89HDF" or sizes != b"\x08\x08":
        raise ValueError("its addresses do not have 8 bytes, or do not count from its start")


def _text(file: int, reference: bytes, most_bytes: int) -> str:
    """Return the text for a reference: a length, the address of a heap, and a number in the heap."""
    length, heap, number = _number(reference[:4]), _number(reference[4:12]), _number(reference[12:16])
    if length > most_bytes:
        raise TextTooLong(f"{length} bytes")
    if length == 0:
        return ""
    head = _bytes(file, 16, heap)
    if head[:4] != b"GCOL":
        raise ValueError("its text is not at the stated address")
    at, end = heap + 16, heap + _number(head[8:16])
    for _ in range(MOST_HEAP_OBJECTS):
        entry = _bytes(file, 16, at)
        index, size = _number(entry[:2]), _number(entry[8:16])
        if len(entry) < 16 or index == 0 or at + 16 + size > end:
            break
        if index == number:
            content = _bytes(file, length, at + 16)
            if size != length or len(content) != length:
                break
            return content.decode()
        at += 16 + -(-size // 8) * 8
    raise ValueError("its text is not at the stated address")


def _messages(file: int, address: int) -> Iterator[tuple[int, int, bytes]]:
    """Yield type, flags and bytes of each message of an object header."""
    start = _bytes(file, 64, address)
    second = start[:4] == b"OHDR"
    if second:
        at = 6 + 16 * bool(start[5] & 0x20) + 4 * bool(start[5] & 0x10)
        width = 1 << (start[5] & 3)
        blocks = [(address + at + width, _number(start[at : at + width]))]
        head = 4 + 2 * bool(start[5] & 4)
    else:
        blocks, head = [(address + 16, _number(start[8:12]))], 8
    total = 0
    while blocks:
        where, size = blocks.pop(0)
        total += size + 16  # so that circular continuations end too
        if total > MOST_HEADER_BYTES:
            raise ValueError("its object header is too long")
        block, at = _bytes(file, size, where), 0
        while at + head <= len(block):
            kind = block[at] if second else _number(block[at : at + 2])
            length = _number(block[at + 1 : at + 3] if second else block[at + 2 : at + 4])
            flags = block[at + 3] if second else block[at + 4]
            data = block[at + head : at + head + length]
            at += head + length
            if kind == CONTINUATION:
                more, count = _number(data[:8]), _number(data[8:16])
                blocks.append((more + 4, count - 8) if second else (more, count))  # less signature and checksum
            yield kind, flags, data


def _value(data: bytes, name: bytes) -> bytes | None:
    """Return the value in an attribute message, for one text; None if the attribute has another name."""
    version = data[:1]
    sizes = [_number(data[at : at + 2]) for at in (2, 4, 6)]  # of name, type, shape
    at = 9 if version == b"\3" else 8
    if data[at : at + sizes[0]].rstrip(b"\0") != name:
        return None
    padded = [-(-size // 8) * 8 for size in sizes] if version == b"\1" else sizes
    return data[at + sum(padded) : at + sum(padded) + REFERENCE_BYTES]


def _bytes(file: int, count: int, at: int) -> bytes:
    """Return `count` bytes of a file, fewer at its end; ValueError for an impossible position."""
    if not (0 <= count <= 2**31 and at < 2**62):
        raise ValueError("it refers to an impossible position")
    return os.pread(file, count, at)


def _number(content: bytes) -> int:
    return int.from_bytes(content, "little")
