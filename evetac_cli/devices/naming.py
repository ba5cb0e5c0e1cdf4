"""Refusals that names of cameras and of grippers share: no such device, and not a number."""

from difflib import get_close_matches

from evetac_cli.errors import InputError


def parse_number(text: str, where: str, name: str) -> float:
    """A number from 1 to below 1e9 that is part of a device's name; InputError if it is none."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 1 <= value < 1e9:
        raise InputError("not a number", where=where, expected="1 to 1e9", found=name)
    return value


def no_such_device(what: str, expected: str, name: str, known: tuple[str, ...]) -> InputError:
    """The error for a name that no camera or gripper has; known: the names to which it may come close."""
    guess = get_close_matches(name, known, n=1)
    hint = f"did you mean {guess[0]}?" if guess else ""
    return InputError(f"no such {what}", where=f"--{what}", expected=expected, found=name, hint=hint)
