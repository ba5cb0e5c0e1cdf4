"""A trial as an episode of frames for a policy: the columns it has, and how 1000 slices per second become frames.

Frame i has the slices from i * 1000 // fps to (i + 1) * 1000 // fps, the end excluded: everything known at its end.
State and action are the last values. The tactile vector is the mean of the slices, the last slice, or the last
1000 // fps slices concatenated, oldest first. The action of a frame is the goal one frame later, which was commanded in
response to the frame. The last whole frame of a trial therefore has no action and is left out.

Other streams of the trial, and truth if requested, are last values too. An unknown value keeps its last known value,
and is 0 before the first, because policies cannot handle gaps.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Singles
from evetac_cli.errors import InputError
from evetac_cli.events import SLICES_PER_S
from evetac_cli.formats.write.lerobot import other_streams, point_sets
from evetac_cli.formats.write.lerobot.other_streams import NUMBERS, StreamShapes
from evetac_cli.formats.write.lerobot.point_sets import OF_WRENCH, PointSet
from evetac_cli.formats.write.slice_columns import Masked, TrialFiles, columns_of, read_columns
from evetac_cli.kernels.event_representation import event_image
from evetac_cli.store.layout.ancestry import scene_words
from evetac_cli.store.recordings.read import Recording

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
TRUTH = "simulated_truth"  # not `observation...`: lerobot's policies use every feature whose name begins so as input
OF_POINTS = re.compile("|".join((DISPLACEMENT.pattern, *OF_WRENCH)))
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
    has_dot_forces: bool

    def truth(self) -> list[str]:
        """Return the columns of ground truth, which only simulated trials have."""
        return [name for name in self.names if name.startswith("truth_")]


class Vectors(NamedTuple):
    """The columns that all trials have: of the state, the tactile vector or points, the action, and other features."""

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
        other_streams.shapes(recording, names),
        point_sets.tells_forces(files),
    )


def require_alike(outlines: Sequence[EpisodeOutline]) -> None:
    """Raise InputError if a trial has no gripper or no displacements, or if the trials' frame sizes differ."""
    for one in outlines:
        if not set(one.names).issuperset((*STATE, *OF_GRIPPER)):
            raise InputError("the recording has no gripper, so an episode would have no action", where=str(one.path))
        if not any(map(DISPLACEMENT.fullmatch, one.names)):
            raise InputError(
                "the trial has no features; an episode needs the displacements of the dots",
                where=str(one.path),
                expected="features next to the recording",
                hint="run evetac track, then evetac featurize",
            )
        if one.frame_px != outlines[0].frame_px:
            raise InputError(
                "the trials have different frame sizes; all episodes of a data set need the same",
                where=str(one.path),
                expected=_size(outlines[0]),
                found=_size(one),
            )
        if max(one.frame_px) > LARGEST_PX:
            raise InputError(
                "the frame is too large for a video",
                where=str(one.path),
                expected=f"at most {LARGEST_PX} px per side",
                found=_size(one),
            )


def choose_vectors(outlines: Sequence[EpisodeOutline], *, as_points: bool, truth: bool) -> tuple[Vectors, list[str]]:
    """Return the columns that all trials have, and a text on those that only some have, which are left out.

    as_points: use the columns of a point set instead of the tactile vector. Raises InputError if the trials have
    different dots or actions, or if truth is requested but the trials have none.
    """
    common = set.intersection(*(set(one.names) for one in outlines))
    wanted = OF_POINTS if as_points else TACTILE
    tactile_of = [[name for name in one.names if wanted.fullmatch(name)] for one in outlines]
    some = set().union(*tactile_of) - common
    actions = {OF_GRASP if set(one.names).issuperset(OF_GRASP) else OF_GRIPPER for one in outlines}
    odd = next((name for name in sorted(some) if DISPLACEMENT.fullmatch(name)), None)
    if len(actions) > 1 or odd is not None:
        raise InputError(
            "these trials have different dots or different actions",
            where=str(outlines[0].path.parent),
            expected="trials of one gel, all grasps or none",
            found=f"{odd or OF_GRASP[0]} in some of them",
            hint="export them to separate folders",
        )
    tactile = tuple(name for name in tactile_of[0] if name in common)
    columns = other_streams.shared([one.streams for one in outlines], LARGEST_PX)[0].columns
    others = {NUMBERS.format(name): of for name, of in columns.items()}
    if truth:
        truth_names = tuple(name for name in outlines[0].truth() if name in common)
        some |= set().union(*(one.truth() for one in outlines)) - common
        if not truth_names:
            where = next(str(one.path) for one in outlines if not set(one.truth()) & common)
            raise InputError(
                "the trial has no ground truth; only simulated trials have", where=where, hint="leave out --truth"
            )
        others[TRUTH] = truth_names
    left_out = [f"not in all trials: {', '.join(sorted(some))}"] if some else []
    return Vectors(STATE, tactile, actions.pop(), others), left_out


