"""Faults of a virtual servo, by name: when one strikes, and what a fault may be.

`NAME` strikes at once, `NAME@SECONDS` so long after torque was first switched on, `NAME%PERCENT` strikes each answer
with that probability.

    late-answer    the answer comes when the host has long given up
    lost-answer    no answer
    bad-crc        one byte of the answer is damaged
    watchdog       the Bus Watchdog trips as if the host had been silent
    overload       hardware error: torque off, an alert in every answer until reboot
    unplug         the port is gone
"""

from dataclasses import dataclass

from evetac_cli.errors import InputError

ANSWER_FAULTS = ("late-answer", "lost-answer", "bad-crc")
STATE_FAULTS = ("watchdog", "overload", "unplug")
LATE_S = 0.5


@dataclass(frozen=True)
class ServoFault:
    """One fault: at a moment (seconds after torque on; None is at once), or for a share of all answers."""

    name: str
    at_s: float | None = None
    share: float = 0.0

    @classmethod
    def parse(cls, text: str) -> "ServoFault":
        """From NAME, NAME@SECONDS or NAME%PERCENT; InputError for what is none of them."""
        name, at, moment = text.partition("@")
        name, percent, share = name.partition("%")
        try:
            fault = cls(name, float(moment) if at else None, float(share) / 100 if percent else 0.0)
        except ValueError:
            fault = cls("")
        known = fault.name in ANSWER_FAULTS or (fault.name in STATE_FAULTS and not percent)
        if not known or (at and percent) or not (fault.at_s or 0.0) >= 0.0 or not 0.0 <= fault.share <= 1.0:
            raise InputError(
                "not a fault of the virtual gripper",
                expected=f"NAME or NAME@SECONDS, or NAME%PERCENT of the first three: {', '.join(_ALL)}",
                found=text,
            )
        return fault


_ALL = (*ANSWER_FAULTS, *STATE_FAULTS)
