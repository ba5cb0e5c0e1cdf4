"""Messages from the recording process to the process of a live view, other than slices and commands.

The recording process loads this module, but not the modules that track dots, which take a second to load.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

BROWSER, TERMINAL = "browser", "terminal"  # where the view is shown


class Title(NamedTuple):
    """The title of a view, known before a device is opened."""

    name: str  # name of the command and its file
    simulated: bool
    moves: bool  # whether a gripper moves that can be released


class Begun(NamedTuple):
    """The camera runs."""

    sensor: Mapping[str, Any]  # datasets sensor/...


class Lost(NamedTuple):
    """Events lost so far, and the reasons as text."""

    events: str
    why: str


class Said(NamedTuple):
    """A message to the user."""

    text: str


class Ended(NamedTuple):
    """The reason, as text, why there will be no more slices."""

    why: str
