"""The inside of a virtual DVXplorer Mini, behind its USB: registers, the stream of words, and faults.

Crop, flip and flatten are registers without effect: evetac's driver does not use them.
"""

import time
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from evetac_cli.devices.dvxplorer import protocol
from evetac_cli.devices.dvxplorer.event_word_loops import REF_MASK, events_in
from evetac_cli.devices.dvxplorer.protocol import Generation
from evetac_cli.devices.naming import CAMERA_FAULTS, camera_fault
from evetac_cli.events import FRAME_PX
from evetac_cli.realtime.shared_time import TimeSource

DEFAULT_FLUSH_US = 2000
_DAMAGED_SHARE = {"damage": 0.02, "random": 1.0}
_JUMP_MS = {"jump-forward": 5000, "jump-back": -5000}
_TORN_BYTES = 3
_BURST_BYTES = 16  # transfers are padded with zeros to a multiple of this
_LONGEST_WAIT_S = 0.05  # interval at which a waiting transfer checks whether the camera was unplugged
_SHORTEST_WAIT_S = 1e-6
_TIMESTAMP_CODE = 2  # bits 26 and up of a word


class WordSource(Protocol):
    """The source of a virtual camera's words."""

    @property
    def time(self) -> TimeSource:
        """The clock that determines when words arrive; the camera's driver uses it too."""

    def run(self, on: bool) -> None:
        """Start (True) or stop the stream."""

    def take(self, most: int, timeout_s: float) -> bytes:
        """Return at most this many bytes of little-endian words as they arrive; b"" if none arrived in time."""


