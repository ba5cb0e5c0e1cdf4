"""What the files that describe a data set for lerobot contain: features, statistics, tasks, and one row per episode.

Source of the statistics, which policies use to normalize their inputs: compute_stats.py of lerobot 0.4.4. Here they
are exact, over all frames and pixels; lerobot estimates quantiles from histograms and samples the pictures. Those of
several episodes are computed from all of their frames, since quantiles of parts do not determine those of the whole.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.formats.write.lerobot.episode_files import EpisodePlace

STATE, ACTION, VIDEO = "observation.state", "action", "observation.images.tactile"
INDICES = ("frame_index", "episode_index", "index", "task_index")
Figures = Mapping[str, NDArray[Any]]  # min, max, mean, std, count, quantiles
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
AT_ONCE_BYTES = 1 << 27  # of the values of all episodes
LEVELS = np.arange(256) / 255  # of the pixels of a picture


class Feature(NamedTuple):
    """A feature: its type, its shape per frame, the names of its values, a text for the card, and further info."""

    dtype: str
    shape: tuple[int, ...]
    names: Sequence[str] | None
    what: str = ""
    info: Mapping[str, Any] | None = None

    def described(self) -> dict[str, Any]:
        """Return the feature as meta/info.json describes it."""
        names = None if self.names is None else list(self.names)
        description = {"dtype": self.dtype, "shape": list(self.shape), "names": names}
        return description if self.info is None else {**description, "info": dict(self.info)}

    @property
    def size(self) -> str:
        """The number of values per frame, as text."""
        height, width = self.shape[:2] if len(self.shape) > 2 else (0, 0)
        return f"{width} x {height} px" if height else " x ".join(map(str, self.shape))


def vector(names: Sequence[str], what: str) -> Feature:
    """Return a feature that is a vector of named numbers."""
    return Feature("float32", (len(names),), names, what)


def video(height: int, width: int, fps: int, what: str) -> Feature:
    """Return a feature that is an RGB video, as `Videos` writes it."""
    info = {
        "video.height": height,
        "video.width": width,
        "video.codec": "h264",
        "video.pix_fmt": "yuv420p",
        "video.is_depth_map": False,
        "video.fps": fps,
        "video.channels": 3,
        "has_audio": False,
    }
    return Feature("video", (height, width, 3), ("height", "width", "channels"), what, info)


def indices() -> dict[str, Feature]:
    """Return the features of every data set: the time of a frame and its indices."""
    numbers = {name: Feature("int64", (1,), None) for name in INDICES}
    return {"timestamp": Feature("float32", (1,), None), **numbers}


def of_columns(values: NDArray[Any]) -> Figures:
    """Return minimum, maximum, mean, standard deviation and quantiles per column, and the number of frames.

    values: (frames,) or (frames, n).
    """
    table = values.reshape(len(values), -1).astype(np.float64)
    quantiles = np.quantile(table, list(QUANTILES.values()), axis=0)
    return {
        "min": table.min(axis=0),
        "max": table.max(axis=0),
        "mean": table.mean(axis=0),
        "std": table.std(axis=0),
        "count": np.array([len(values)]),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


def of_many(parts: Callable[[], Iterable[NDArray[Any]]], columns: int, frames: int) -> Figures:
    """Return the statistics per column of a table too large for memory, reading its parts (frames, columns) repeatedly.

    frames: in all parts together.
    """
    wide = max(1, AT_ONCE_BYTES // (8 * frames))
    some = [
        of_columns(np.concatenate([part[:, first : first + wide] for part in parts()]))
        for first in range(0, columns, wide)
    ]
    return {name: np.concatenate([one[name] for one in some]) for name in some[0]} | {"count": np.array([frames])}


def of_pictures(pixels: NDArray[np.int64], frames: int) -> Figures:
    """Return the same statistics for pictures with levels from 0 to 1, of shape (3, 1, 1) each.

    pixels: the number of pixels of each of 256 levels, (256,) for grey or (3, 256) for RGB.
    """
    channels = [_of_levels(channel) for channel in np.atleast_2d(pixels)]
    figures = {name: np.array([one[name] for one in channels]).reshape(-1, 1, 1) for name in channels[0]}
    return {
        "count": np.array([frames]),
        **{name: np.broadcast_to(value, (3, 1, 1)) for name, value in figures.items()},
    }


def _of_levels(pixels: NDArray[np.int64]) -> dict[str, Any]:
    mean = (LEVELS * pixels).sum() / pixels.sum()
    shown, upto = LEVELS[pixels > 0], pixels.cumsum()

    def quantile(part: float) -> Any:
        at = part * (upto[-1] - 1)
        below, above = LEVELS[np.searchsorted(upto, [np.floor(at), np.ceil(at)], side="right")]
        return below + (above - below) * (at % 1)

    return {
        "min": shown.min(),
        "max": shown.max(),
        "mean": mean,
        "std": np.sqrt(((LEVELS - mean) ** 2 * pixels).sum() / pixels.sum()),
        **{name: quantile(part) for name, part in QUANTILES.items()},
    }


def as_lists(statistics: Mapping[str, Figures]) -> dict[str, dict[str, Any]]:
    """Convert the statistics to lists, for JSON and Parquet."""
    return {name: {figure: value.tolist() for figure, value in one.items()} for name, one in statistics.items()}


def place_columns(what: str, place: EpisodePlace) -> dict[str, int]:
    """Return the location of an episode as columns of its row."""
    return {f"{what}/chunk_index": place.chunk, f"{what}/file_index": place.file}


def episode_table(
    arrow: Any,
    lies: Mapping[str, Any],
    statistics: Mapping[str, Figures],
    facts: Mapping[str, Any],
    types: Mapping[str, Any],
) -> Any:
    """Return the row of an episode: the locations of its frames and pictures, its statistics, and its trial's facts."""
    row = dict(lies)
    for name, figures in as_lists(statistics).items():
        row |= {f"stats/{name}/{figure}": value for figure, value in figures.items()}
    table = arrow.Table.from_pylist([row])
    for name, type_ in types.items():
        value = facts[name]
        value = str(value) if type_ == "string" and value is not None else value
        table = table.append_column(name, arrow.array([value], arrow.type_for_alias(type_)))
    return table


def write_tasks(arrow: Any, path: Path, tasks: Sequence[str]) -> None:
    """Write the tasks in the form of a pandas table with the tasks as index, which lerobot expects."""
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


def write_json(path: Path, content: Any) -> None:
    """Write one of the JSON files."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False, allow_nan=False), encoding="utf-8")
