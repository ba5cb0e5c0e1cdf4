"""Words of Prophesee's encodings EVT2, EVT2.1 and EVT3.

    EVT2    32 bits, the upper four the type: 0 and 1 an event (darker, brighter) with six bits of time, eleven of
            column, eleven of row; 8 the 28 high bits of time; A a trigger
    EVT2.1  64 bits, the upper four the type: as EVT2, and one bit for each of 32 columns, starting at the word's column
    EVT3    16 bits, the upper four the type: 0 row; 2 column and polarity, an event; 3 first column of a vector and its
            polarity; 4 and 5 its next twelve and eight columns, one bit each; 6 and 8 the low and the high twelve bits
            of time; A a trigger

Other types that Prophesee documents contain no events and are skipped. Words before the first high bits of time have no
time and are left out, as in Prophesee's own software. Source: Prophesee's pages on EVT 2.0, EVT 2.1 and EVT 3.0.
"""

from typing import NamedTuple

import numpy as np

TIME_HIGH, TRIGGER = 0x8, 0xA  # types of words

# The state at the beginning of a block: unwrapped high bits of time; for EVT3 also the low bits, the row, and the next
# column and the polarity of a vector.
STATE = np.dtype([(name, np.int64) for name in ("high", "low", "y", "x", "p")])


class Encoding(NamedTuple):
    """An encoding of words.

    name, dtype; number and tick (us) of the high bits of time, and their shift in a word; the defined types; and the
    largest number of events per word of a type.
    """

    name: str
    dtype: str
    high_bits: int
    tick_us: int
    high_at: int
    types: frozenset[int]
    most_events: dict[int, int]


PLAIN = frozenset((0x0, 0x1, TIME_HIGH, TRIGGER, 0xE, 0xF))
VECTORS = frozenset((0x0, 0x2, 0x3, 0x4, 0x5, 0x6, 0x7, TIME_HIGH, TRIGGER, 0xE, 0xF))
ENCODINGS = {
    "evt2": Encoding("EVT2", "<u4", 28, 64, 0, PLAIN, {0: 1, 1: 1}),
    "evt2.1": Encoding("EVT2.1", "<u8", 28, 64, 32, PLAIN, {0: 32, 1: 32}),
    "evt3": Encoding("EVT3", "<u2", 12, 4096, 0, VECTORS, {2: 1, 4: 12, 5: 8}),
}
