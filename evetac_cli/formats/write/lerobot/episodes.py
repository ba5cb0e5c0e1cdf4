"""A trial as an episode of frames for a policy: the columns it has, and how 1000 slices per second become frames.

Frame i has the slices from i * 1000 // fps to (i + 1) * 1000 // fps, the end excluded: everything known at its end.
State and action are the last values. The tactile vector is the mean of the slices, the last slice, or the last
1000 // fps slices concatenated, oldest first. The action of a frame is the goal one frame later, which was commanded in
response to the frame. The last whole frame of a trial therefore has no action and is left out.

Other streams of the trial are last values too: the numbers of a stream become the vector `observation.streams.NAME`,
its images the video `observation.images.NAME`. Streams that only some trials have, or whose columns or sizes differ,
are left out, and the export reports this. An unknown value keeps its last known value, and is 0 before the first,
because policies cannot handle gaps.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Ints, Singles
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, SLICES_PER_S
from evetac_cli.formats.write.slice_columns import Masked, TrialFiles, columns_of, read_columns
from evetac_cli.kernels.event_representation import event_image
from evetac_cli.store.layout.ancestry import scene_words
from evetac_cli.store.recordings import streams
from evetac_cli.store.recordings.read import Recording

NUMBERS, IMAGES = "observation.streams.{}", "observation.images.{}"
OURS = (
    "tactile",
    "stream_",
)  # prefixes that a stream's image feature must not have: the tactile sensor's, and `stream_`


class StreamShapes(NamedTuple):
    """The streams of a trial: columns of numbers by the stream's name, and (rows, columns) of its images."""

    columns: Mapping[str, tuple[str, ...]]
    images: Mapping[str, tuple[int, int]]


def stream_shapes(recording: Recording, columns: Sequence[str]) -> StreamShapes:
    """Return the streams of a trial; columns: the names of all columns of its slices."""
    stored = recording.contents()
    names = streams.names(stored)
    of: dict[str, list[str]] = {name: [] for name in names}
    longest_first = sorted(names, key=len, reverse=True)
    for column in columns:
        name = next((name for name in longest_first if column.startswith(f"{streams.GROUP}_{name}_")), None)
        if name is not None and column != f"{streams.GROUP}_{name}_t_us":
            of[name].append(column)
    images = {name: path for name in names if (path := f"{streams.GROUP}/{name}/frames") in stored}
    return StreamShapes(
        {name: tuple(found) for name, found in of.items() if found},
        {name: (stored[path][1][1], stored[path][1][2]) for name, path in images.items()},
    )


def shared_streams(trials: Sequence[StreamShapes], largest_px: int) -> tuple[StreamShapes, list[str]]:
    """Return the streams that are the same in all trials, and texts on what is left out."""
    left_out = []
    kept: list[dict[str, tuple]] = []
    for what in StreamShapes._fields:
        of_all = [getattr(one, what) for one in trials]
        every = sorted(set().union(*of_all))
        alike = {name: of_all[0].get(name) for name in every if len({one.get(name) for one in of_all}) == 1}
        left_out += [f"{streams.GROUP}/{name}: its {what} differ between trials" for name in every if name not in alike]
        kept.append({name: shape for name, shape in alike.items() if shape is not None})
    too_large = [name for name, shape in kept[1].items() if max(shape) > largest_px]
    left_out += [f"images of {streams.GROUP}/{name}: more than {largest_px} px per side" for name in too_large]
    images = {name: shape for name, shape in kept[1].items() if name not in too_large}
    return StreamShapes(kept[0], images), left_out


def image_key(name: str) -> str:
    """Return the name of the feature with a stream's images, distinct from those of the tactile sensor."""
    return IMAGES.format(f"stream_{name}" if name.startswith(OURS) else name)


def stream_pictures(recording: Recording, name: str, edges: Ints) -> Iterator[NDArray[np.uint8]]:
    """Yield the images of a stream at the end of each frame, (rows, columns, 3), black before the first.

    Odd sides get one more row or column, because codecs require even sides.
    """
    path = f"{streams.GROUP}/{name}"
    at = np.searchsorted(recording.read(f"{path}/t_us"), edges[1:] * SLICE_US) - 1
    rows, columns = recording.contents()[f"{path}/frames"][1][1:3]
    shown, picture = -1, np.zeros((rows + rows % 2, columns + columns % 2, 3), np.uint8)
    for number in at.tolist():
        if number != shown:
            shown, picture = number, np.zeros_like(picture)
            picture[:rows, :columns] = recording.read(f"{path}/frames", number, number + 1)[0]
        yield picture