class DeviceModel:
    """A camera without its USB; see VirtualDvxplorer for the arguments."""

    def __init__(self, source: WordSource, firmware: int, faults: tuple[str, ...], fifo_bytes: int) -> None:
        self.generation = protocol.generation(firmware)
        self.halted = False  # whether the data endpoint is halted
        self.overflowed = 0  # words that were not fetched in time
        self.events_seen = 0  # events of the sensor while it ran, including lost ones
        self._source = source
        self._faults = [camera_fault(text) for text in faults]
        self._done: set[str] = set()  # faults that strike once and have struck
        self._random = np.random.default_rng(0)
        self._registers = _registers(self.generation)
        self._fifo = bytearray()
        self._fifo_bytes = fifo_bytes
        self._ahead_ms = 0  # how far its clock has jumped
        self._part = b""  # bytes of a word that the source has not sent completely
        self._ran_s: float | None = None  # time of the first RUN
        self._runs = False
        self._sent_s = 0.0  # host time of the last transfer

    @property
    def waiting(self) -> bytes:
        """Words that were not fetched yet."""
        return bytes(self._fifo)

    def has(self, name: str) -> bool:
        """Return whether a fault is active now; faults from before RUN always are."""
        now_s = self._since_run_s if self._faults else 0.0  # without faults, the usual case, this loop is time-critical
        return any(each.name == name and (not CAMERA_FAULTS[name].moment or each.lasts(now_s)) for each in self._faults)

    def once(self, name: str) -> bool:
        """Return True once, when a fault that strikes once is due."""
        due = name not in self._done and self.has(name)
        if due:
            self._done.add(name)
        return due

    def _hits(self, name: str) -> bool:
        """Return whether a fault alters words now: while it is active, or later if no words arrived while it was."""
        now_s = self._since_run_s
        began = any(each.name == name and now_s >= (each.start_s or 0.0) for each in self._faults)
        hits = began and (name not in self._done or self.has(name))
        if hits:
            self._done.add(name)
        return hits

    @property
    def _since_run_s(self) -> float:
        """Time since the first RUN in s, below 0 before it."""
        return -1.0 if self._ran_s is None else self._source.time.now_s() - self._ran_s

    def read(self, module: int, parameter: int) -> int | None:
        """Return the value of a parameter; None if it does not exist."""
        return self._registers.get((module, parameter))

    def write(self, module: int, parameter: int, value: int) -> bool:
        """Set a parameter; return False if it does not exist or is read-only."""
        if (module, parameter) not in self._registers or (module == protocol.DVS and parameter < protocol.RUN):
            return False
        self._registers[module, parameter] = value
        if self.generation is Generation.PARAMETERS and (module, parameter) == (protocol.DVS, protocol.RUN):
            self._run(value != 0)
        elif (module, parameter) == (protocol.SENSOR, protocol.SENSOR_MODE):
            self._run(value == protocol.STREAM)
        return True

    def flush_stale(self) -> None:
        """Discard unfetched words of earlier runs."""
        self._fifo.clear()

    def power_off(self) -> None:
        """Stop the stream, as if the plug were pulled."""
        self._run(False)

    def transfer(self, most: int, timeout_s: float) -> bytes:
        """Return the data of one bulk transfer, which ends when it is full or after the flush time.

        Return b"" if nothing arrives in time.
        """
        end_s = time.monotonic() + timeout_s
        while self._fill(0.0):  # words that arrived between transfers are in a real camera's buffer
            pass
        is_asked = False  # whether the source was waited for: a stalled computer is not a camera without words
        while True:
            now_s = time.monotonic()
            flush_s = self._sent_s + 1e-6 * self._flush_us
            if len(self._fifo) >= most or (self._fifo and now_s >= flush_s):
                break
            if (now_s >= end_s and (is_asked or self._fifo)) or self.has("unplug") or self.halted:
                return b""
            if self._fifo:
                time.sleep(max(0.0, min(flush_s, end_s) - now_s))
                self._fill(0.0)
            else:
                self._fill(min(max(end_s - now_s, _SHORTEST_WAIT_S), _LONGEST_WAIT_S))
                is_asked = True
        if self.has("odd"):
            most = min(most, (max(len(self._fifo), 2) - 2) | 1)
        sent = bytes(self._fifo[:most])
        del self._fifo[:most]
        self._sent_s = time.monotonic()
        if len(sent) > 2 * _TORN_BYTES and self._tears():
            middle = len(sent) // 2
            return sent[:middle] + sent[middle + _TORN_BYTES :]
        return sent if len(sent) % 4 else sent + bytes(min(-len(sent) % _BURST_BYTES, most - len(sent)))

    @property
    def _flush_us(self) -> int:
        if self.generation is Generation.PARAMETERS and self._registers[protocol.DVS, protocol.MIPI_TIMEOUT_ON]:
            return self._registers[protocol.DVS, protocol.MIPI_TIMEOUT_US]
        return DEFAULT_FLUSH_US

    def _run(self, on: bool) -> None:
        if on == self._runs:
            return
        if on and self._ran_s is None:
            self._ran_s = self._source.time.now_s()
        self._runs = on
        self._source.run(on)

    def _fill(self, timeout_s: float) -> bool:
        """Move words from the source into the buffer, applying the camera's faults.

        When full, the oldest words are dropped.

        Return False if no words arrived in time.
        """
        if not self._runs:
            time.sleep(timeout_s)
            return False
        data = self._part + self._source.take(self._fifo_bytes, timeout_s)
        whole = len(data) // 4 * 4
        self._part = data[whole:]
        if not whole:
            return False
        words = np.frombuffer(data, "<u4", whole // 4)
        if not self._faults:  # the usual case: words pass through
            self.events_seen += events_in(words)
            self._keep(data[:whole])
            return True
        self._ahead_ms += sum(jump for name, jump in _JUMP_MS.items() if self.once(name))
        words = shifted(words, self._ahead_ms)
        self.events_seen += events_in(words)
        if self._hits("silence"):
            return True
        if self._hits("lost-timestamps"):
            words = words[words >> 26 != _TIMESTAMP_CODE]
        for name, share in _DAMAGED_SHARE.items():
            if self._hits(name):
                hit = self._random.random(len(words)) < share
                words = np.where(hit, self._random.integers(0, 1 << 32, len(words), np.uint32), words)
        self._keep(words.astype("<u4", copy=False).tobytes())
        return True

    def _keep(self, data: bytes) -> None:
        """Append words to the buffer."""
        self._fifo += data
        over = (len(self._fifo) - self._fifo_bytes + 3) // 4
        if over > 0:
            self.overflowed += over
            del self._fifo[: 4 * over]

    def _tears(self) -> bool:
        """Return whether bytes are to be removed from the transfer that is due."""
        lasting = any(each.name == "torn" and each.duration_s for each in self._faults)
        return self._hits("torn") if lasting else self.once("torn")


def shifted(words: NDArray[np.uint32], ahead_ms: int) -> NDArray[np.uint32]:
    """Return the words of a clock that is ahead by some ms, below 0 behind: its TIMESTAMPs wrap as the camera's do."""
    stamps = words + np.uint32(ahead_ms & REF_MASK) & REF_MASK | _TIMESTAMP_CODE << 26
    return np.where(words >> 26 == _TIMESTAMP_CODE, stamps, words).astype(np.uint32)


def _registers(generation: Generation) -> dict[tuple[int, int], int]:
    """Return the values at power-up of all parameters of a generation, by (module, parameter)."""
    width, height = FRAME_PX
    if generation is Generation.PARAMETERS:
        zero = {(protocol.DVS, k): 0 for k in range(26)} | {(protocol.IMU, k): 0 for k in range(11)}
        return zero | {
            (protocol.DVS, protocol.COLUMNS): width,
            (protocol.DVS, protocol.ROWS): height,
            (protocol.DVS, protocol.MIPI_TIMEOUT_ON): 1,
            (protocol.DVS, protocol.MIPI_TIMEOUT_US): DEFAULT_FLUSH_US,
            (protocol.DVS, protocol.CROP + 2): width,
            (protocol.DVS, protocol.CROP + 3): height,
        }
    zero = {(protocol.DVS, k): 0 for k in (2, 3, 0x50)} | {(protocol.IMU, k): 0 for k in range(11)}
    zero |= {(protocol.SYSTEM, k): 0 for k in range(8)} | {(0, 0x50): 0, (4, 10): 0}
    zero |= {(protocol.SENSOR, register): 0 for register in (*range(0x20), *range(0x3000, 0x3600))}
    return zero | {
        (protocol.DVS, protocol.COLUMNS): width,
        (protocol.DVS, protocol.ROWS): height,
        (protocol.SYSTEM, 0): 18,  # logic version and patch that the maker's driver requires
        (protocol.SYSTEM, 1): 20,
        (protocol.SYSTEM, 7): 2,
        (protocol.SENSOR, 0x3255): 0x0C,
        (protocol.SENSOR, 0x3067): 0x80,
        (protocol.SENSOR, 0x3200): 0x02,
    }
