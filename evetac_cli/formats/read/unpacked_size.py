"""How much a packed file of somebody else's may unpack to: a few kB may stand for all memory, or for days of work.

Deflate makes up to 1,032 bytes of one, Zstandard more, and a column of one polarity comes near; all numbers of events
or samples together do not.
"""

from evetac_cli.errors import InputError

MOST_TIMES = 100  # the size of the file
ALWAYS_BYTES = 64 << 20  # to that any file may unpack


def most_unpacked_bytes(packed_bytes: int) -> int:
    """How many bytes so many may unpack to."""
    return max(ALWAYS_BYTES, MOST_TIMES * packed_bytes)


def refuse_too_much(unpacked_bytes: int, packed_bytes: int, where: str) -> None:
    """InputError where a file unpacks to more than events or samples can."""
    if unpacked_bytes > most_unpacked_bytes(packed_bytes):
        raise InputError(
            "unpacks to too much",
            where=where,
            expected=f"at most {MOST_TIMES} times its size",
            found=f"{unpacked_bytes / 1e6:,.0f} MB of {packed_bytes:,} bytes",
            hint="the file is damaged, or made to harm",
        )