STATE = ("gripper_position_ticks", "gripper_current_ma")
# Actions of a grasp, and of a trial without a controller. lerobot reads a vector with one element as a scalar, which
# its policies do not accept as an action. So each action has two elements: the goal (a whole number of ticks) and the
# controller's feedforward part of it, or the target current and the current that was written.
OF_GRASP = ("control_goal_ticks", "control_u_ff_ticks")
OF_GRIPPER = ("gripper_current_target_ma", "gripper_current_written_ma")
DISPLACEMENT = re.compile(r"displacement_\d+_[xy]_px")
TACTILE = re.compile(
    rf"{DISPLACEMENT.pattern}|events_per_dot_\d+|touch_(touches|shear_[xy]_n|normal_n|torsion_n_mm|centre_[xy]_mm)"
    "|touch_(area_mm2|sticking_share)|(control|model)_probability"
)
MOST_BYTES = 2_000_000_000  # memory for a trial's slices
MOST_EVENTS = 4_000_000  # drawn in one picture: the last events of the frame
LARGEST_PX = 4096  # side of a picture that every H.264 codec supports
GREYS = np.array([0, 128, 255], np.uint8)  # darker, no event, brighter, as in the paper's pictures


class EpisodeOutline(NamedTuple):
    """The facts about a trial that decide which data an episode can have: columns, length, frame and names."""

    path: Path
    facts: dict[str, Any]
    task: str
    id: str
    names: tuple[str, ...]
    slices: int
    frame_px: tuple[int, int]
    streams: StreamShapes


class Vectors(NamedTuple):
    """The columns that all trials have: of the state, the tactile vector, the action, and other features."""

    state: tuple[str, ...]
    tactile: tuple[str, ...]
    action: tuple[str, ...]
    others: Mapping[str, tuple[str, ...]] = {}

    @property
    def width(self) -> int:
        """The number of columns."""
        return sum(map(len, (self.state, self.tactile, self.action, *self.others.values())))


def outline(files: TrialFiles, task: str | None) -> EpisodeOutline:
    """Return the outline of a trial; `task` is a text, by default the summary of its scene."""
    recording = files.recording
    names = tuple(name for columns in columns_of(files) for name in columns.names)
    words = task or scene_words(recording.header["parameters"], "summary") or "touch and hold an object"
    return EpisodeOutline(
        recording.path,
        files.facts(),
        words,
        recording.header["id"],
        names,
        len(recording),
        recording.frame_px,
        stream_shapes(recording, names),
    )


def require_alike(outlines: Sequence[EpisodeOutline]) -> None:
    """Raise InputError if a trial has no gripper or no displacements, or if the trials' frame sizes differ."""
    size = "{} x {}".format
    for one in outlines:
        where = str(one.path)
        if not set(one.names).issuperset((*STATE, *OF_GRIPPER)):
            raise InputError("the recording has no gripper, so an episode would have no action", where=where)
        if not any(map(DISPLACEMENT.fullmatch, one.names)):
            hint = "run evetac track, then evetac featurize"
            raise InputError("an episode needs the features of the trial", where=where, hint=hint)
        if one.frame_px != outlines[0].frame_px:
            expected, found = size(*outlines[0].frame_px), size(*one.frame_px)
            raise InputError("the trials have different frame sizes", where=where, expected=expected, found=found)
        if max(one.frame_px) > LARGEST_PX:
            expected, found = f"at most {LARGEST_PX} px per side", size(*one.frame_px)
            raise InputError("the frame is too large for a video", where=where, expected=expected, found=found)


def choose_vectors(outlines: Sequence[EpisodeOutline]) -> tuple[Vectors, list[str]]:
    """Return the columns that all trials have, and a text on those that only some have, which are left out.

    Raises InputError if the trials have different dots or actions.
    """
    common = set.intersection(*(set(one.names) for one in outlines))
    tactile_of = [[name for name in one.names if TACTILE.fullmatch(name)] for one in outlines]
    some = set().union(*tactile_of) - common
    actions = {OF_GRASP if set(one.names).issuperset(OF_GRASP) else OF_GRIPPER for one in outlines}
    odd = next((name for name in sorted(some) if DISPLACEMENT.fullmatch(name)), None)
    if len(actions) > 1 or odd is not None:
        message, where = "these trials have different dots or different actions", str(outlines[0].path.parent)
        expected, found = "trials of one gel, all grasps or none", f"{odd or OF_GRASP[0]} in some of them"
        raise InputError(message, where=where, expected=expected, found=found, hint="export them separately")
    tactile = tuple(name for name in tactile_of[0] if name in common)
    columns = shared_streams([one.streams for one in outlines], LARGEST_PX)[0].columns
    others = {NUMBERS.format(name): of for name, of in columns.items()}
    left_out = [f"not in all trials: {', '.join(sorted(some))}"] if some else []
    return Vectors(STATE, tactile, actions.pop(), others), left_out