def choose_points(outlines: Sequence[EpisodeOutline], tactile: Sequence[str]) -> tuple[PointSet, list[str]]:
    """Return the point set of these tactile columns, and texts on what is left out of it."""
    with_forces = [one.has_dot_forces for one in outlines]
    dots = sum(bool(DISPLACEMENT.fullmatch(name)) for name in tactile) // 2
    left_out = ["forces of dots: not all trials have touch maps"] if any(with_forces) and not all(with_forces) else []
    return PointSet(dots, all(with_forces), set(tactile).issuperset(OF_WRENCH)), left_out


def _size(one: EpisodeOutline) -> str:
    return f"{one.frame_px[0]} x {one.frame_px[1]}"


def frame_edges(slices: int, fps: int) -> NDArray[np.int64]:
    """Return the edges of frames: frame i has the slices [edges[i], edges[i + 1])."""
    return np.arange(slices * fps // SLICES_PER_S + 1, dtype=np.int64) * SLICES_PER_S // fps


class Episode(NamedTuple):
    """The frames of a trial: arrays (frames, values), and the slices at which each frame begins and ends."""

    state: Singles
    tactile: Singles
    action: Singles
    others: Mapping[str, Singles]
    dot_forces: Singles | None  # (frames, 3 * dots)
    edges: NDArray[np.int64]  # (frames + 1,)


def episode(files: TrialFiles, vectors: Vectors, points: PointSet | None, fps: int, per_frame: str) -> Episode:
    """Return the frames of a trial; raise InputError if it has fewer than two or does not fit in memory."""
    recording = files.recording
    slices = len(recording)
    edges = frame_edges(slices, fps)
    if len(edges) < 3:
        raise InputError(
            "the recording is too short for an episode",
            where=str(recording.path),
            expected=f"at least two frames of {SLICES_PER_S / fps:g} ms",
            found=f"{slices} ms",
        )
    has_forces = points is not None and points.has_forces
    width = vectors.width + (3 * points.dots if points is not None and has_forces else 0)
    if 16 * width * slices > MOST_BYTES:
        raise InputError(
            "the recording is too long for an episode",
            where=str(recording.path),
            expected=f"at most {MOST_BYTES // (16 * width) // SLICES_PER_S} s",
            found=f"{slices / SLICES_PER_S:.0f} s",
            hint="cut it with `evetac trim`",
        )
    columns = columns_of(files)

    def of(names: Sequence[str]) -> Singles:
        return last_known(read_columns(columns, names, slices))

    stacked, ends = SLICES_PER_S // fps, edges[1:] - 1
    forces = last_known(point_sets.dot_forces(files, slices)) if has_forces else None
    return Episode(
        of(vectors.state)[ends[:-1]],
        frames_of(of(vectors.tactile), edges[:-1], per_frame, stacked),
        of(vectors.action)[ends[1:]],
        {name: of(names)[ends[:-1]] for name, names in vectors.others.items()},
        None if forces is None else frames_of(forces, edges[:-1], per_frame, stacked),
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
