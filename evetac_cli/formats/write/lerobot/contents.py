"""Choose the features of a data set's frames from the data that all of its trials have."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICES_PER_S
from evetac_cli.formats.write.lerobot import event_stacks
from evetac_cli.formats.write.lerobot.episodes import (
    LARGEST_PX,
    NUMBERS,
    Episode,
    EpisodeOutline,
    StreamShapes,
    Vectors,
    choose_vectors,
    image_key,
    names_of,
    require_alike,
    shared_streams,
)
from evetac_cli.formats.write.lerobot.event_stacks import EventStacks
from evetac_cli.formats.write.lerobot.meta_files import ACTION, STATE, VIDEO, Feature, indices, vector, video

RULES = {
    "mean": "the mean of the frame's slices",
    "last": "the last slice of the frame",
    "stacked": "the last {stacked} slices of the frame, concatenated, oldest first",
}


@dataclass(frozen=True)
class Choices:
    """The options of an export; their defaults are those of the command."""

    fps: int = 50
    per_frame: str = "mean"
    test_objects: Sequence[int] = ()
    task: str | None = None
    tactile_key: str = "observation.tactile"
    event_frames: str | None = None
    size: tuple[int, int] | None = None

    @property
    def rule(self) -> str:
        """A text that describes how the tactile vector of a frame is computed from its slices."""
        return RULES[self.per_frame].format(stacked=SLICES_PER_S // self.fps)


class FrameContents(NamedTuple):
    """The features, and their sources: columns, event frames and images of streams.

    stream_videos: name of the feature -> name of the stream.
    """

    features: Mapping[str, Feature]
    vectors: Vectors
    stacks: EventStacks | None
    stream_videos: Mapping[str, str]
    choices: Choices

    def rows(self, episode: Episode, number: int, first: int, task: int) -> dict[str, NDArray[Any]]:
        """Return the columns of an episode: arrays (frames, ...), and numbers (frames,)."""
        frames = len(episode.state)
        at = np.arange(frames, dtype=np.int64)
        return {
            STATE: episode.state,
            self.choices.tactile_key: episode.tactile,
            **episode.others,
            ACTION: episode.action,
            "timestamp": (at / self.choices.fps).astype(np.float32),
            "frame_index": at,
            "episode_index": np.full(frames, number),
            "index": first + at,
            "task_index": np.full(frames, task),
        }


def choose(outlines: Sequence[EpisodeOutline], choices: Choices) -> tuple[FrameContents, list[str]]:
    """Return the contents of a data set of these trials, and texts on what is left out.

    Raises InputError if the trials or options do not fit together.
    """
    require_alike(outlines)
    frame_px = outlines[0].frame_px
    stacks = event_stacks.parse(choices.event_frames, choices.size, frame_px)
    vectors, left_out = choose_vectors(outlines)
    streams, more = shared_streams([one.streams for one in outlines], LARGEST_PX)
    left_out += more
    videos = {image_key(name): name for name in streams.images}
    features = _features(vectors, stacks, videos, streams, frame_px, choices)
    return FrameContents(features, vectors, stacks, videos, choices), left_out


def _features(
    vectors: Vectors,
    stacks: EventStacks | None,
    stream_names: Mapping[str, str],
    streams: StreamShapes,
    frame_px: tuple[int, int],
    choices: Choices,
) -> dict[str, Feature]:
    width, height = (side + side % 2 for side in frame_px)
    words = "all events of the frame: white is brighter (ON), black is darker (OFF), grey is no event"
    features = {STATE: vector(vectors.state, f"{', '.join(vectors.state)}: the last measured values")}
    names = names_of(vectors.tactile, choices.per_frame, SLICES_PER_S // choices.fps)
    features[choices.tactile_key] = vector(names, f"{len(vectors.tactile)} tactile values, {choices.rule}")
    features[VIDEO] = video(height, width, choices.fps, words)
    features |= {} if stacks is None else stacks.features()
    for key, name in stream_names.items():
        rows, columns = streams.images[name]
        words = f"the last image of the stream `{name}` before the end of the frame, black before its first image"
        features[key] = video(rows + rows % 2, columns + columns % 2, choices.fps, words)
    for key, columns_of in vectors.others.items():
        words = f"the last sample of the stream `{key.removeprefix(NUMBERS.format(''))}` before the end of the frame"
        features[key] = vector(columns_of, words)
    features[ACTION] = vector(vectors.action, f"{', '.join(vectors.action)}: the goal one frame later")
    return {**features, **indices()}
