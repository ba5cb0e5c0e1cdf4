"""Texts of an HDF5 file, attributes of the root and scalar datasets, read from their bytes.

HDF5 reserves the memory that a text announces, up to 4 GB, before it looks for it, and loops forever over a damaged
heap of texts; one flipped bit is enough for either. So these few structures of the HDF5 File Format Specification are
read here: object headers (IV.A.1), attributes (IV.A.2.m), the global heap (III.E). Other bytes raise ValueError.
"""

import os
from collections.abc import Iterator
from pathlib import Path

ATTRIBUTE, CONTINUATION = 0x0C, 0x10
MOST_TEXT_BYTES = 32 << 20
MOST_HEAP_TEXTS = 1 << 16  # they have 16-bit numbers
MOST_BLOCKS = 1000  # of an object header
MOST_BLOCK_BYTES = 1 << 20
REFERENCE_BYTES = 16


def attribute_text(path: Path, address: int, name: str) -> str:
    """Return the text attribute `name` of the object whose header is at `address`."""
    with open(path, "rb") as file:
        for data in _attributes(file.fileno(), address):
            sizes = [_number(data[at : at + 2]) for at in (2, 4, 6)]  # of name, type, shape
            at = 9 if data[:1] == b"\3" else 8
            if data[at : at + sizes[0]].rstrip(b"\0") == name.encode():
                at += sum(-(-size // 8) * 8 if data[:1] == b"\1" else size for size in sizes)
                return _text(file.fileno(), data[at : at + REFERENCE_BYTES])
    raise ValueError(f"the attribute {name} is stored in an unsupported form")


def dataset_text(path: Path, address: int) -> str:
    """Return the text of a scalar dataset whose bytes are at `address`."""
    with open(path, "rb") as file:
        return _text(file.fileno(), os.pread(file.fileno(), REFERENCE_BYTES, address))


def _text(file: int, reference: bytes) -> str:
    """Return the text for a reference: a length, the address of a heap, and a number in the heap."""
    length, heap, number = _number(reference[:4]), _number(reference[4:12]), _number(reference[12:16])
    if length > MOST_TEXT_BYTES:
        raise ValueError(f"a text of {length} bytes, more than {MOST_TEXT_BYTES}")
    at = heap + 16
    for _ in range(MOST_HEAP_TEXTS if length else 0):
        entry = os.pread(file, 16, at) if at < 2**62 else b""
        index, size = _number(entry[:2]), _number(entry[8:16])
        if index == number and size == length:
            return os.pread(file, length, at + 16).decode()
        if index in (0, number):
            break
        at += 16 + -(-size // 8) * 8
    if length:
        raise ValueError("its text is not at the stated address")
    return ""


def _attributes(file: int, address: int) -> Iterator[bytes]:
    """Yield the attribute messages of an object header."""
    start = os.pread(file, 64, address)
    second = start[:4] == b"OHDR"
    if second:
        at = 6 + 16 * bool(start[5] & 0x20) + 4 * bool(start[5] & 0x10)
        width = 1 << (start[5] & 3)
        blocks, head = [(address + at + width, _number(start[at : at + width]))], 4 + 2 * bool(start[5] & 4)
    else:
        blocks, head = [(address + 16, _number(start[8:12]))], 8
    for where, size in blocks:
        if len(blocks) > MOST_BLOCKS or size > MOST_BLOCK_BYTES or where >= 2**62:
            raise ValueError("its object header is damaged")
        block, at = os.pread(file, size, where), 0
        while at + head <= len(block):
            kind = block[at] if second else _number(block[at : at + 2])
            length = _number(block[at + 1 : at + 3] if second else block[at + 2 : at + 4])
            data = block[at + head : at + head + length]
            at += head + length
            if kind == CONTINUATION:
                more, count = _number(data[:8]), _number(data[8:16])
                blocks.append((more + 4, count - 8) if second else (more, count))  # less signature and checksum
            elif kind == ATTRIBUTE:
                yield data


def _number(content: bytes) -> int:
    return int.from_bytes(content, "little")
