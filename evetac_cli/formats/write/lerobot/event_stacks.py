"""The last event frames before each frame of an episode, as pictures: the input of networks such as MiTaS.

`16@200` means 16 frames at 200 Hz. They are the frames of `Recording.frames`, ON minus OFF. The youngest one ends no
later than the episode's frame, so that none shows the future. Frames before the recording are empty.

Each position in the stack is one picture feature; they are not one feature of (16, 120, 160) numbers. Reasons: the
policies of lerobot 0.6 accept pictures but ignore other arrays, and statistics of arrays are computed along the last
axis only. Arrays are also stored uncompressed in the copy that lerobot makes when it opens a data set: 1.2 MB per
frame, 61 MB per second at 50 fps. PNG is exact too; four simulated grasps took 0.53 MB per second. Why not video: it is
not exact, and 16 videos would have to be opened for each frame.
"""

import io
import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Ints
from evetac_cli.errors import InputError, needs_extra
from evetac_cli.events import SLICE_US, SLICES_PER_S
from evetac_cli.formats.write.lerobot.episodes import MOST_BYTES
from evetac_cli.formats.write.lerobot.meta_files import Feature
from evetac_cli.store.recordings.read import Recording

WRITTEN = re.compile(r"(\d{1,3})@(\d{1,4}(?:\.\d{1,3})?)")
MOST_FRAMES = 64
SIZE_PX = (160, 120)  # default width and height
NO_EVENT, FULL = 128, 127  # grey level of a pixel without events, and the largest deviation from it
KEY = "observation.images.tactile_{:02d}"


class Stills(NamedTuple):
    """The pictures of an episode as PNG, which of them each frame has, and their grey levels.

    places: (frames, depth), numbers of the pictures, oldest first. pixels: (pictures, 256), pixels per grey level.
    """

    pictures: Sequence[bytes]
    places: Ints
    pixels: Ints


class EventStacks(NamedTuple):
    """A stack of `depth` event frames of a size in px at a rate in Hz.

    full_scale: surplus of events of one sign that is shown as 0.5; larger values are clipped.
    """

    depth: int
    rate_hz: float
    size_px: tuple[int, int]
    full_scale: int

    def keys(self) -> list[str]:
        """Return the names of the features, oldest frame first."""
        return [KEY.format(place) for place in range(self.depth)]

    def features(self) -> dict[str, Feature]:
        """Return a feature for each position in the stack."""
        width, height = self.size_px
        info = {"events.rate_hz": self.rate_hz, "events.no_event": NO_EVENT, "events.full_scale": self.full_scale}
        axes = ("height", "width", "channels")
        keys = self.keys()
        shortest, longest = (round_(SLICES_PER_S / self.rate_hz) for round_ in (math.floor, math.ceil))
        length = f"{shortest} ms" if shortest == longest else f"{shortest} or {longest} ms"
        words = (
            f"event frames of {length} at {self.rate_hz:g} Hz, each from the end of the one before, ON minus OFF: of"
            f" the last {self.depth} frames, the oldest is `{keys[0]}`, the youngest `{keys[-1]}`."
            f" (level - {NO_EVENT}) / {2 * FULL} is 0 without events, and 0.5 or -0.5 for {self.full_scale} or more"
        )
        return {key: Feature("image", (height, width, 3), axes, words, info) for key in keys}

    def grey(self, counts: NDArray[np.int16]) -> NDArray[np.uint8]:
        """Convert counts, ON minus OFF, to grey levels."""
        share = np.clip(counts / self.full_scale, -1.0, 1.0)
        return (NO_EVENT + np.rint(FULL * share)).astype(np.uint8)

    def stills(self, recording: Recording, edges: Ints) -> Stills:
        """Return the pictures of frames with these edges in slices, (frames + 1,); raise InputError if too many."""
        encode = png_encoder(str(recording.path))
        slices = max(1, int(edges[-1]))
        # How often one picture is written into the table.
        copies = max(1.0, self.depth * len(edges) / max(1.0, slices * self.rate_hz / SLICES_PER_S))
        blank = np.full(self.size_px[::-1], NO_EVENT, np.uint8)
        pictures, pixels, ends = [encode(blank)], [np.bincount(blank.ravel(), minlength=256)], [0]
        for block in recording.frames(self.rate_hz, self.size_px, polarity="signed"):
            greys = self.grey(block.images[:, 0])
            pictures += [encode(grey) for grey in greys]
            pixels += [np.bincount(grey.ravel(), minlength=256) for grey in greys]
            ends += block.end_us.tolist()
            if copies * sum(map(len, pictures)) > MOST_BYTES:
                most_s = block.end_us[-1] / SLICE_US / SLICES_PER_S
                message, where = "the recording is too long for event frames", str(recording.path)
                expected = f"at most {most_s:.0f} s, or a smaller --event-frames or --size"
                raise InputError(message, where=where, expected=expected, hint="cut it with `evetac trim`")
        last = np.searchsorted(ends, edges[1:] * SLICE_US, side="right") - 1
        places = np.maximum(last[:, None] - np.arange(self.depth - 1, -1, -1), 0)
        return Stills(pictures, places, np.array(pixels))


