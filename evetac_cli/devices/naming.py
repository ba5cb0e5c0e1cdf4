"""What names of cameras and of grippers share: options, numbers with their range, and the refusal of other names."""

import math
import re
from difflib import get_close_matches

from evetac_cli.errors import InputError

EVENTS_S = 5_000, 50_000_000  # of `virtual:prepared=`: an event in every frame; 0.8 GB of memory while they are made
FIRMWARES = 1, 255  # of `virtual:firmware=`: a byte of the USB descriptor


NUMBER = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?"
_NUMBER = re.compile(NUMBER)
_BETWEEN_OPTIONS = re.compile(r"(?<![0-9.]e)\+")  # not the sign of an exponent, as in prepared=1e+5


def options(text: str) -> tuple[str, ...]:
    """The options of a virtual device, which a + joins; nothing between two of them is no option."""
    return tuple(filter(None, _BETWEEN_OPTIONS.split(text)))


def number(text: str) -> float:
    """The number that a text is, as it is written in a device's name; NaN for any other, and for one too large."""
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    return value if math.isfinite(value) else math.nan


def parse_number(text: str, low: int, high: int, where: str, name: str, *, whole: bool = False) -> float:
    """A number in [low, high] that is part of a device's name; InputError if it is none, or not whole where it must be.

    where: the part, as in `virtual:prepared=EVENTS_S`; name: the whole name.
    """
    value = number(text)
    if low <= value <= high and (not whole or value == int(value)):
        return value
    kind = "a whole number" if whole else "a number"
    wrong = "out of range" if value == value and (not whole or value == int(value)) else f"not {kind}"
    raise InputError(wrong, where=where, expected=f"{kind}, {low:,} to {high:,}", found=name)


def no_such_device(what: str, expected: str, name: str, known: tuple[str, ...]) -> InputError:
    """The error for a name that no camera or gripper has; known: the names to which it may come close."""
    guess = get_close_matches(name, known, n=1)
    hint = f"did you mean {guess[0]}?" if guess else ""
    return InputError(f"no such {what}", where=f"--{what}", expected=expected, found=name, hint=hint)
