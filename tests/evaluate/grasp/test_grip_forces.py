"""Force over what just holds, of rows made by hand."""

import pytest

from evetac_cli.evaluate.grasp.grip_forces import firmness, rank_correlation


def row(carried_g: float, force_n: float, over: float, **more: object) -> dict:
    """A grasp that held."""
    figures = {"over_holding_end": over, "over_holding_mean": 2 * over, "over_holding_peak": 3 * over}
    whole = {"balanced": True, "failure": "", "carried_g": carried_g, "force_end_n": force_n, **figures}
    return {**whole, "moved_mm": 1.0, "motor_work_j": 0.1, "slip_events": 4, "false_slip_events": 1, **more}


def test_figures_of_a_law() -> None:
    """Assert medians, the 95th percentile of each class of mass, losses by how, and shares, by hand."""
    trials = [row(40.0, 0.5, 2.0), row(120.0, 0.8, 1.0), row(200.0, 1.5, 1.5), row(500.0, 3.0, 1.2, moved_mm=7.0)]
    trials += [row(300.0, 0.0, 0.0, balanced=False, failure="fell in balance")]
    result = firmness(trials)
    assert (result["grasps"], result["kept"], result["lost"]) == (5, 0.8, "1 fell in balance")
    assert result["over_holding_end_median"] == pytest.approx(1.35)
    assert result["over_holding_mean_median"] == pytest.approx(2.7)
    assert result["over_holding_end_p95_30_100_g"] == 2.0
    assert result["over_holding_end_p95_100_250_g"] == pytest.approx(1.475)
    assert result["over_holding_end_p95_250_600_g"] == 1.2
    assert result["force_follows_weight"] == pytest.approx(1.0)
    assert result["stayed_share"] == 0.75
    assert result["reactions_mean"] == 4.0
    assert result["false_share"] == 0.25


def test_nothing_was_held() -> None:
    """Assert that of laws that lose everything no force is told."""
    result = firmness([row(40.0, 0.0, 0.0, balanced=False, failure="stayed on the table", slip_events=0)])
    assert result["kept"] == 0.0
    assert result["over_holding_end_median"] is result["force_follows_weight"] is result["stayed_share"] is None
    assert result["false_share"] is None


def test_ranks() -> None:
    """Assert Spearman's correlation of ranks, with shared ones, and none of few or equal values."""
    assert rank_correlation([1, 2, 3, 4], [10, 1000, 100, 5000]) == pytest.approx(0.8)
    assert rank_correlation([1, 2, 2, 3], [1, 2, 2, 3]) == pytest.approx(1.0)
    assert rank_correlation([1, 2, 3], [3, 2, 1]) == pytest.approx(-1.0)
    assert rank_correlation([1, 2], [1, 2]) is None
    assert rank_correlation([1, 2, 3], [5, 5, 5]) is None
