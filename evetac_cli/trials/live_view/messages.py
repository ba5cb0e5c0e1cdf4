"""What the process of a live view is told by whoever records, apart from slices and commands.

Why so: whoever records loads this module, and not what tracks dots, which takes a second.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

BROWSER, TERMINAL = "browser", "terminal"  # where it is shown


class Title(NamedTuple):
    """What a view shows, known before a device is opened."""

    name: str  # of the command and its file
    simulated: bool
    moves: bool  # a gripper that can be let go of


class Begun(NamedTuple):
    """The camera runs."""

    sensor: Mapping[str, Any]  # datasets sensor/...


class Lost(NamedTuple):
    """Events lost so far, and why, in words."""

    events: str
    why: str


class Said(NamedTuple):
    """A message to the user."""

    text: str


class Ended(NamedTuple):
    """Why there will be no more slices, in words."""

    why: str
