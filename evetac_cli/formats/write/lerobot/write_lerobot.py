"""Write trials as a LeRobotDataset v3.0, which lerobot 0.4 to 0.6 and its policies read from a folder.

    meta/info.json  meta/stats.json  meta/tasks.parquet  meta/episodes/chunk-000/file-000.parquet
    data/chunk-000/file-000.parquet  videos/observation.images.tactile/chunk-000/file-000.mp4 and those of other streams
    README.md  meta/evetac.json

An episode is a trial, a row is a frame (episodes.py describes how frames are computed from slices). A data or video
file contains many episodes, up to lerobot's size limits. Episodes of the split `test` come last. README.md is the data
card, which states first what is simulated and names no license: the publisher of the data chooses it. meta/evetac.json
has the header of each file of each episode's trial. lerobot reads neither.

Source: LeRobotDataset v3.0 as written by lerobot 0.4.4 and 0.6.1 (lerobot/datasets); slow tests run both.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, needs_extra
from evetac_cli.events import SLICES_PER_S
from evetac_cli.formats.write.hub_card import NO_LICENSE, card_fields, card_text, inline, table
from evetac_cli.formats.write.lerobot import event_stacks
from evetac_cli.formats.write.lerobot.contents import Choices, FrameContents, choose
from evetac_cli.formats.write.lerobot.episode_files import EpisodePlace, Numbered, Tables, Videos
from evetac_cli.formats.write.lerobot.episodes import EpisodeOutline, episode, outline, pictures, stream_pictures
from evetac_cli.formats.write.lerobot.meta_files import (
    VIDEO,
    Feature,
    as_lists,
    episode_table,
    of_columns,
    of_many,
    of_pictures,
    place_columns,
    write_json,
    write_tasks,
)
from evetac_cli.formats.write.slice_columns import Opener, TrialFiles, WrittenFolder
from evetac_cli.formats.write.write_table import load_pyarrow, provenance, typed
from evetac_cli.jobs import Progress
from evetac_cli.store.layout.provenance import time_host_versions

VERSION = "v3.0"
CHUNK_FILES = 1000  # files per folder
DATA_MB, VIDEO_MB = 100, 200  # file size above which the next episode begins a new file
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


def write(sources: Sequence[Path], opened: Opener, folder: Path, progress: Progress, **options: Any) -> WrittenFolder:
    """Write all trials as one data set; options are those of Choices.

    Raises InputError if the trials do not fit together, and MissingLibrary if pyarrow or av is not installed.
    """
    arrow = load_pyarrow(str(folder.parent))
    with needs_extra("video needs av", "convert", str(folder.parent)):
        import av
    choices = Choices(**options)
    outlines = []
    for source in sources:
        with opened(source) as files:
            outlines.append(outline(files, choices.task))
    contents, notes = choose(outlines, choices)
    outlines.sort(key=lambda one: one.facts["object"] in choices.test_objects)  # a stable sort; test episodes come last
    train = _count_to_train_on(outlines, choices.test_objects)
    headers: dict[str, Any] = {}
    done, slices = 0, sum(one.slices for one in outlines)
    with _video_errors(av, folder), ExitStack() as stack:
        data = stack.enter_context(Tables(arrow, Numbered(folder, DATA_PATH, CHUNK_FILES, DATA_MB)))
        episodes = stack.enter_context(Tables(arrow, Numbered(folder, EPISODES_PATH, CHUNK_FILES, None)))
        videos = {}
        for key in (VIDEO, *contents.stream_videos):
            numbered = Numbered(folder, VIDEO_PATH.replace("{video_key}", key), CHUNK_FILES, VIDEO_MB)
            videos[key] = stack.enter_context(Videos(av, numbered, choices.fps, contents.features[key].shape))
        written = Episodes(arrow, contents, outlines, train, data, episodes, videos)
        for number, one in enumerate(outlines):
            progress(done, slices, "slices")
            with opened(one.path) as files:
                headers[str(number)] = provenance(files, one.facts)
                written.add(number, files)
                notes += [f"{one.facts['trial']}: {note}" for note in files.notes]
            done += one.slices
    write_tasks(arrow, folder / "meta" / "tasks.parquet", written.tasks)
    splits = {"train": f"0:{train}", "test": f"{train}:{len(outlines)}"}
    splits = {name: part for name, part in splits.items() if part.split(":")[0] != part.split(":")[1]}
    info = {
        "codebase_version": VERSION,
        "robot_type": "evetac",
        "total_episodes": len(outlines),
        "total_frames": data.rows,
        "total_tasks": len(written.tasks),
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB,
        "fps": choices.fps,
        "splits": splits,
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH,
        "features": {name: feature.described() for name, feature in contents.features.items()},
    }
    write_json(folder / "meta" / "info.json", info)
    write_json(folder / "meta" / "stats.json", as_lists(written.statistics(folder)))
    about = {"per_frame": choices.per_frame, "fps": choices.fps, "episodes": headers}
    write_json(folder / "meta" / "evetac.json", about)
    (folder / "README.md").write_text(data_card(outlines, contents, info, notes), encoding="utf-8")
    simulated = any(one.facts["simulated"] for one in outlines)
    figures = {"episodes": len(outlines), "frames": data.rows, "fps": choices.fps, **splits}
    return WrittenFolder(simulated, notes, figures)


def _count_to_train_on(outlines: Sequence[EpisodeOutline], test_objects: Sequence[int]) -> int:
    """Return the number of episodes of other objects; InputError if there is none, or no episode of these objects."""
    train = sum(one.facts["object"] not in test_objects for one in outlines)
    if test_objects and train == len(outlines):
        objects = ", ".join(sorted({str(one.facts["object"]) for one in outlines}))
        raise InputError("no trial has any of these objects", where="--test-objects", expected=f"some of {objects}")
    if not train:
        raise InputError("no trial is left to train on", where="--test-objects", expected="trials of other objects too")
    return train


@dataclass(eq=False)
class Episodes:
    """The episodes of a data set, written one after the other; train: the number of those to train on, which are first.

    data: a row per frame; table: a row per episode; videos: by the name of their feature.
    """

    arrow: Any
    contents: FrameContents
    outlines: Sequence[EpisodeOutline]
    train: int
    data: Tables
    table: Tables
    videos: Mapping[str, Videos]

    def __post_init__(self) -> None:
        self.tasks = list(dict.fromkeys(one.task for one in self.outlines))
        self._types = {**typed([one.facts for one in self.outlines]), "recording_id": "string"}
        self._train_frames = 0
        self._levels: dict[str, NDArray[np.int64]] = {}  # pixels of each level in the training episodes
        self._widths: dict[str, int] = {}  # numbers per frame of each column

    def add(self, number: int, files: TrialFiles) -> None:
        """Write the next episode."""
        arrow, contents, one = self.arrow, self.contents, self.outlines[number]
        of = episode(files, contents.vectors, contents.choices.fps, contents.choices.per_frame)
        places = {key: each.begin() for key, each in self.videos.items()}
        pixels = {key: _film(files, contents, key, of.edges, each) for key, each in self.videos.items()}
        rows = contents.rows(of, number, self.data.rows, self.tasks.index(one.task))
        columns = {name: _column(arrow, values) for name, values in rows.items()}
        if (stacks := contents.stacks) is not None:
            stills = stacks.stills(files.recording, of.edges)
            pixels |= zip(stacks.keys(), event_stacks.pixels_of(stills), strict=True)
            columns |= {key: event_stacks.column(arrow, stills, at) for at, key in enumerate(stacks.keys())}
        frames = len(of.state)
        statistics = {key: of_pictures(counts, frames) for key, counts in pixels.items()}
        statistics |= {name: of_columns(values) for name, values in rows.items()}
        if number < self.train:
            self._train_frames += frames
            self._levels = {key: counts + self._levels.get(key, 0) for key, counts in pixels.items()}
        self._widths = {name: values[:1].size for name, values in rows.items()}
        table = arrow.table({key: columns[key] for key in contents.features if key in columns})
        lies = {
            "episode_index": number,
            "tasks": [one.task],
            "length": frames,
            "dataset_from_index": self.data.rows,
            "dataset_to_index": self.data.rows + frames,
            **place_columns("data", self.data.append(table)),
            **place_columns("meta/episodes", EpisodePlace(0, 0)),
        }
        for key, place in places.items():
            begin_s, end_s = place.start_s, self.videos[key].now_s
            lies |= place_columns(f"videos/{key}", place)
            lies |= {f"videos/{key}/from_timestamp": begin_s, f"videos/{key}/to_timestamp": end_s}
        facts = {**one.facts, "recording_id": one.id}
        self.table.append(episode_table(arrow, lies, statistics, facts, self._types))

    def statistics(self, folder: Path) -> dict[str, Any]:
        """Return the statistics of the training episodes, from the closed files."""
        frames = self._train_frames
        total = {key: of_pictures(counts, frames) for key, counts in self._levels.items()}
        for name, width in self._widths.items():
            total[name] = of_many(partial(_parts, self.arrow, folder, name, width, frames), width, frames)
        return total


@contextmanager
def _video_errors(av: Any, folder: Path) -> Iterator[None]:
    """Turn errors of the video library into InputError; it does not raise OSError when the disk is full."""
    try:
        yield
    except av.FFmpegError as error:
        where, message = str(folder.parent), str(error)[:200]
        raise InputError(
            "the video could not be written", where=where, found=message, hint="is the disk full?"
        ) from error


def _film(
    files: TrialFiles, contents: FrameContents, key: str, edges: NDArray[np.int64], video: Videos
) -> NDArray[np.int64]:
    """Write the pictures of an episode, of the tactile sensor or a stream; return the pixels of each level."""
    if key == VIDEO:
        shown = pictures(files.recording, edges)
    else:
        shown = stream_pictures(files.recording, contents.stream_videos[key], edges)
    pixels = np.zeros((1 if key == VIDEO else 3, 256), np.int64)
    for picture in shown:
        video.add(picture)
        pixels += [np.bincount(channel.ravel(), minlength=256) for channel in np.atleast_3d(picture).transpose(2, 0, 1)]
    return pixels


def _parts(arrow: Any, folder: Path, name: str, columns: int, frames: int) -> Iterator[NDArray[Any]]:
    """Yield the values of the first frames of a column of the written files, as tables of `columns` columns."""
    for path in sorted(folder.glob("data/*/*.parquet")):
        with arrow.parquet.ParquetFile(path) as file:
            for batch in file.iter_batches(columns=[name]):
                values = batch.column(name)[:frames]
                frames -= len(values)
                while values.type.num_fields:  # a list
                    values = values.flatten()
                yield values.to_numpy(zero_copy_only=False).reshape(-1, columns)


def _column(arrow: Any, values: NDArray[Any]) -> Any:
    """Return an Arrow column of numbers (frames,) or vectors (frames, n); lerobot has a vector of one as a number."""
    flat = arrow.array(values.ravel())
    return flat if values[:1].size == 1 else arrow.FixedSizeListArray.from_arrays(flat, values.shape[1])


LONGEST_CELL = 80  # characters of a text that comes from a file


def data_card(
    outlines: Sequence[EpisodeOutline], contents: FrameContents, info: Mapping[str, Any], left_out: Sequence[str]
) -> str:
    """Return the card; info is the content of meta/info.json."""
    simulated = sum(one.facts["simulated"] for one in outlines)
    fps = info["fps"]
    fields = {
        **card_fields(simulated > 0, None, "LeRobot"),
        "task_categories": ["robotics"],
        "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
    }
    page = [
        "# Tactile data of an event camera behind a dotted gel" + (", simulated" if simulated == len(outlines) else ""),
        _origin(simulated, len(outlines)),
        f"{len(outlines)} episodes, {info['total_frames']} frames at {fps} frames per second, as a LeRobotDataset"
        f" {info['codebase_version']}. Written by evetac {time_host_versions()['evetac']}; meta/evetac.json has the"
        " provenance of each episode's files: parameters, seeds, ids.",
        "## Contents of a frame",
        table(_frame(contents.features)),
        f"The sensor has {SLICES_PER_S} slices per second. Frame i has the slices from i * {SLICES_PER_S} / {fps} ms "
        f"up to the start of the next frame, and its timestamp is i / {fps} s. A value that is unknown keeps its last"
        " known value, and is 0 before the first. Names end with the unit. meta/info.json lists the names of all"
        " values.",
        "## Episodes",
        table(_episodes(outlines, info["splits"])),
        "meta/stats.json has the statistics of all frames of the training episodes, without those of the split `test`.",
        "Tasks: " + "; ".join(dict.fromkeys(inline(one.task) for one in outlines)) + ".",
        *([f"Left out: {inline('; '.join(left_out), 2000)}."] if left_out else []),
        "## Limitations",
        "\n".join(_limitations(contents, simulated > 0)),
        "## License",
        NO_LICENSE,
    ]
    return card_text(fields, page)


def _frame(features: Mapping[str, Feature]) -> list[dict[str, str]]:
    """Return a row per described feature; consecutive features with the same description share a row."""
    rows = []
    described = [(name, feature) for name, feature in features.items() if feature.what]
    for what, alike in groupby(described, key=lambda pair: pair[1].what):
        names = [(name, feature.size) for name, feature in alike]
        shown = [name for name, _ in (names if len(names) == 1 else (names[0], names[-1]))]
        name = " ... ".join(f"`{name}`" for name in shown)
        rows.append({"name": name, "values": names[0][1], "meaning": what})
    return rows


def _limitations(contents: FrameContents, simulated: bool) -> list[str]:
    """Return the limitations that a user of the data set needs to know, as list items."""
    lines = ["Videos are H.264, which is lossy: their values are close, not exact. The table is exact."]
    if simulated:
        lines.append("The simulated data has not been compared with a real sensor.")
    lines.append(
        "Splits are only labels: lerobot trains on all episodes unless `--dataset.episodes` selects some of them."
    )
    lines.append("Contact forces are estimated from dot motion, not measured.")
    if contents.stacks is not None:
        lines.append(
            f"More than {contents.stacks.full_scale} events of one sign per pixel and frame are clipped to this number."
        )
    return [f"- {one}" for one in lines]


def _origin(simulated: int, episodes: int) -> str:
    if not simulated:
        return "Recorded with devices or by other programs; no episode is simulated."
    share = "All episodes are" if simulated == episodes else f"{simulated} of {episodes} episodes are"
    return (
        f"**Simulated.** {share} from evetac's simulator of gel, gripper and event camera, not from a real sensor. A"
        " policy that is trained on them has not seen real tactile data."
    )


def _episodes(outlines: Sequence[EpisodeOutline], splits: Mapping[str, str]) -> list[dict[str, str]]:
    """Return a row per object, sensor, outcome and split, with its number of episodes."""
    counted: Counter[tuple[str, ...]] = Counter()
    facts = ("object", "sensor", "outcome")
    for number, one in enumerate(outlines):
        (split,) = [name for name, part in splits.items() if number in range(*map(int, part.split(":")))]
        values = (one.facts[fact] for fact in facts)
        cells = (inline("unknown" if value is None else str(value), LONGEST_CELL) for value in values)
        counted[(*cells, split)] += 1
    return [
        {**dict(zip((*facts, "split"), row, strict=True)), "episodes": str(count)} for row, count in counted.items()
    ]
