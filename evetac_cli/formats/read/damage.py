"""Say in words that another program's file is damaged, and limit what its packed data may unpack to.

Deflate expands one byte to up to 1,032, Zstandard and bzip2 to more: a few kB could fill all memory or the disk. A
column with a single polarity comes close to this; all numbers of events or samples together do not.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from evetac_cli.errors import EvetacError, InputError, cannot_read
from evetac_cli.text_files import FileStamps

MOST_TIMES = 100  # largest ratio of unpacked to packed size
ALWAYS_BYTES = 64 << 20  # size that anything may unpack to


def most_unpacked_bytes(packed_bytes: int) -> int:
    """Return the largest unpacked size, in bytes, for a packed size."""
    return max(ALWAYS_BYTES, MOST_TIMES * packed_bytes)


def refuse_too_much(unpacked_bytes: int, packed_bytes: int, where: str) -> None:
    """Raise InputError if packed data unpacks to more than events or samples can."""
    if unpacked_bytes > most_unpacked_bytes(packed_bytes):
        found = f"{unpacked_bytes / 1e6:,.0f} MB from {packed_bytes:,} bytes"
        expected = f"at most {MOST_TIMES} times its size"
        raise InputError("the file would unpack to too much data", where=where, expected=expected, found=found)


def unpacked(decompressor: Callable[[], Any], packed: bytes, where: str) -> bytes:
    """Unpack bytes with a decompressor of bz2, lz4 or zstd; ValueError if they end early, InputError if too large."""
    stream = decompressor()
    content: bytes = stream.decompress(packed, max_length=most_unpacked_bytes(len(packed)) + 1)
    refuse_too_much(len(content), len(packed), where)
    if not stream.eof:
        raise ValueError("a compressed part ends early")
    return content


@contextmanager
def reading(path: Path, before: FileStamps) -> Iterator[None]:
    """Turn errors while reading into InputError; if the file changed during reading, report that instead."""
    try:
        yield
    except InputError:
        before.check()
        raise
    except OSError as error:
        raise cannot_read(error, path) from error
    except MemoryError as error:
        raise InputError("the file does not fit in memory", where=str(path), hint="split it") from error


@contextmanager
def read_in_words(where: str, message: str, hint: str = "") -> Iterator[None]:
    """Turn any exception into InputError, because libraries and parsers raise all kinds for damaged files."""
    try:
        yield
    except (MemoryError, EvetacError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno:  # of the disk, not of the contents
            raise
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        raise InputError(message, where=where, found=reason, hint=hint) from None
