"""Damage the bytes or the text of a file, in place."""

from pathlib import Path

import numpy as np

Rng = np.random.Generator
BYTES = (
    b"\x00",
    b"\xff",
    b"\x7f",
    b"\x80",
    b"\xff\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\x00\x00\x00\x80",
    b"\n",
    b"\x1b[2J",
)
WORDS = (
    "nan", "inf", "-inf", "-1", "0", "1e308", "-1e308", "1e-308", "9" * 40, "9" * 400, "true", "null", '""', "[]", "{}",
    "[[[[[[]]]]]]", '"\\u001b[31m"', "[" * 3000, "a.b.c.d", "'", '"', "=", "2024-01-01", "0x7fffffffffffffff",
)  # fmt: skip


def damage_bytes(path: Path, rng: Rng) -> str:
    """Flip, replace, insert, remove, repeat or cut bytes."""
    data = bytearray(path.read_bytes())
    operation = str(rng.choice(["flip", "replace", "insert", "remove", "repeat", "cut", "swap", "zero"]))
    # Headers are short and determine most of the parsing, so half of all damage is done in the first kilobyte.
    at = int(rng.integers(0, max(1, min(len(data), 1024) if rng.random() < 0.5 else len(data))))
    size = int(rng.integers(1, 1 + min(4096, max(1, len(data) - at))))
    if operation == "flip" and data:
        for position in rng.integers(0, len(data), 1 + size % 16):
            data[position] ^= 1 << int(rng.integers(8))
        data[min(at, len(data) - 1)] ^= 1 << int(rng.integers(8))
    elif operation == "replace":
        value = BYTES[rng.integers(len(BYTES))]
        data[at : at + len(value)] = value
    elif operation == "insert":
        data[at:at] = rng.bytes(size % 64)
    elif operation == "remove":
        del data[at : at + size]
    elif operation == "repeat":
        data[at:at] = data[at : at + size] * int(rng.integers(1, 8))
    elif operation == "cut":
        del data[at:]
    elif operation == "swap":
        data[at : at + 8] = data[at : at + 8][::-1]
    else:
        data[at : at + size] = bytes(len(data[at : at + size]))
    path.write_bytes(data)
    return f"{operation} {size if operation in ('remove', 'repeat', 'zero') else ''} at byte {at}"


def damage_text(path: Path, rng: Rng) -> str:
    """Replace a value; repeat, remove or swap lines; or damage bytes."""
    text = path.read_bytes().decode("latin1")
    lines = text.split("\n")
    operation = str(rng.choice(["value"] * 3 + ["repeat line", "remove line", "swap lines", "bytes", "wrap"]))
    if operation == "bytes" or not text:
        return damage_bytes(path, rng)
    line = int(rng.integers(len(lines)))
    if operation == "value":
        word = WORDS[rng.integers(len(WORDS))]
        starts = [k for k in range(len(text)) if text[k].isdigit() and (k == 0 or not text[k - 1].isalnum())]
        start = starts[rng.integers(len(starts))] if starts else 0
        stop = start
        while stop < len(text) and (text[stop].isalnum() or text[stop] in ".-+"):
            stop += 1
        text = text[:start] + word + text[stop:]
        path.write_bytes(text.encode("latin1"))
        return f"{word[:20]!r} at character {start}"
    if operation == "repeat line":
        lines[line:line] = [lines[line]] * int(rng.integers(1, 2000))
    elif operation == "remove line":
        del lines[line]
    elif operation == "swap lines":
        other = int(rng.integers(len(lines)))
        lines[line], lines[other] = lines[other], lines[line]
    else:
        lines[line] = WORDS[rng.integers(len(WORDS))] + lines[line]
    path.write_bytes("\n".join(lines).encode("latin1"))
    return f"{operation} {line}"
