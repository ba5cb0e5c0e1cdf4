"""Write trials as a LeRobotDataset v3.0, which lerobot 0.4 to 0.6 and its policies read from a folder.

    meta/info.json  meta/stats.json  meta/tasks.parquet  meta/episodes/chunk-000/file-000.parquet
    data/chunk-000/file-000.parquet  videos/observation.images.tactile/chunk-000/file-000.mp4 and those of other streams
    README.md  meta/evetac.json

An episode is a trial, a row is a frame (episodes.py describes how frames are computed from slices). A data or video
file contains many episodes, up to lerobot's size limits. Episodes of the split `test` come last. README.md is the data
card; meta/evetac.json has the header of each file of each episode's trial. lerobot reads neither.

Source: LeRobotDataset v3.0 as written by lerobot 0.4.4 and 0.6.1 (lerobot/datasets); slow tests run both.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, needs_extra
from evetac_cli.formats.write.lerobot import event_stacks, other_streams
from evetac_cli.formats.write.lerobot.contents import Choices, FrameContents, choose
from evetac_cli.formats.write.lerobot.data_card import data_card
from evetac_cli.formats.write.lerobot.episode_files import EpisodePlace, Numbered, Tables, Videos
from evetac_cli.formats.write.lerobot.episodes import episode, outline, pictures
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

VERSION = "v3.0"
CHUNK_FILES = 1000  # files per folder
DATA_MB, VIDEO_MB = 100, 200  # file size above which the next episode begins a new file
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


def write(
    sources: Sequence[Path],
    opened: Opener,
    folder: Path,
    progress: Progress,
    *,
    fps: int = 50,
    per_frame: str = "mean",
    test_objects: Sequence[int] = (),
    task: str | None = None,
    tactile_key: str = "observation.tactile",
    event_frames: str | None = None,
    size: tuple[int, int] | None = None,
) -> WrittenFolder:
    """Write all trials as one data set.

    Raises InputError if the trials do not fit together, and MissingLibrary if pyarrow or av is not installed.
    """
    arrow, av = load_pyarrow(str(folder.parent)), _load_av(str(folder.parent))
    outlines = []
    for source in sources:
        with opened(source) as files:
            outlines.append(outline(files, task))
    contents, notes = choose(outlines, Choices(fps, per_frame, tactile_key, event_frames, size))
    outlines.sort(key=lambda one: one.facts["object"] in test_objects)  # a stable sort; test episodes come last
    train = sum(one.facts["object"] not in test_objects for one in outlines)
    if test_objects and train == len(outlines):
        objects = ", ".join(sorted({str(one.facts["object"]) for one in outlines}))
        raise InputError("no trial has any of these objects", where="--test-objects", expected=f"some of {objects}")
    if not train:
        raise InputError("no trial is left to train on", where="--test-objects", expected="trials of other objects too")
    tasks = list(dict.fromkeys(one.task for one in outlines))
    headers: dict[str, Any] = {}
    train_frames, levels = 0, dict[str, NDArray[np.int64]]()  # of the training episodes; levels: pixels of each level
    done, slices = 0, sum(one.slices for one in outlines)
    with _video_errors(av, folder), ExitStack() as stack:
        data = stack.enter_context(Tables(arrow, Numbered(folder, DATA_PATH, CHUNK_FILES, DATA_MB)))
        episodes = stack.enter_context(Tables(arrow, Numbered(folder, EPISODES_PATH, CHUNK_FILES, None)))
        videos = {
            key: stack.enter_context(_videos(av, folder, key, contents.features[key], fps))
            for key in (VIDEO, *contents.stream_videos)
        }
        types = {**typed([one.facts for one in outlines]), "recording_id": "string"}
        for number, one in enumerate(outlines):
            progress(done, slices, "slices")
            with opened(one.path) as files:
                episode_frames = episode(files, contents.vectors, fps, per_frame)
                headers[str(number)] = provenance(files, one.facts)
                places = {key: each.begin() for key, each in videos.items()}
                pixels = {key: _film(files, contents, key, episode_frames.edges, each) for key, each in videos.items()}
                stacks = contents.stacks
                stills = None if stacks is None else stacks.stills(files.recording, episode_frames.edges)
                notes += [f"{one.facts['trial']}: {note}" for note in files.notes]
            rows = contents.rows(episode_frames, number, data.rows, tasks.index(one.task))
            columns = {name: _column(arrow, values) for name, values in rows.items()}
            if stacks is not None and stills is not None:
                pixels |= zip(stacks.keys(), event_stacks.pixels_of(stills), strict=True)
                columns |= {key: event_stacks.column(arrow, stills, at) for at, key in enumerate(stacks.keys())}
            frames = len(episode_frames.state)
            statistics = {key: of_pictures(counts, frames) for key, counts in pixels.items()}
            statistics |= {name: of_columns(values) for name, values in rows.items()}
            if number < train:
                train_frames += frames
                levels = {key: counts + levels.get(key, 0) for key, counts in pixels.items()}
            table = arrow.table({key: columns[key] for key in contents.features if key in columns})
            lies = {
                "episode_index": number,
                "tasks": [one.task],
                "length": frames,
                "dataset_from_index": data.rows,
                "dataset_to_index": data.rows + frames,
                **place_columns("data", data.append(table)),
                **place_columns("meta/episodes", EpisodePlace(0, 0)),
            }
            for key, place in places.items():
                lies |= place_columns(f"videos/{key}", place)
                lies |= {f"videos/{key}/from_timestamp": place.start_s, f"videos/{key}/to_timestamp": videos[key].now_s}
            episodes.append(episode_table(arrow, lies, statistics, {**one.facts, "recording_id": one.id}, types))
            done += one.slices
    total = {key: of_pictures(counts, train_frames) for key, counts in levels.items()}
    for name, each in rows.items():
        width = each[:1].size
        total[name] = of_many(partial(_parts, arrow, folder, name, width, train_frames), width, train_frames)
    write_tasks(arrow, folder / "meta" / "tasks.parquet", tasks)
    splits = {"train": f"0:{train}", "test": f"{train}:{len(outlines)}"}
    splits = {name: part for name, part in splits.items() if part.split(":")[0] != part.split(":")[1]}
    info = {
        "codebase_version": VERSION,
        "robot_type": "evetac",
        "total_episodes": len(outlines),
        "total_frames": data.rows,
        "total_tasks": len(tasks),
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB,
        "fps": fps,
        "splits": splits,
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH,
        "features": {name: feature.described() for name, feature in contents.features.items()},
    }
    write_json(folder / "meta" / "info.json", info)
    write_json(folder / "meta" / "stats.json", as_lists(total))
    write_json(folder / "meta" / "evetac.json", {"per_frame": per_frame, "fps": fps, "episodes": headers})
    (folder / "README.md").write_text(data_card(outlines, contents, info, notes), encoding="utf-8")
    simulated = any(one.facts["simulated"] for one in outlines)
    return WrittenFolder(simulated, notes, {"episodes": len(outlines), "frames": data.rows, "fps": fps, **splits})


def _load_av(where: str) -> Any:
    with needs_extra("video needs av", "convert", where):
        import av
    return av


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


def _videos(av: Any, folder: Path, key: str, feature: Feature, fps: int) -> Videos:
    files = Numbered(folder, VIDEO_PATH.replace("{video_key}", key), CHUNK_FILES, VIDEO_MB)
    return Videos(av, files, fps, feature.shape)


def _film(
    files: TrialFiles, contents: FrameContents, key: str, edges: NDArray[np.int64], video: Videos
) -> NDArray[np.int64]:
    """Write the pictures of an episode, of the tactile sensor or a stream; return the pixels of each level."""
    if key == VIDEO:
        shown = pictures(files.recording, edges)
    else:
        shown = other_streams.pictures(files.recording, contents.stream_videos[key], edges)
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
