"""The ten rows of README: figures, intervals and verdicts computed by hand, from the counts and figures of the trials.

Nothing of scripts/paper/rows.py and verdicts.py is used here. Intervals from resampling are made with other random
numbers, so their ends agree within a part of their width.
"""

import json
import math
from typing import Any

import numpy as np
from scipy import stats

from scripts.paper import rows as paper_rows

RESULTS = paper_rows.RESULTS
ENTRIES = paper_rows.by_number(paper_rows.read()["rows"])
Interval = tuple[float, float, float]  # a figure and the ends of its 95 % interval
RESAMPLED = 0.1  # ends of intervals from resampling agree within this share of the width


def wilson(hits: float, count: int) -> Interval:
    """Wilson's interval of a share, from its printed formula."""
    z, share = 1.959964, hits / count
    middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * math.sqrt(share * (1 - share) / count + z**2 / (4 * count**2))
    return share, middle - half, middle + half


def student(mean: float, sd: float, count: int) -> Interval:
    """Student's interval of a mean."""
    half = stats.t.ppf(0.975, count - 1) * sd / math.sqrt(count)
    return mean, mean - half, mean + half


def resampled(figures: list[float]) -> Interval:
    """The percentiles of means of figures that are drawn with replacement."""
    rng = np.random.default_rng(7)
    means = rng.choice(figures, (20_000, len(figures))).mean(axis=1)
    return float(np.mean(figures)), *np.percentile(means, [2.5, 97.5]).tolist()


def verdict(ours: Interval, paper: Interval, below: float, above: float) -> str:
    """The verdict on a difference that may be called equal from `below` to `above` (Newcombe's method 10)."""
    off = ours[0] - paper[0]
    low = off - math.sqrt((ours[0] - ours[1]) ** 2 + (paper[2] - paper[0]) ** 2)
    high = off + math.sqrt((ours[2] - ours[0]) ** 2 + (paper[0] - paper[1]) ** 2)
    if below <= low and high <= above:
        return "agrees"
    if low > 0 or high < 0:
        return "different"
    return "compatible" if high - low <= above - below else "undecided"


def table_row(number: str) -> dict[str, Any]:
    """The row of the table that a row of the paper names."""
    entry = ENTRIES[number]
    table = json.loads((RESULTS / f"{entry['table']}.json").read_text())
    (found,) = (row for row in table["rows"] if entry["row"].items() <= row.items())
    return dict(found)
