"""Write trials as a LeRobotDataset v3.0, which lerobot 0.4 to 0.6 and its policies read from a folder.

    meta/info.json  meta/stats.json  meta/tasks.parquet  meta/episodes/chunk-000/file-000.parquet
    data/chunk-000/file-000.parquet  videos/observation.images.tactile/chunk-000/file-000.mp4
    README.md  meta/evetac.json

An episode is a trial, a row a frame (episodes.py says how frames come from slices). Many episodes lie in one file, of
data and of video, up to the sizes that lerobot has. Episodes of the split `test` come last. README.md is the data card;
meta/evetac.json has the header of every file that an episode comes from. lerobot needs neither.

Source: LeRobotDataset v3.0 as lerobot 0.4.4 writes it (lerobot/datasets/lerobot_dataset.py, utils.py).
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, missing_extra
from evetac_cli.events import SLICES_PER_S
from evetac_cli.formats.write.lerobot.data_card import data_card
from evetac_cli.formats.write.lerobot.episode_files import EpisodePlace, Numbered, Tables, Videos
from evetac_cli.formats.write.lerobot.episodes import (
    GREYS,
    Episode,
    Vectors,
    choose_vectors,
    episode,
    names_of,
    outline,
    pictures,
)
from evetac_cli.formats.write.lerobot.statistics import Figures, as_lists, of_columns, of_pictures, together
from evetac_cli.formats.write.slice_columns import Opener, WrittenFolder
from evetac_cli.formats.write.write_table import load_pyarrow, provenance, typed
from evetac_cli.jobs import Progress
from evetac_cli.store.recordings import streams

VERSION = "v3.0"
VIDEO = "observation.images.tactile"
CHUNK_FILES = 1000  # in a folder
DATA_MB, VIDEO_MB = 100, 200  # after which the next episode begins a new file
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
INDICES = ("frame_index", "episode_index", "index", "task_index")


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
) -> WrittenFolder:
    """Write all trials as one data set; InputError where they do not go together, MissingLibrary."""
    arrow, av = load_pyarrow(str(folder.parent)), _load_av(str(folder.parent))
    outlines = []
    for source in sources:
        with opened(source) as files:
            outlines.append(outline(files, task))
    vectors, said = choose_vectors(outlines)
    outlines.sort(key=lambda one: one.facts["object"] in test_objects)  # stable: test comes last
    train = sum(one.facts["object"] not in test_objects for one in outlines)
    if test_objects and train == len(outlines):
        objects = ", ".join(sorted({str(one.facts["object"]) for one in outlines}))
        raise InputError("no trial has such an object", where="--test-objects", expected=f"of {objects}")
    stacked = SLICES_PER_S // fps
    names = vectors._replace(tactile=tuple(names_of(vectors.tactile, per_frame, stacked)))
    features = _features(names, tactile_key, outlines[0].frame_px, fps)
    tasks = list(dict.fromkeys(one.task for one in outlines))
    headers: dict[str, Any] = {}
    total: Mapping[str, Figures] = {}
    done, slices = 0, sum(one.slices for one in outlines)
    with _video_errors(av, folder), ExitStack() as stack:
        data = stack.enter_context(Tables(arrow, Numbered(folder, DATA_PATH, CHUNK_FILES, DATA_MB)))
        episodes = stack.enter_context(Tables(arrow, Numbered(folder, EPISODES_PATH, CHUNK_FILES, None)))
        pattern = VIDEO_PATH.replace("{video_key}", VIDEO)
        pictures_to = Numbered(folder, pattern, CHUNK_FILES, VIDEO_MB)
        videos = stack.enter_context(Videos(av, pictures_to, fps, features[VIDEO]["shape"]))
        types = {**typed([one.facts for one in outlines]), "recording_id": "string"}
        for number, one in enumerate(outlines):
            progress(done, slices, "slices")
            with opened(one.path) as files:
                made = episode(files, vectors, fps, per_frame)
                headers[str(number)] = provenance(files, one.facts)
                place = videos.begin()
                levels = np.zeros(len(GREYS), np.int64)
                for picture in pictures(files.recording, made.edges):
                    videos.add(picture)
                    levels += np.bincount(picture.ravel(), minlength=256)[GREYS]
                other = [f"{streams.GROUP}/{name}" for name in streams.names(files.recording.contents())]
                said += [f"{one.facts['trial']}: {note}" for note in (*files.notes, *other)]
            rows = _rows(made, tactile_key, number, data.rows, tasks.index(one.task), fps)
            statistics = {name: of_columns(values) for name, values in rows.items()}
            statistics[VIDEO] = of_pictures(GREYS / 255, levels, len(made.state))
            total = together(total, statistics)
            lies = {
                "episode_index": number,
                "tasks": [one.task],
                "length": len(made.state),
                "dataset_from_index": data.rows,
                "dataset_to_index": data.rows + len(made.state),
                **_place("data", data.append(_data_table(arrow, rows, features))),
                **_place("meta/episodes", EpisodePlace(0, 0)),
                **_place(f"videos/{VIDEO}", place),
                f"videos/{VIDEO}/from_timestamp": place.start_s,
                f"videos/{VIDEO}/to_timestamp": videos.now_s,
            }
            episodes.append(_episode_table(arrow, lies, statistics, {**one.facts, "recording_id": one.id}, types))
            done += one.slices
    _write_tasks(arrow, folder / "meta" / "tasks.parquet", tasks)
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
        "features": features,
    }
    _write_json(folder / "meta" / "info.json", info)
    _write_json(folder / "meta" / "stats.json", as_lists(total))
    _write_json(folder / "meta" / "evetac.json", {"per_frame": per_frame, "fps": fps, "episodes": headers})
    card = data_card(outlines, vectors, info, per_frame, tactile_key, said)
    (folder / "README.md").write_text(card, encoding="utf-8")
    simulated = any(one.facts["simulated"] for one in outlines)
    return WrittenFolder(simulated, said, {"episodes": len(outlines), "frames": data.rows, "fps": fps, **splits})


def _load_av(where: str) -> Any:
    try:
        import av
    except ImportError as error:
        raise missing_extra("video needs av", "convert", where=where, error=error) from None
    return av


@contextmanager
def _video_errors(av: Any, folder: Path) -> Iterator[None]:
    """Say in words what the library for video says, which is no OSError where the disk is full."""
    try:
        yield
    except av.FFmpegError as error:
        where, said = str(folder.parent), str(error)[:200]
        raise InputError("the video cannot be written", where=where, found=said, hint="is the disk full?") from error


def _features(names: Vectors, tactile_key: str, frame_px: tuple[int, int], fps: int) -> dict[str, Any]:
    """What a row holds, as info.json says it."""
    width, height = (side + side % 2 for side in frame_px)

    def vector(listed: Sequence[str]) -> dict[str, Any]:
        return {"dtype": "float32", "shape": [len(listed)], "names": list(listed)}

    video = {
        "video.height": height,
        "video.width": width,
        "video.codec": "h264",
        "video.pix_fmt": "yuv420p",
        "video.is_depth_map": False,
        "video.fps": fps,
        "video.channels": 3,
        "has_audio": False,
    }
    return {
        "observation.state": vector(names.state),
        tactile_key: vector(names.tactile),
        VIDEO: {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": video},
        "action": vector(names.action),
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        **{name: {"dtype": "int64", "shape": [1], "names": None} for name in INDICES},
    }


def _rows(made: Episode, tactile_key: str, number: int, first: int, task: int, fps: int) -> dict[str, NDArray[Any]]:
    """The columns of an episode: vectors (frames, n), and numbers (frames,)."""
    frames = len(made.state)
    at = np.arange(frames, dtype=np.int64)
    return {
        "observation.state": made.state,
        tactile_key: made.tactile,
        "action": made.action,
        "timestamp": (at / fps).astype(np.float32),
        "frame_index": at,
        "episode_index": np.full(frames, number),
        "index": first + at,
        "task_index": np.full(frames, task),
    }


def _data_table(arrow: Any, rows: Mapping[str, NDArray[Any]], features: Mapping[str, Any]) -> Any:
    made = {}
    for name, feature in features.items():
        if name == VIDEO:
            continue
        values = rows[name]
        flat = arrow.array(values.ravel())
        made[name] = flat if values.ndim == 1 else arrow.FixedSizeListArray.from_arrays(flat, feature["shape"][0])
    return arrow.table(made)


def _place(what: str, place: EpisodePlace) -> dict[str, int]:
    return {f"{what}/chunk_index": place.chunk, f"{what}/file_index": place.file}


def _episode_table(
    arrow: Any,
    lies: Mapping[str, Any],
    statistics: Mapping[str, Figures],
    facts: Mapping[str, Any],
    types: Mapping[str, Any],
) -> Any:
    """The row of an episode: where its frames and pictures lie, its statistics, and which trial it is."""
    row = dict(lies)
    for name, figures in as_lists(statistics).items():
        row |= {f"stats/{name}/{figure}": value for figure, value in figures.items()}
    table = arrow.Table.from_pylist([row])
    for name, type_ in types.items():
        value = facts[name]
        value = str(value) if type_ == "string" and value is not None else value
        table = table.append_column(name, arrow.array([value], arrow.type_for_alias(type_)))
    return table


def _write_tasks(arrow: Any, path: Path, tasks: Sequence[str]) -> None:
    """The tasks as pandas writes a table whose index they are, which is how lerobot reads it."""
    text = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    index = {"name": "task", "field_name": "task", **text}
    number = {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"}
    head = {"name": None, "field_name": None, **text, "metadata": {"encoding": "UTF-8"}}
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [head],
        "columns": [{**number, "metadata": None}, index],
        "creator": {"library": "pyarrow", "version": arrow.__version__},
        "pandas_version": "2.2.0",
    }
    table = arrow.table({"task_index": arrow.array(range(len(tasks)), arrow.int64()), "task": arrow.array(tasks)})
    arrow.parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


def _write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False, allow_nan=False), encoding="utf-8")
