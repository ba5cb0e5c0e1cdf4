"""Prepared event words for a virtual camera to send."""

import math
import time
from threading import Condition

import numpy as np
from numpy.typing import NDArray

from evetac_cli.devices.dvxplorer.event_word_loops import REF_MASK
from evetac_cli.devices.dvxplorer.event_words import encode
from evetac_cli.errors import check_range
from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.realtime.shared_time import HOST_TIME, READER_S, SharedTime, TimeSource

_FRAME_US = 200  # frame time of the random events: the camera's default readout
_DIFFERENT_FRAMES = 500


class PreparedWords:
    """A stream of words as a camera would have sent it, at its own pace or as fast as it is fetched.

    paced: a word may be taken once the time of its frame has passed since `run`. Unpaced, words are available whenever
    a reader waits for them, so no buffer overflows. Device time then runs ahead of the host's, and the driver believes
    no silence of more than a second.
    """

    def __init__(
        self,
        words: NDArray[np.uint32],
        *,
        paced: bool = True,
        times: int = 1,
        period_ms: int = 0,
        time: TimeSource = HOST_TIME,
    ) -> None:
        """times: how often the words are sent, each time with TIMESTAMPs that are period_ms later.

        time: the clock that determines when words are due; a SharedTime waits for a driver whose slices are not read in
        time.
        """
        self._words = words.astype("<u4")
        self._is_stamp = words >> 26 == 2
        self.times, self._period_ms = times, period_ms
        self._due_us = due_us(words) if paced else None
        self.time = time
        self._at = 0  # number of bytes taken
        self._bytes = 4 * len(words) * times
        self._ran_us = 0.0  # running time before the present run
        self._began_s: float | None = None  # start of the present run
        self._changed = Condition()

    @property
    def left(self) -> int:
        """Number of words that were not taken yet."""
        return (self._bytes - self._at) // 4

    def run(self, on: bool) -> None:
        """Let time pass (True) or stop it."""
        with self._changed:
            now_s = self.time.now_s()
            if self._began_s is not None:
                self._ran_us += 1e6 * (now_s - self._began_s)
            self._began_s = now_s if on else None
            self._limit_time()
            self._changed.notify_all()

    def take(self, most: int, timeout_s: float) -> bytes:
        """Return at most this many bytes that are due, waiting for the first; b"" if there are none in time."""
        end_s = time.monotonic() + timeout_s if timeout_s > 0 else 0.0
        with self._changed:
            self._limit_time()
            while (due := self._due()) == self._at or (self._due_us is None and timeout_s <= 0):
                left_s = end_s - time.monotonic() if timeout_s > 0 else 0.0
                if left_s <= 0:
                    return b""
                wait_s = self._wait_s()
                self._changed.wait(left_s if wait_s is None else min(left_s, wait_s))
                self._limit_time()
            start = self._at
            self._at = min(start + most, due)
            return self._between(start, self._at)

    def _between(self, start: int, end: int) -> bytes:
        """Return the bytes [start, end) of the whole stream."""
        parts = []
        length = 4 * len(self._words)
        for turn in range(start // length, -(-end // length)):
            first, last = max(start - turn * length, 0), min(end - turn * length, length)
            part = slice(first // 4, -(-last // 4))
            words = self._words[part].copy()
            words[self._is_stamp[part]] += np.uint32(turn * self._period_ms)
            parts.append(words.tobytes()[first % 4 : first % 4 + last - first])
        return b"".join(parts)

    def _limit_time(self) -> None:
        """Let time advance as far as the reader of the slices has come."""
        if isinstance(self.time, SharedTime):
            ends = self._began_s is None or self._at == self._bytes
            self.time.limit(math.inf if ends else self.time.reader_s + READER_S)

    def _due(self) -> int:
        """Return the number of bytes from the start that are due."""
        if self._began_s is None:
            return self._at
        if self._due_us is None:
            return self._bytes
        passed_us = int(self._ran_us + 1e6 * (self.time.now_s() - self._began_s))
        turn = min(passed_us // (SLICE_US * self._period_ms), self.times - 1) if self.times > 1 else 0
        within_us = passed_us - turn * SLICE_US * self._period_ms
        return 4 * (turn * len(self._words) + int(self._due_us.searchsorted(within_us, side="right")))

    def _wait_s(self) -> float | None:
        """Return the time until the next word is due, in s; None if none will be."""
        if self._began_s is None or self._due_us is None or self._at == self._bytes:
            return None
        turn, place = divmod(self._at // 4, len(self._words))
        next_us = float(self._due_us[place]) + turn * SLICE_US * self._period_ms
        return max(1e-6, self._began_s + 1e-6 * (next_us - self._ran_us) - self.time.now_s())


def due_us(words: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Return the time of every word after the first TIMESTAMP, in us: the time of its frame, or its own."""
    if len(words) == 0:
        return np.empty(0, np.int64)
    stamps = np.flatnonzero(words >> 26 == 2)
    ref = (words[stamps] & REF_MASK).astype(np.int64)
    ms = np.cumsum(np.diff(ref, prepend=ref[:1]) & REF_MASK)
    of_stamp = np.zeros(len(words), np.int64)
    of_stamp[stamps] = SLICE_US * np.diff(ms, prepend=0)
    begins = words >> 21 == (1 << 26 | 1 << 21) >> 21
    within = np.where(begins, words >> 11 & 0x3FF, 0).astype(np.int64)
    latest = np.maximum.accumulate(np.where(begins | (words >> 26 == 2), np.arange(len(words)), 0))
    return np.cumsum(of_stamp) + within[latest]


def random_event_words(events_per_s: float, seconds: float, rng: np.random.Generator) -> NDArray[np.uint32]:
    """Return words of random events, equally many per frame and no pixel twice in a frame: a load of known size.

    The total is seconds * events_per_s, rounded to whole events per frame of 200 us. The events fall in patches of 8 x
    8 pixels, half of which fire, with about two events per word; after 0.1 s the pattern repeats. ValueError for less
    than one event per frame, and for more than half of the pixels.
    """
    frames = round(seconds * 1e6 / _FRAME_US)
    width, height = FRAME_PX
    # one event per frame, half of all pixels per frame
    least, most = 1e6 / _FRAME_US, width * height / 2 * 1e6 / _FRAME_US
    check_range("events_per_s", events_per_s, least, most)
    each = round(events_per_s * _FRAME_US * 1e-6)
    patches = -(-each // 32)
    parts = []
    for _ in range(min(frames, _DIFFERENT_FRAMES)):
        patch = rng.choice(width * height // 64, patches, replace=False)
        x = (8 * (patch % (width // 8)))[:, np.newaxis] + np.arange(64) % 8
        y = (8 * (patch // (width // 8)))[:, np.newaxis] + np.arange(64) // 8
        picks = rng.choice(64 * patches, each, replace=False)
        polarity = np.broadcast_to(rng.integers(0, 2, patches)[:, np.newaxis], (patches, 64))
        parts.append((x.ravel()[picks], y.ravel()[picks], polarity.ravel()[picks]))
    t = np.repeat(_FRAME_US * np.arange(len(parts), dtype=np.int64) + _FRAME_US // 2, each)
    x, y, p = (np.concatenate(column) for column in zip(*parts, strict=True))
    once = Events(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))
    times, rest = divmod(frames, _DIFFERENT_FRAMES)
    words = np.tile(encode(once), (times, 1))
    again_ms = _DIFFERENT_FRAMES * _FRAME_US // SLICE_US * np.arange(times, dtype=np.uint32)[:, np.newaxis]
    words = np.where(words >> 26 == 2, words + again_ms, words)
    last = encode(once.part(0, rest * each), first_ms=1 + _DIFFERENT_FRAMES * _FRAME_US // SLICE_US * times)
    return np.concatenate([words.ravel(), last])