def parse(text: str | None, size_px: tuple[int, int] | None, frame_px: tuple[int, int]) -> EventStacks | None:
    """Parse `--event-frames` for recordings of this frame size; None without it; raise InputError if it is invalid."""
    if text is None:
        if size_px is not None:
            raise InputError("has no effect without --event-frames", where="--size")
        return None
    read = WRITTEN.fullmatch(text.strip())
    depth, rate_hz = (int(read[1]), float(read[2])) if read else (0, 0.0)
    if not (1 <= depth <= MOST_FRAMES and 0 < rate_hz <= SLICES_PER_S):
        expected = f"FRAMES@HZ with up to {MOST_FRAMES} frames at up to {SLICES_PER_S} Hz, for example 16@200"
        raise InputError("not a valid stack of event frames", where="--event-frames", expected=expected, found=text)
    width, height = size_px = SIZE_PX if size_px is None else size_px
    if not (1 <= width <= frame_px[0] and 1 <= height <= frame_px[1]):
        expected, found = f"at most the sensor's {frame_px[0]} x {frame_px[1]} px", f"{width} x {height}"
        raise InputError("not a valid size of event frames", where="--size", expected=expected, found=found)
    return EventStacks(depth, rate_hz, size_px, full_scale(frame_px, size_px))


def full_scale(frame_px: tuple[int, int], size_px: tuple[int, int]) -> int:
    """Return the events of one sign that a picture's pixel shows at most: one per sensor pixel that it covers."""
    return max(1, round(frame_px[0] * frame_px[1] / (size_px[0] * size_px[1])))


def png_encoder(where: str) -> Any:
    """Return a function that encodes grey (height, width) as an RGB PNG, which policies require.

    Raises MissingLibrary if pillow is not installed.
    """
    with needs_extra("event frames need pillow", "convert", where):
        from PIL import Image

    def encode(grey: NDArray[np.uint8]) -> bytes:
        data = io.BytesIO()
        Image.fromarray(grey).convert("RGB").save(data, "PNG")
        return data.getvalue()

    return encode


def column(arrow: Any, stills: Stills, place: int) -> Any:
    """Return one position of the stack as a column of the table, in the type that `datasets` uses for pictures."""
    data = arrow.array([stills.pictures[number] for number in stills.places[:, place].tolist()], arrow.binary())
    names = arrow.nulls(len(data), arrow.string())
    return arrow.StructArray.from_arrays([data, names], names=["bytes", "path"])


def pixels_of(stills: Stills) -> list[Ints]:
    """Return, for each position of the stack, the number of pixels of each grey level in all frames."""
    counted = [np.bincount(numbers, minlength=len(stills.pictures)) for numbers in stills.places.T]
    return [count @ stills.pixels for count in counted]
