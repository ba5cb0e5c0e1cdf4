"""What names of cameras and of grippers share: numbers with their range, and the refusal of names that are none."""

import math
from difflib import get_close_matches

from evetac_cli.errors import InputError


def number(text: str) -> float:
    """The number that a text is; NaN for any other."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def parse_number(text: str, low: float, high: float, where: str, name: str, *, whole: bool = False) -> float:
    """A number in [low, high] that is part of a device's name; InputError if it is none, or not whole where it must be.

    where: the part, as in `virtual:prepared=EVENTS_S`; name: the whole name.
    """
    value = number(text)
    if not low <= value <= high or (whole and value != int(value)):
        kind = "a whole number, " if whole else ""
        raise InputError("not such a number", where=where, expected=f"{kind}{low:g} to {high:g}", found=name)
    return value


def no_such_device(what: str, expected: str, name: str, known: tuple[str, ...]) -> InputError:
    """The error for a name that no camera or gripper has; known: the names to which it may come close."""
    guess = get_close_matches(name, known, n=1)
    hint = f"did you mean {guess[0]}?" if guess else ""
    return InputError(f"no such {what}", where=f"--{what}", expected=expected, found=name, hint=hint)
