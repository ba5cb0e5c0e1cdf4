"""Parts shared by camera and gripper names: options, numbers with their range, and the error for unknown names."""

import math
import re

from evetac_cli.errors import InputError, did_you_mean

# for `virtual:prepared=`: from one event per frame up to 0.8 GB of memory during preparation
EVENTS_S = 5_000, 50_000_000
FIRMWARES = 1, 255  # for `virtual:firmware=`: a byte of the USB descriptor


NUMBER = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?"
_NUMBER = re.compile(NUMBER)
_BETWEEN_OPTIONS = re.compile(r"(?<![0-9.]e)\+")  # not the sign of an exponent, for example prepared=1e+5


def options(text: str) -> tuple[str, ...]:
    """Return the options of a virtual device, which are joined by +; empty options are skipped."""
    return tuple(filter(None, _BETWEEN_OPTIONS.split(text)))


def number(text: str) -> float:
    """Return the number in a text, as written in a device's name; NaN for any other text, or if too large."""
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    return value if math.isfinite(value) else math.nan


def parse_number(text: str, low: int, high: int, where: str, name: str, *, whole: bool = False) -> float:
    """Return a number in [low, high] from a device's name.

    InputError if it is not a number, or not whole if `whole`. where: the part, for example `virtual:prepared=EVENTS_S`;
    name: the whole name.
    """
    value = number(text)
    if low <= value <= high and (not whole or value == int(value)):
        return value
    kind = "a whole number" if whole else "a number"
    wrong = "out of range" if value == value and (not whole or value == int(value)) else f"not {kind}"
    raise InputError(wrong, where=where, expected=f"{kind}, {low:,} to {high:,}", found=name)


def no_such_device(what: str, expected: str, name: str, known_names: tuple[str, ...]) -> InputError:
    """Return the error for a name that no camera or gripper has; known_names: for the suggestion."""
    hint = did_you_mean(name, known_names)
    return InputError(f"no such {what}", where=f"--{what}", expected=expected, found=name, hint=hint)
