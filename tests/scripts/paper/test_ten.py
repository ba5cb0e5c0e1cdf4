"""The ten rows of README: figures, intervals and verdicts computed by hand, from the counts and figures of the trials.

Nothing of scripts/paper/rows.py and verdicts.py is used here. Intervals from resampling are made with other random
numbers, so their ends agree within a part of their width.
"""

import json
import math
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy import stats

from scripts.paper import rows as paper_rows
from scripts.paper.ten import TEN

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


SHARE = (-0.1, 0.1)  # margin of shares


def ratio(paper: float, times: float = 1.25) -> tuple[float, float]:
    """The margin of a ratio, as a difference."""
    return paper / times - paper, paper * times - paper


def printed(figure: float, interval: Interval) -> Interval:
    """A share as the paper prints it, with the interval of so many hits of so many trials."""
    return figure, *interval[1:]


class ByHand(NamedTuple):
    """The paper's figure, the margin, and what of the table's row the interval is computed from."""

    paper: Interval
    margin: tuple[float, float]
    kind: str


BY_HAND = {
    "20a": ByHand(wilson(8, 10), SHARE, "counts"),  # 8 of 10 trajectories
    "29p": ByHand(wilson(245, 250), SHARE, "counts"),  # 98 % of 250 windows
    "36a": ByHand(student(0.017, 0.004, 5), ratio(0.017), "mean"),  # five trajectories
    "41c": ByHand((0.33, 0.33, 0.33), ratio(0.33), "trajectories"),  # one trajectory, without an interval
    "77a": ByHand(printed(0.926, wilson(83, 90)), SHARE, "objects"),
    "79b": ByHand(printed(0.88, wilson(70, 80)), SHARE, "objects"),
    "82a": ByHand(printed(0.57, wilson(46, 80)), SHARE, "interval"),
    "91a": ByHand(printed(0.93, wilson(112, 120)), SHARE, "interval"),
    "98c": ByHand(wilson(10, 10), SHARE, "counts"),
}
COUNTS = {"20a": ("consistent", "trajectories"), "29p": ("correct", "windows"), "98c": ("success", "trials")}


def ours_by_hand(number: str, kind: str, row: dict[str, Any]) -> Interval:
    """Evetac's figure and interval from the counts, or from the trajectories or objects of a row."""
    field = ENTRIES[number]["field"]
    if kind == "counts":
        above, below = COUNTS[number]
        hits = row[above] * row[below] if above == "success" else row[above]
        return wilson(hits, row[below])
    if kind == "mean":
        return student(row["share_mean"], row["share_sd"], row["trajectories"])
    if kind == "interval" or "by_unit" not in row:  # a table of before the freeze
        return row[field], row[f"{field}_low"], row[f"{field}_high"]
    figures = [one[field] for one in row["by_unit"].values()]
    if kind == "trajectories":
        return student(float(np.mean(figures)), float(np.std(figures, ddof=1)), len(figures))
    return resampled(figures)


@pytest.mark.parametrize("number", BY_HAND)
def test_ten_rows_by_hand(number: str) -> None:
    """Assert figure, interval and verdict of a row."""
    by_hand, entry, row = BY_HAND[number], ENTRIES[number], table_row(number)
    found = entry["computed"]
    ours = ours_by_hand(number, by_hand.kind, row)
    assert found["ours"] == pytest.approx(ours[0], rel=1e-3)
    off = RESAMPLED * (ours[2] - ours[1]) if by_hand.kind == "objects" else 1e-3 * max(1.0, abs(ours[2]))
    assert found["interval"] == pytest.approx(ours[1:], abs=off)
    assert found["paper"] == pytest.approx(by_hand.paper[0], abs=0.005)
    expected = verdict(ours, by_hand.paper, *by_hand.margin)
    if "tracks" in entry and found["error_px_rms"] >= found["still_px_rms"]:
        expected = "undecided"  # dots that never move do as well
    assert found["verdict"] == expected


def test_a_run_time_is_judged_by_the_papers_bound() -> None:
    """Assert that the network takes at most the 0.1 ms of the paper, or the row says that it differs."""
    (time_ms, found) = table_row("84a")["inference_ms_median"], ENTRIES["84a"]["computed"]
    assert found["verdict"] == ("compatible" if time_ms <= 0.1 else "different")


def test_the_ten_rows_are_these() -> None:
    """Assert that every row of the table is computed by hand here."""
    assert {row.number for row in TEN} == {*BY_HAND, "84a"}
