"""JSON from a file, limited in size and depth: what comes out can be walked, compared and written again.

Why so: Python reads JSON of any depth that its stack still takes, and what works on the result later then fails in the
middle of it; whole numbers may have thousands of digits.
"""

import json
from typing import Any

from evetac_cli.store.checked_hdf5 import MOST_TEXT_BYTES

MOST_DEEP = 32  # levels; headers and recipes of ours have up to 8
LARGEST = 2**128  # seeds of numpy have up to 128 bits


def read_json(text: str) -> Any:
    """The value of a JSON text; ValueError if it is none, too long, too deep, or holds a number out of range."""
    if len(text) > MOST_TEXT_BYTES:
        raise ValueError(f"longer than {MOST_TEXT_BYTES} characters")
    try:
        value = json.loads(text, parse_constant=_refuse)
    except RecursionError:
        raise ValueError(f"nested in more than {MOST_DEEP} levels") from None
    level = [value]
    for _ in range(MOST_DEEP):
        below: list[Any] = []
        for item in level:
            if isinstance(item, dict):
                below.extend(item.values())
            elif isinstance(item, list):
                below.extend(item)
            elif isinstance(item, int) and abs(item) > LARGEST:
                raise ValueError("a whole number out of range")
        level = below
        if not level:
            return value
    raise ValueError(f"nested in more than {MOST_DEEP} levels")


def _refuse(name: str) -> Any:
    raise ValueError(f"{name} is no number of JSON")
