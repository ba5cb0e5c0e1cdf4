"""What the rows of `evaluate cost` have in common: extents, progress and run times."""

import numpy as np

from evetac_cli.numerics.rows import Extent, collect, run_times


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
