"""The note that an export writes into a file, and an import reads back: what the format itself cannot say.

Formats of events hold events: a recording that begins or ends in silence would come back shorter, text and HDF5 do not
say how large the frame is, and none says that its events come from a simulation. The note is one line of JSON: in
AEDAT4 among the stream's metadata, in HDF5 an attribute of the root, in text a comment before the first event.
"""

import json
from dataclasses import asdict, dataclass
from typing import Any

from evetac_cli.errors import InputError
from evetac_cli.text_files import parse_json

NAME = "evetac"
# Beyond 2^53 us (285 years) a float no longer holds whole microseconds. Camera clocks that count from 1970 are at 2^51.
CLOCK_LIMIT_US = 2**53
# Of any import, 6 h: an index takes 8 bytes a slice, some copies at a time, and is to stay below 1 GB.
LONGEST_SLICES = 6 * 3600 * 1000 + 1


@dataclass(frozen=True)
class Note:
    """What the recording was: its first microsecond in the file's clock, its slices, its frame, where it comes from."""

    start_us: int
    slices: int
    frame_px: tuple[int, int]
    simulated: bool
    events: int | None = None  # how many were written: shows whether the file still has its end

    def text(self) -> str:
        """The note as one line of JSON, as it is written into the file."""
        return json.dumps(asdict(self))


def read_note(text: str, where: str) -> Note:
    """Read a note back; InputError if somebody edited it into something else."""
    try:
        fields: dict[str, Any] = dict(parse_json(text))
        start_us, slices, (width, height) = fields["start_us"], fields["slices"], fields["frame_px"]
        events = fields.get("events")
        whole = all(type(number) is int for number in (start_us, slices, width, height, events or 0))
        if not whole or type(fields["simulated"]) is not bool:
            raise ValueError("values of other types")
        if not 0 <= slices <= LONGEST_SLICES:
            raise ValueError(f"{slices} slices")
        if abs(start_us) > CLOCK_LIMIT_US or (events is not None and not 0 <= events <= CLOCK_LIMIT_US):
            raise ValueError(f"begins at {start_us} us, {events} events")
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"the note that evetac left in it is damaged: {str(error)[:80]}",
            where=where,
            expected=f"JSON with {', '.join(Note.__dataclass_fields__)}",
            found=text[:80],
        ) from None
    return Note(start_us, slices, (width, height), fields["simulated"], events)
