"""Statistics of one or several episodes, which policies use to normalize their inputs.

Source: compute_stats.py of lerobot 0.4.4. The statistics here are exact, over all frames and pixels; lerobot estimates
quantiles from histograms and samples the pictures. Those of several episodes are computed from all of their frames,
since quantiles of parts do not determine those of the whole.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Figures = Mapping[str, NDArray[Any]]  # min, max, mean, std, count, quantiles
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
AT_ONCE_BYTES = 1 << 27  # of the values of all episodes
LEVELS = np.arange(256) / 255  # of the pixels of a picture


def of_columns(values: NDArray[Any]) -> Figures:
    """Return minimum, maximum, mean, standard deviation and quantiles per column, and the number of frames.

    values: (frames,), (frames, n), or (frames, rows, n), whose n columns are evaluated over all rows, as in lerobot.
    """
    table = as_table(values).astype(np.float64)
    quantiles = np.quantile(table, list(QUANTILES.values()), axis=0)
    return {
        "min": table.min(axis=0),
        "max": table.max(axis=0),
        "mean": table.mean(axis=0),
        "std": table.std(axis=0),
        "count": np.array([len(values)]),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


def of_many(parts: Callable[[], Iterable[NDArray[Any]]], rows: int, columns: int, frames: int) -> Figures:
    """Return the statistics per column of a table too large for memory, reading its parts (rows, columns) repeatedly.

    rows: in all parts together. frames: the number of frames, which can have several rows each.
    """
    wide = max(1, AT_ONCE_BYTES // (8 * rows))
    some = [
        of_columns(np.concatenate([part[:, first : first + wide] for part in parts()]))
        for first in range(0, columns, wide)
    ]
    return {name: np.concatenate([one[name] for one in some]) for name in some[0]} | {"count": np.array([frames])}


def as_table(values: NDArray[Any]) -> NDArray[Any]:
    """Return values (frames,), (frames, n) or (frames, rows, n) as a table with n columns."""
    return values.reshape(-1, values.shape[-1] if values.ndim > 1 else 1)


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
