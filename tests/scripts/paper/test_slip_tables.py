"""scripts/paper/slip_tables.py: first detections by time and object, timing by object, predictions over time."""

from typing import Any

import pytest

from scripts.paper import slip_tables
from scripts.reproduce import made_tables, table_text
from scripts.reproduce.tables import Evaluation

ABOUT = {"preset": "paper", "trajectories": 4, "folds": 0, "true_slip_share": False}
SETTINGS = [
    {"setting": "fast-slow", "model": "fast-slow", "horizon_ms": 0, "seeds": 2, **ABOUT},
    {"setting": "fast-slow, 10 ms ahead", "model": "fast-slow", "horizon_ms": 10, "seeds": 2, **ABOUT},
]


def evaluations(name: str, *rows: dict[str, Any]) -> dict[str, Evaluation]:
    """A report with both settings and these rows."""
    return {name: Evaluation([*SETTINGS, *rows], {}, True)}


def detection(
    object_: str, file: str, late_by_ms: int | None, setting: str = "fast-slow, 10 ms ahead"
) -> dict[str, Any]:
    """A first detection on a slip; None for one that was missed."""
    return {"setting": setting, "object": object_, "file": file, "t_c_ms": 900, "t_m_minus_t_c_ms": late_by_ms}


def test_first_detections_by_time_and_object() -> None:
    """Assert shares of both seeds in each bin, up to its end, with intervals; other settings and no slips left out."""
    rows = [
        *(detection("10", "a", late) for late in (-5, -20)), *(detection("10", "b", late) for late in (0, -60)),
        *(detection("11", "c", late) for late in (-10, None)), *(detection("11", "d", late) for late in (20, 21)),
        detection("11", "c", -5, "fast-slow"), {**detection("11", "e", None), "t_c_ms": None},
    ]  # fmt: skip
    found = slip_tables.timing_rows(evaluations(slip_tables.UNSEEN, *rows))
    assert [row["object"] for row in found] == ["all"] * 6 + ["10"] * 6 + ["11"] * 6
    every = {row["bin"]: row for row in found[:6]}
    shares = [every[name]["share"] for name in slip_tables.BIN_WORDS]
    assert shares == pytest.approx([1 / 8, 0, 1 / 8, 3 / 8, 1 / 8, 1 / 8])
    assert [row["by_its_end"] for row in found[:6]][-1] == pytest.approx(7 / 8)
    middle = every["10_to_0_ms_ahead"]
    assert (middle["share_low"], middle["share_high"], middle["slips"]) == (0.25, 0.5, 4)
    assert (middle["paper_timing_share"], found[9]["bin"], found[9]["paper_timing_share"]) == (
        0.57,
        middle["bin"],
        None,
    )
    assert slip_tables.timing_rows({"x": Evaluation(SETTINGS[:1], {}, True)}) == []


def test_the_table_of_first_detections() -> None:
    """Assert that a table shows shares and the paper's figure over all objects alone, with a mark."""
    made = made_tables.result(
        slip_tables.SLIP_TIMING, evaluations(slip_tables.UNSEEN, detection("10", "a", -5)), ["evetac x"]
    )
    heads, every, one = table_text.lines(made)
    assert heads[:2] == ["object", "slips"] and heads[5] == "-10 to 0 ms (paper)"
    assert every[5] == "1.00; 1.00 (0.57, other method)" and one[5] == "1.00; 1.00"
    assert {"share_low", "bin", "seeds", "preset"} <= made["rows"][0].keys()
