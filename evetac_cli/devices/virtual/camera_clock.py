"""The clock of a virtual camera that jumps or runs at another rate: the same event words at other times."""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.devices.dvxplorer.event_word_loops import REF_MASK
from evetac_cli.events import SLICE_US

_COLUMN_CODE, _TIMESTAMP_CODE = 1, 2  # bits 26 up of a word
_US_BITS = 0x3FF << 11  # of a COLUMN word


class CameraClock:
    """What the camera's clock shows for the times that its words came with."""

    def __init__(self) -> None:
        self._ms = 0  # of the last TIMESTAMP that came
        self._true_us = 0  # up to here words were given other times
        self._shown_us = 0  # what the clock showed then
        self._sent_ms = 0  # of the last TIMESTAMP that went

    def retimed(self, words: NDArray[np.uint32], rate: tuple[int, int], jump_us: int) -> NDArray[np.uint32]:
        """The next words with the clock's times; a TIMESTAMP is added where a frame begins in another millisecond.

        rate: of the clock, as numerator and denominator; jump_us: by how much it jumps before these words.
        """
        if len(words) == 0:
            return words
        is_stamp, is_column = words >> 26 == _TIMESTAMP_CODE, words >> 26 == _COLUMN_CODE
        latest = np.maximum.accumulate(np.where(is_stamp, np.arange(1, len(words) + 1), 0))  # 0: of an earlier call
        ms = np.concatenate([[self._ms], (words & REF_MASK).astype(np.int64)])[latest]
        true_us = SLICE_US * ms + np.where(is_column, words >> 11 & 0x3FF, 0)
        shown_us = self._shown_us + jump_us + (true_us - self._true_us) * rate[0] // rate[1]
        last = int(np.argmax(true_us))
        self._ms, self._true_us, self._shown_us = int(ms[-1]), int(true_us[last]), int(shown_us[last])
        stamps = (_TIMESTAMP_CODE << 26 | shown_us // SLICE_US & REF_MASK).astype(np.uint32)
        columns = words & ~np.uint32(_US_BITS) | (shown_us % SLICE_US << 11).astype(np.uint32)
        retimed = np.where(is_stamp, stamps, np.where(is_column, columns, words))
        begins = is_stamp | (words >> 21 == (_COLUMN_CODE << 26 | 1 << 21) >> 21)
        places = np.flatnonzero(begins)
        if len(places) == 0:
            return retimed
        begun_ms = shown_us[places] // SLICE_US
        missing = (begun_ms != np.concatenate([[self._sent_ms], begun_ms[:-1]])) & ~is_stamp[places]
        self._sent_ms = int(begun_ms[-1])
        return np.insert(retimed, places[missing], stamps[places[missing]])
