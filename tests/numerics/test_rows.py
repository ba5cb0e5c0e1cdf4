"""What rows have in common: extents, run times, and how refusals, failures and acceptances are told apart."""

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.numerics.rows import Extent, case_row, collect, refusal, run_case, run_times


def test_an_extent_is_picked():
    """Assert that --full picks the full amount."""
    assert [Extent(2, 20).pick(full) for full in (False, True)] == [2, 20]


def test_rows_are_collected_with_progress():
    """Assert that progress is reported after each row."""
    reports = []
    rows = [{"setting": "a"}, {"setting": "b"}]
    assert collect(iter(rows), 2, lambda done, total: reports.append((done, total))) == rows
    assert reports == [(1, 2), (2, 2)]


def test_run_times_by_hand():
    """Assert median and 99th percentile, and None where nothing was timed."""
    assert run_times(np.arange(101.0)) == {"time_us_median": 50.0, "time_us_p99": 99.0}
    assert run_times(np.empty(0), "step") == {"step_us_median": None, "step_us_p99": None}


def test_the_row_of_a_case_is_that_of_its_run():
    """Assert that a case that ends gives its own row, with its figures after the outcome."""
    row = case_row("x", True, "finite", residual=0.5)
    assert list(row.items()) == [("case", "x"), ("ok", True), ("outcome", "finite"), ("residual", 0.5)]
    assert run_case("x", lambda: row) is row


def test_a_refusal_is_no_failure():
    """Assert that an error with words is a refusal, and any other exception, or one without words, is not ok."""

    def refuse():
        raise ValueError("expected less")

    def refuse_input():
        raise InputError("a rate out of range", where="--control-hz")

    def divide():
        return 1 / 0

    def silent():
        raise ValueError

    assert refusal("x", refuse) == {"case": "x", "ok": True, "outcome": "refused: expected less"}
    assert refusal("x", refuse_input)["ok"]
    assert refusal("x", divide)["outcome"] == "failed: ZeroDivisionError: division by zero"
    assert not refusal("x", divide)["ok"]
    assert not refusal("x", silent)["ok"]
    assert refusal("x", lambda: None) == {"case": "x", "ok": False, "outcome": "accepted"}
