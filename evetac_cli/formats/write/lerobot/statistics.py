"""Statistics of one or several episodes, which policies use to normalize their inputs.

Source: compute_stats.py of lerobot 0.4.4. The statistics here are exact, over all frames and pixels; lerobot estimates
quantiles from histograms and samples the pictures.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Figures = Mapping[str, NDArray[Any]]  # min, max, mean, std, count, quantiles
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


def of_columns(values: NDArray[Any]) -> Figures:
    """Return minimum, maximum, mean, standard deviation and quantiles per column, and the number of frames.

    values: (frames,), (frames, n), or (frames, rows, n), whose n columns are evaluated over all rows, as in lerobot.
    """
    table = values.reshape(-1, values.shape[-1] if values.ndim > 1 else 1).astype(np.float64)
    quantiles = np.quantile(table, list(QUANTILES.values()), axis=0)
    return {
        "min": table.min(axis=0),
        "max": table.max(axis=0),
        "mean": table.mean(axis=0),
        "std": table.std(axis=0),
        "count": np.array([len(values)]),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


def of_pictures(levels: NDArray[np.float64], pixels: NDArray[np.int64], frames: int) -> Figures:
    """Return the same statistics for pictures, of shape (3, 1, 1) each.

    levels: 0 to 1, increasing. pixels: the number of pixels of each level, (levels,) for grey or (3, levels) for RGB.
    """
    channels = [_of_levels(levels, channel) for channel in np.atleast_2d(pixels)]
    figures = {name: np.array([one[name] for one in channels]).reshape(-1, 1, 1) for name in channels[0]}
    return {
        "count": np.array([frames]),
        **{name: np.broadcast_to(value, (3, 1, 1)) for name, value in figures.items()},
    }


def _of_levels(levels: NDArray[np.float64], pixels: NDArray[np.int64]) -> dict[str, Any]:
    mean = (levels * pixels).sum() / pixels.sum()
    shown, share = levels[pixels > 0], pixels.cumsum() / pixels.sum()
    return {
        "min": shown.min(),
        "max": shown.max(),
        "mean": mean,
        "std": np.sqrt(((levels - mean) ** 2 * pixels).sum() / pixels.sum()),
        **{name: levels[np.searchsorted(share, part)] for name, part in QUANTILES.items()},
    }


def together(a: Mapping[str, Figures], b: Mapping[str, Figures]) -> Mapping[str, Figures]:
    """Combine statistics by column name; quantiles are means weighted by frames, as in lerobot, the rest is exact."""
    return {name: _both(a[name], b[name]) for name in b} if a else b


def _both(a: Figures, b: Figures) -> Figures:
    share = b["count"][0] / (a["count"][0] + b["count"][0])
    mean = a["mean"] + share * (b["mean"] - a["mean"])
    spread_a, spread_b = (one["std"] ** 2 + (one["mean"] - mean) ** 2 for one in (a, b))
    return {
        "min": np.minimum(a["min"], b["min"]),
        "max": np.maximum(a["max"], b["max"]),
        "mean": mean,
        "std": np.sqrt((1 - share) * spread_a + share * spread_b),
        "count": a["count"] + b["count"],
        **{name: a[name] + share * (b[name] - a[name]) for name in QUANTILES},
    }


def as_lists(statistics: Mapping[str, Figures]) -> dict[str, dict[str, Any]]:
    """Convert the statistics to lists, for JSON and Parquet."""
    return {name: {figure: value.tolist() for figure, value in one.items()} for name, one in statistics.items()}
