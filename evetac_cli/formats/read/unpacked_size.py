"""Limit the size that another program's packed file may unpack to: a few kB could fill all memory or take days.

Deflate expands one byte to up to 1,032, Zstandard to more. A column with a single polarity comes close to this; all
numbers of events or samples together do not.
"""

from evetac_cli.errors import InputError

MOST_TIMES = 100  # largest ratio of unpacked to packed size
ALWAYS_BYTES = 64 << 20  # size that any file may unpack to


def most_unpacked_bytes(packed_bytes: int) -> int:
    """Return the largest unpacked size, in bytes, for a packed size."""
    return max(ALWAYS_BYTES, MOST_TIMES * packed_bytes)


def refuse_too_much(unpacked_bytes: int, packed_bytes: int, where: str) -> None:
    """Raise InputError if a file unpacks to more than events or samples can."""
    if unpacked_bytes > most_unpacked_bytes(packed_bytes):
        raise InputError(
            "the file would unpack to too much data",
            where=where,
            expected=f"at most {MOST_TIMES} times its size",
            found=f"{unpacked_bytes / 1e6:,.0f} MB from {packed_bytes:,} bytes",
            hint="the file is damaged, or was made to fill the memory",
        )
