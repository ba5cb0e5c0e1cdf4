"""Parts of camera and gripper names: options, numbers with their range, faults, and the error for unknown names.

A fault of a virtual device is `NAME[%PERCENT][@SECONDS[:DURATION]]`. %PERCENT strikes each answer with that
probability. @SECONDS counts from the start of the camera, or from the first torque of the gripper. Without it the fault
begins at once. A watchdog trip and a restart only matter under torque and wait for it. :DURATION ends the fault.
Options are joined by `+`: `--camera virtual:unplug@2 --gripper virtual:lost-answer%2`.
"""

import math
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

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


class FaultKind(NamedTuple):
    """The effect of a fault, and the parts of its text that it accepts."""

    effect: str
    moment: bool = True  # @SECONDS
    duration: bool = True  # :DURATION; for a fault with %PERCENT, only together with that
    percent: bool = False  # %PERCENT
    usual_s: float = 0.0  # its duration if none is given; 0: it strikes once, or lasts forever
    torque: bool = False  # it cannot strike before torque is on
    reads: tuple[str, int] | None = None  # a register of the gripper, and its false value while this lasts


_BEFORE: dict[str, Any] = {"moment": False, "duration": False}  # present before the camera is opened

CAMERA_FAULTS: Mapping[str, FaultKind] = {
    "unplug": FaultKind("the camera is no longer on the bus"),
    "stall": FaultKind("the data endpoint halts until it is cleared"),
    "stall-for-good": FaultKind("the data endpoint halts and cannot be cleared"),
    "lost-timestamps": FaultKind("TIMESTAMP words are missing", usual_s=0.1),
    "odd": FaultKind("reads return odd numbers of bytes, cutting words", usual_s=0.1),
    "torn": FaultKind("3 bytes are missing inside a transfer; with :DURATION, inside each transfer in that time"),
    "damage": FaultKind("one word in 50 is replaced by random bits", usual_s=0.1),
    "random": FaultKind("every word is replaced by random bits", usual_s=0.1),
    "jump-forward": FaultKind("the camera's clock jumps ahead by 5 s", duration=False),
    "jump-back": FaultKind("the camera's clock jumps back by 5 s", duration=False),
    "silence": FaultKind("the camera sends nothing, and its events are lost", usual_s=0.1),
    "log": FaultKind("the camera reports `sensor fault` on its debug endpoint"),
    "no-permission": FaultKind("the system refuses to open the camera", **_BEFORE),
    "busy": FaultKind("another program has claimed the camera", **_BEFORE),
    "usb2": FaultKind("the camera is connected by USB 2", **_BEFORE),
    "slow-flush": FaultKind("the request to flush stale data is never answered", **_BEFORE),
}
GRIPPER_FAULTS: Mapping[str, FaultKind] = {
    "late-answer": FaultKind("the answer comes long after the host gave up", percent=True),
    "lost-answer": FaultKind("no answer", percent=True),
    "bad-crc": FaultKind("one byte of the answer is damaged", percent=True),
    "watchdog": FaultKind("the Bus Watchdog trips as if the host had been silent", duration=False, torque=True),
    "overload": FaultKind("hardware error: torque off, an alert in every answer until reboot", duration=False),
    "restart": FaultKind(
        "24 V dip: torque off, all registers as after power-on, no hardware error", duration=False, torque=True
    ),
    "false-position": FaultKind("its position reads 2,147,483,647 ticks", reads=("Present Position", 2**31 - 1)),
    "false-current": FaultKind("its current reads -32,768 mA", reads=("Present Current", -(2**15))),
    "false-voltage": FaultKind("its supply reads 0 V", reads=("Present Input Voltage", 0)),
    "false-temperature": FaultKind("its temperature reads 255 C", reads=("Present Temperature", 255)),
    "unplug": FaultKind("the port is gone", duration=False),
}


_FORM = re.compile(rf"([a-z0-9-]+)(?:%({NUMBER}))?(?:@({NUMBER})(?::({NUMBER}))?)?")


class Fault(NamedTuple):
    """One fault: start (s, None: at once), duration (s, 0: once or forever), and share of answers that it hits."""

    name: str
    start_s: float | None = None
    duration_s: float = 0.0
    share: float = 0.0  # share of answers; 0 for a fault without %PERCENT

    def lasts(self, now_s: float) -> bool:
        """Return whether the fault is active at this time, counted from its reference event."""
        start_s = self.start_s or 0.0
        return now_s >= start_s and (self.duration_s == 0.0 or now_s < start_s + self.duration_s)


def camera_fault(text: str) -> Fault:
    """Return a fault of a virtual camera; InputError if it does not exist."""
    return _parse(text, CAMERA_FAULTS, "camera")


def gripper_fault(text: str) -> Fault:
    """Return a fault of a virtual gripper; InputError if it does not exist."""
    return _parse(text, GRIPPER_FAULTS, "gripper")


def _parse(text: str, kinds: Mapping[str, FaultKind], device: str) -> Fault:
    form = _FORM.fullmatch(text)
    kind = kinds.get(form[1]) if form else None
    if form and kind:
        name, percent, start, duration = form.groups()
        fault = Fault(
            name,
            None if start is None else number(start),
            kind.usual_s if duration is None else number(duration),
            number(percent or "0") / 100.0,
        )
        if (
            (percent is None or (kind.percent and 0.0 < fault.share <= 1.0))
            and (start is None or (kind.moment and fault.start_s == fault.start_s))
            and (duration is None or (kind.duration and fault.duration_s > 0.0))
            and (duration is None or percent is not None or not kind.percent)
        ):
            return fault
    expected = f"NAME[%PERCENT][@SECONDS[:DURATION]], NAME one of {', '.join(kinds)}; docs/hardware.md: what each takes"
    raise InputError(f"not a fault of a virtual {device}", where=f"--{device}", expected=expected, found=text)
