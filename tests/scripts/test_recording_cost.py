"""recording_cost.py: when it is content, and that a run of it measures every trial."""

from typing import Any

import pytest

from scripts import recording_cost


def row(blocks: str, share: float) -> dict[str, Any]:
    return {"blocks_a_trial": blocks, "writing_share_most": share}


@pytest.mark.parametrize(
    ("quiet", "busy", "status"),
    [
        (row("1", 0.09), row("1", 0.09), 0),
        (row("1 2", 0.09), row("1 2", 0.01), 0),
        (row("1", 0.09), row("1 2", 0.09), 1),
        (row("1", 0.1), row("1", 0.01), 1),
        (row("1", 0.01), row("1", 0.5), 1),
    ],
)
def test_it_is_content_with_equal_blocks_and_small_shares(
    quiet: dict[str, Any], busy: dict[str, Any], status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that the exit status tells where blocks depend on other programs, or writing takes a tenth of a trial."""
    monkeypatch.setattr("sys.argv", ["recording_cost.py"])
    monkeypatch.setattr(recording_cost, "recorded", lambda trials, busy_loops: busy if busy_loops else quiet)
    assert recording_cost.main() == status


@pytest.mark.slow
def test_every_trial_is_measured() -> None:
    """Assert that a run tells of each of its trials, which two processes record, how much of its time was writing."""
    measured = recording_cost.recorded(3, 0)
    assert (measured["trials"], measured["blocks_a_trial"]) == (3, "1")
    assert 0 < measured["writing_share_median"] <= measured["writing_share_most"] < 1
    assert measured["cpu_a_trial_s"] > 0
