"""The last event frames before each frame of an episode, as pictures: what networks of events such as MiTaS take in.

`16@200` stands for 16 frames at 200 Hz. They are those of `Recording.frames`, ON less OFF; the youngest ended by the
end of the episode's frame, so that none shows what came later. Before the recording there was no event.

Why pictures, one feature for each place in the stack, and no feature of (16, 120, 160) numbers: the policies that come
with lerobot 0.6 take pictures in and leave aside any other array, of whose values lerobot keeps statistics along the
last axis alone. lerobot also keeps arrays uncompressed in the copy that it makes when it opens a data set: 1.2 MB a
frame, 61 MB for a second of 50. As PNG they are exact too, and four simulated grasps took 0.53 MB a second. Why no
video: it is not exact, and 16 would have to be opened for each frame.
"""

import io
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Ints
from evetac_cli.errors import InputError, missing_extra
from evetac_cli.events import SLICE_US, SLICES_PER_S
from evetac_cli.formats.write.lerobot.episodes import MOST_BYTES
from evetac_cli.formats.write.lerobot.features import Feature
from evetac_cli.store.recordings.read import Recording

WRITTEN = re.compile(r"(\d{1,3})@(\d{1,4}(?:\.\d{1,3})?)")
MOST_FRAMES = 64
SIZE_PX = (160, 120)  # width and height unless chosen
NO_EVENT, FULL = 128, 127  # grey of a pixel without events, and how much darker or brighter it can be
KEY = "observation.images.tactile_{:02d}"


class Stills(NamedTuple):
    """The pictures of an episode: those that there are, as PNG, which stand in each frame, and their grey levels.

    places: (frames, depth), the number of the picture, oldest first; pixels: (pictures, 256) of each level.
    """

    pictures: Sequence[bytes]
    places: Ints
    pixels: Ints


class EventStacks(NamedTuple):
    """So many event frames of a size in px at a rate; full_scale: so many events more of one sign, or more, are 0.5."""

    depth: int
    rate_hz: float
    size_px: tuple[int, int]
    full_scale: int

    def keys(self) -> list[str]:
        """The names of the features, the oldest frame first."""
        return [KEY.format(place) for place in range(self.depth)]

    def features(self) -> dict[str, Feature]:
        """A feature for each place in the stack."""
        width, height = self.size_px
        info = {"events.rate_hz": self.rate_hz, "events.no_event": NO_EVENT, "events.full_scale": self.full_scale}
        axes = ("height", "width", "channels")
        named = self.keys()
        words = (
            f"the events of {1e3 / self.rate_hz:g} ms, ON less OFF: of the last {self.depth} such frames the oldest is"
            f" `{named[0]}`, the last `{named[-1]}`. (level - {NO_EVENT}) / {2 * FULL} is 0 without events, and 0.5"
            f" or -0.5 from {self.full_scale} on"
        )
        return {key: Feature("image", (height, width, 3), axes, words, info) for key in named}

    def grey(self, counts: NDArray[np.int16]) -> NDArray[np.uint8]:
        """Counts ON less OFF as levels of grey."""
        share = np.clip(counts / self.full_scale, -1.0, 1.0)
        return (NO_EVENT + np.rint(FULL * share)).astype(np.uint8)

    def stills(self, recording: Recording, edges: Ints) -> Stills:
        """The pictures of frames that begin and end at these slices, (frames + 1,); InputError if they are too many."""
        encode = png_encoder(str(recording.path))
        slices = max(1, int(edges[-1]))
        copies = max(1.0, self.depth * len(edges) / max(1.0, slices * self.rate_hz / SLICES_PER_S))  # of a picture
        blank = np.full(self.size_px[::-1], NO_EVENT, np.uint8)
        pictures, pixels, ends = [encode(blank)], [np.bincount(blank.ravel(), minlength=256)], [0]
        for block in recording.frames(self.rate_hz, self.size_px, polarity="signed"):
            greys = self.grey(block.images[:, 0])
            pictures += [encode(grey) for grey in greys]
            pixels += [np.bincount(grey.ravel(), minlength=256) for grey in greys]
            ends += block.end_us.tolist()
            if copies * sum(map(len, pictures)) > MOST_BYTES:
                at_s = block.end_us[-1] / SLICE_US / SLICES_PER_S
                raise InputError(
                    "too long for event frames",
                    where=str(recording.path),
                    expected=f"at most {at_s:.0f} s, or a smaller --event-frames or --size",
                    found=f"{slices / SLICES_PER_S:.0f} s",
                    hint="cut it with `evetac trim`",
                )
        last = np.searchsorted(ends, edges[1:] * SLICE_US, side="right") - 1
        places = np.maximum(last[:, None] - np.arange(self.depth - 1, -1, -1), 0)
        return Stills(pictures, places, np.array(pixels))


def parse(text: str | None, size_px: tuple[int, int] | None, frame_px: tuple[int, int]) -> EventStacks | None:
    """The stacks that `--event-frames` asks for, of recordings of this frame; None without; InputError."""
    if text is None:
        if size_px is not None:
            raise InputError("has no effect", where="--size", expected="--event-frames too", found="none")
        return None
    read = WRITTEN.fullmatch(text.strip())
    depth, rate_hz = (int(read[1]), float(read[2])) if read else (0, 0.0)
    if not (1 <= depth <= MOST_FRAMES and 0 < rate_hz <= SLICES_PER_S):
        expected = f"at most {MOST_FRAMES} frames at a rate up to {SLICES_PER_S} Hz, as in 16@200"
        raise InputError("no event frames", where="--event-frames", expected=expected, found=text)
    width, height = size_px = SIZE_PX if size_px is None else size_px
    if not (1 <= width <= frame_px[0] and 1 <= height <= frame_px[1]):
        expected = f"at most the sensor's {frame_px[0]} x {frame_px[1]} px"
        raise InputError("no size of event frames", where="--size", expected=expected, found=f"{width} x {height}")
    return EventStacks(depth, rate_hz, size_px, full_scale(frame_px, size_px))


def full_scale(frame_px: tuple[int, int], size_px: tuple[int, int]) -> int:
    """How many events of one sign are the most that a picture shows: one of each of the sensor's pixels in its own."""
    return max(1, round(frame_px[0] * frame_px[1] / (size_px[0] * size_px[1])))


def png_encoder(where: str) -> Any:
    """Grey (height, width) -> PNG of red, green and blue, which policies want; MissingLibrary."""
    try:
        from PIL import Image
    except ImportError as error:
        raise missing_extra("event frames need pillow", "convert", where=where, error=error) from None

    def encode(grey: NDArray[np.uint8]) -> bytes:
        data = io.BytesIO()
        Image.fromarray(grey).convert("RGB").save(data, "PNG")
        return data.getvalue()

    return encode


def column(arrow: Any, stills: Stills, place: int) -> Any:
    """One place of the stack as a column of the table, as `datasets` reads pictures."""
    data = arrow.array([stills.pictures[number] for number in stills.places[:, place].tolist()], arrow.binary())
    names = arrow.nulls(len(data), arrow.string())
    return arrow.StructArray.from_arrays([data, names], names=["bytes", "path"])


def pixels_of(stills: Stills) -> list[Ints]:
    """How many pixels of each grey level all frames have, for each place of the stack."""
    counted = [np.bincount(numbers, minlength=len(stills.pictures)) for numbers in stills.places.T]
    return [count @ stills.pixels for count in counted]
