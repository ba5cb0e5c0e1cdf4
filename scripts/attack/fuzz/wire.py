"""Damage data that arrives over a wire: camera words for the decoder, and servo answers for the bus.

Neither has a command of its own, so both are called directly. As in a command, an EvetacError is a valid outcome; any
other exception is not.
"""

import os
import threading
import tty
from pathlib import Path

import numpy as np

from evetac_cli.devices.dvxplorer import event_words
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import Bus
from evetac_cli.devices.virtual.dynamixel_frames import HEADER, status
from evetac_cli.errors import EvetacError
from evetac_cli.events import FRAME_PX, Events

LONGEST_PIECE = 4096  # the most bytes that a USB transfer contains here
BAUD = 2_000_000
REGISTERS = ("Torque Enable", "Goal Current", "Present Position", "Hardware Error Status", "Bus Watchdog")


def write_words(path: Path, events: Events) -> None:
    """Write events as the camera's words."""
    path.write_bytes(event_words.encode(events, frame_us=200).astype("<u4").tobytes())


def write_answers(path: Path) -> None:
    """Write servo answers to a ping, to reads of one to ten bytes, and to writes."""
    answers = [status(1, parameters=bytes([160, 134, 11]))]
    answers += [status(1, parameters=bytes(size), alert=alert) for size in (1, 2, 4, 10, 0) for alert in (False, True)]
    path.write_bytes(b"".join(answers))


def decode(path: Path) -> None:
    """Decode damaged words, cut at random places; AssertionError if the events are impossible."""
    data = path.read_bytes()
    rng = np.random.default_rng(len(data))
    decoder, at, last_us, host_ms = event_words.start(), 0, -1, 0
    while at < len(data):
        size = int(rng.integers(1, LONGEST_PIECE))
        events = event_words.step(decoder, data[at : at + size], host_ms if rng.random() < 0.9 else None)
        at, host_ms = at + size, host_ms + 1
        if events.size:
            assert events.t[0] >= last_us and (np.diff(events.t) >= 0).all(), "time goes backwards"
            assert events.x.max() < FRAME_PX[0] and events.y.max() < FRAME_PX[1], "outside the frame"
            assert events.p.max() <= 1, "no polarity"
            last_us = int(events.t[-1])
    event_words.flush(decoder)
    assert all(count >= 0 for count in decoder.counted.values()), "a negative count"


def converse(path: Path) -> None:
    """Let a bus query a servo that returns damaged answers, one for each request."""
    answers = [HEADER + rest for rest in path.read_bytes().split(HEADER)]
    ours, theirs = os.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    threading.Thread(target=_answer, args=(ours, answers), daemon=True).start()
    with Bus(os.ttyname(theirs), BAUD, answer_ms=5) as bus:
        bus.tolerant = True
        for name in REGISTERS:
            for action in (bus.ping, lambda name=name: bus.read(name), lambda name=name: bus.write(name, 1)):
                try:
                    action()
                except EvetacError:
                    continue


def _answer(port: int, answers: list[bytes]) -> None:
    number = 0
    try:
        while os.read(port, 1024):
            os.write(port, answers[number % len(answers)])
            number += 1
    except OSError:
        return  # the other end was closed


CALLS = {"words": decode, "answers": converse}
