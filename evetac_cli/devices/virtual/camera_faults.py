"""What can be made to go wrong with a virtual camera: `name`, `name@seconds` or `name@seconds:duration` after RUN.

Some are there from before the camera is opened: those have no moment, and are written `name` alone.
"""

from typing import NamedTuple

from evetac_cli.errors import InputError

# What happens, and for how long if nothing is said; 0: once, or from then on; None: from before the camera is opened.
FAULTS: dict[str, tuple[str, float | None]] = {
    "unplug": ("the camera is no longer on the bus", 0.0),
    "stall": ("the data endpoint halts, until it is cleared", 0.0),
    "stall-for-good": ("the data endpoint halts and cannot be cleared", 0.0),
    "lost-timestamps": ("TIMESTAMP words are missing", 0.1),
    "odd": ("reads return odd numbers of bytes, cutting words", 0.1),
    "torn": ("the last bytes of a transfer are missing", 0.0),
    "damage": ("one word in 50 is replaced by random bits", 0.1),
    "silence": ("nothing is sent, and what was seen is lost", 0.1),
    "log": ("the camera says `sensor fault` on its debug endpoint", 0.0),
    "no-permission": ("the system refuses to open the camera", None),
    "busy": ("another program has claimed the camera", None),
    "usb2": ("the camera is linked by USB 2", None),
    "slow-flush": ("the request to flush stale data is never answered", None),
}


class Fault(NamedTuple):
    """One fault and when it happens, in s after RUN."""

    name: str
    start_s: float
    duration_s: float

    @property
    def before_run(self) -> bool:
        """Whether it is there from the start."""
        return FAULTS[self.name][1] is None

    def at(self, now_s: float) -> bool:
        """Whether the fault lasts at this time; one without a duration lasts for ever."""
        return now_s >= self.start_s and (self.duration_s == 0 or now_s < self.start_s + self.duration_s)


def fault(text: str) -> Fault:
    """Understand a fault; InputError if there is no such."""
    name, at, times = text.partition("@")
    start, _, duration = times.partition(":")
    try:
        _, default_s = FAULTS[name]
        found = Fault(name, float(start or 0), float(duration or default_s or 0))
    except (KeyError, ValueError):
        found = Fault(name, -1.0, 0.0)
    if not (0 <= found.start_s < float("inf") and 0 <= found.duration_s < float("inf")) or (at and default_s is None):
        raise InputError(
            "no such fault of a virtual camera",
            expected=f"NAME@SECONDS or NAME@SECONDS:DURATION of {_names(from_start=False)};"
            f" or NAME alone, without a moment, of {_names(from_start=True)}",
            found=text,
        )
    return found


def _names(*, from_start: bool) -> str:
    return ", ".join(name for name, (_, default_s) in FAULTS.items() if (default_s is None) == from_start)
