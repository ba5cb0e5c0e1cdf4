"""What comes over a wire, damaged: words of the camera into its decoder, answers of the servo into its bus.

Neither is a command of its own, so both are called here; as in a command, an EvetacError is an answer, all else is not.
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

LONGEST_PIECE = 4096  # bytes a USB transfer brings at most here
BAUD = 2_000_000
REGISTERS = ("Torque Enable", "Goal Current", "Present Position", "Hardware Error Status", "Bus Watchdog")


def write_words(path: Path, events: Events) -> None:
    """Write the words in which the camera would send events."""
    path.write_bytes(event_words.encode(events, frame_us=200).astype("<u4").tobytes())


def write_answers(path: Path) -> None:
    """Write answers of a servo to a ping, to reads of one to ten bytes, and to writes."""
    answers = [status(1, parameters=bytes([160, 134, 11]))]
    answers += [status(1, parameters=bytes(size), alert=alert) for size in (1, 2, 4, 10, 0) for alert in (False, True)]
    path.write_bytes(b"".join(answers))


def decode(path: Path) -> None:
    """Decode damaged words, cut at random places; AssertionError if what comes out cannot be."""
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
    """Let a bus ask a servo that gives damaged answers, one to each question."""
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
