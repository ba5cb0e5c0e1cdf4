"""The note that an export writes into a file and an import reads back: facts that the format itself cannot store.

Event formats store only events. Without the note, a recording that begins or ends without events would come back
shorter. Text and HDF5 do not store the frame size, and no format stores whether the events are simulated. The note is
one line of JSON: metadata of the stream in AEDAT4, an attribute of the root in HDF5, a comment before the first event
in text.
"""

import json
from dataclasses import asdict, dataclass
from typing import Annotated

import msgspec
from msgspec import Meta

from evetac_cli.errors import InputError
from evetac_cli.text_files import parse_json

NAME = "evetac"
# Beyond 2^53 us (285 years) a float no longer represents whole microseconds. Camera clocks counted from 1970 are at
# 2^51.
CLOCK_LIMIT_US = 2**53
# The longest recording that any import may produce, 6 h: an index takes 8 bytes per slice, exists in several copies at
# a time, and must stay below 1 GB.
LONGEST_SLICES = 6 * 3600 * 1000 + 1


@dataclass(frozen=True)
class Note:
    """The exported recording: its first microsecond in the file's clock, its slices, its frame, and its origin."""

    start_us: Annotated[int, Meta(ge=-CLOCK_LIMIT_US, le=CLOCK_LIMIT_US)]
    slices: Annotated[int, Meta(ge=0, le=LONGEST_SLICES)]
    frame_px: tuple[int, int]
    simulated: bool
    events: Annotated[int, Meta(ge=0, le=CLOCK_LIMIT_US)] | None = None  # written; fewer mean that the end is missing

    def text(self) -> str:
        """Return the note as one line of JSON, as it is written into the file."""
        return json.dumps(asdict(self))


def read_note(text: str, where: str) -> Note:
    """Parse a note; raise InputError if it was edited and no longer has the expected fields and values."""
    try:
        return msgspec.convert(parse_json(text), Note)
    except ValueError as error:
        message = f"the note that evetac wrote into this file is damaged: {str(error)[:80]}"
        raise InputError(message, where=where, found=text[:80]) from None