def frame_edges(slices: int, fps: int) -> NDArray[np.int64]:
    """Return the edges of frames: frame i has the slices [edges[i], edges[i + 1])."""
    return np.arange(slices * fps // SLICES_PER_S + 1, dtype=np.int64) * SLICES_PER_S // fps


class Episode(NamedTuple):
    """The frames of a trial: arrays (frames, values), and the slices at which each frame begins and ends."""

    state: Singles
    tactile: Singles
    action: Singles
    others: Mapping[str, Singles]
    edges: NDArray[np.int64]  # (frames + 1,)


def episode(files: TrialFiles, vectors: Vectors, fps: int, per_frame: str) -> Episode:
    """Return the frames of a trial; raise InputError if it has fewer than two or does not fit in memory."""
    recording = files.recording
    slices = len(recording)
    edges = frame_edges(slices, fps)
    where = str(recording.path)
    if len(edges) < 3:
        message, expected = "the recording is too short for an episode", f"two frames of {SLICES_PER_S / fps:g} ms"
        raise InputError(message, where=where, expected=expected, found=f"{slices} ms")
    if 16 * vectors.width * slices > MOST_BYTES:
        expected = f"at most {MOST_BYTES // (16 * vectors.width) // SLICES_PER_S} s"
        hint = "cut it with `evetac trim`"
        raise InputError("the recording is too long for an episode", where=where, expected=expected, hint=hint)
    columns = columns_of(files)

    def of(names: Sequence[str]) -> Singles:
        return last_known(read_columns(columns, names, slices))

    stacked, ends = SLICES_PER_S // fps, edges[1:] - 1
    return Episode(
        of(vectors.state)[ends[:-1]],
        frames_of(of(vectors.tactile), edges[:-1], per_frame, stacked),
        of(vectors.action)[ends[1:]],
        {name: of(names)[ends[:-1]] for name, names in vectors.others.items()},
        edges[:-1],
    )


def last_known(values: Masked) -> Singles:
    """Replace unknown values by the last known value of the column, and by 0 before the first; (slices, n)."""
    missing = np.ma.getmaskarray(values)
    rows = np.where(missing, 0, np.arange(len(values))[:, None])
    latest = np.maximum.accumulate(rows, axis=0)
    filled = values.filled(0.0)
    return np.asarray(np.take_along_axis(filled, latest, axis=0), np.float32)


def frames_of(values: Singles, edges: NDArray[np.int64], per_frame: str, stacked: int) -> Singles:
    """Return one row per frame from slices (slices, n); for per_frame "stacked" of shape (frames, stacked * n)."""
    begins, ends = edges[:-1], edges[1:]
    if per_frame == "last":
        return values[ends - 1]
    if per_frame == "mean":
        sums = np.add.reduceat(values[: ends[-1]].astype(np.float64), begins, axis=0)
        return np.asarray(sums / (ends - begins)[:, None], np.float32)
    rows = ends[:, None] - stacked + np.arange(stacked)
    return np.asarray(values[rows].reshape(len(begins), -1))


def names_of(tactile: Sequence[str], per_frame: str, stacked: int) -> list[str]:
    """Return the names of the tactile vector; for stacked slices with their age in ms at the end of the frame."""
    if per_frame != "stacked":
        return list(tactile)
    return [f"{name}_{age}_ms_ago" for age in range(stacked - 1, -1, -1) for name in tactile]


def pictures(recording: Recording, edges: NDArray[np.int64]) -> Iterator[NDArray[np.uint8]]:
    """Yield the events of each frame as the paper draws them, (height, width).

    White is brighter, black is darker, grey is no event. Odd sides get one more row or column, because codecs require
    even sides.
    """
    width, height = recording.frame_px
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        first, last = int(recording.starts[begin]), int(recording.starts[end])
        events = recording.events(max(first, last - MOST_EVENTS), last)
        picture = event_image(events.x, events.y, events.p, (width, height))
        yield GREYS[np.pad(picture, ((0, height % 2), (0, width % 2))) + 1]
