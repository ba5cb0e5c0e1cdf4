"""Figures by which recordings are compared, against events whose figures are known."""

import numpy as np
import pytest

from evetac_cli.kernels import realism

FRAME = (8, 4)


def regular() -> tuple[np.ndarray, ...]:
    """Pixel (2, 1) every 10 ms for 1 s, ON and OFF in turn; pixel (5, 3) at 0.1 s and 0.5 s, ON."""
    t = np.concatenate([np.arange(100) * 10_000, [100_000, 500_000]])
    x = np.concatenate([np.full(100, 2), [5, 5]])
    y = np.concatenate([np.full(100, 1), [3, 3]])
    p = np.concatenate([np.arange(100) % 2 == 0, [1, 1]]).astype(np.uint8)
    order = np.argsort(t, kind="stable")
    return t[order], x[order], y[order], p[order]


def test_at_rest() -> None:
    """Assert rates, shares and times of a hot pixel and of an ordinary one."""
    result = realism.at_rest(*regular(), FRAME, 10**6)
    assert result["events_a_slice"] == pytest.approx(0.102)
    assert result["hot_pixels"] == 1 and result["hot_event_share"] == pytest.approx(100 / 102)
    assert result["ordinary_hz"] == pytest.approx(2 / 31) and result["ordinary_on_share"] == 1.0
    assert result["hot_on_share"] == 0.5
    for name, us in (("", 10_000), ("on_", 20_000), ("off_", 20_000)):
        for quantile in ("median", "p90", "median_of_typical_pixel", "p90_of_typical_pixel"):
            assert result[f"hot_{name}interval_us_{quantile}"] == us


def test_in_motion() -> None:
    """Assert counts, times and bands of a rate that swings at 20 Hz."""
    counts = np.round(100 + 50 * np.sin(2 * np.pi * 20 * np.arange(1024) / 1000)).astype(np.int64)
    t, x, y, p = regular()
    result = realism.in_motion(t, x, y, p, FRAME, counts)
    assert result["pixels_with_events_share"] == pytest.approx(2 / 32)
    assert result["interval_us_median"] == 10_000
    assert result["band_10_30_hz"] > 0.95
    assert sum(value for name, value in result.items() if name.startswith("band_")) == pytest.approx(1.0)


def test_without_events() -> None:
    """Assert that figures which do not exist are NaN, without a warning."""
    nothing = tuple(np.empty(0, kind) for kind in (np.int64, np.uint16, np.uint16, np.uint8))
    result = realism.at_rest(*nothing, FRAME, 10**6)
    assert result["hot_pixels"] == 0.0 and result["ordinary_hz"] == 0.0
    assert all(np.isnan(value) for name, value in result.items() if "interval" in name or "share" in name)
    moving = realism.in_motion(*nothing, FRAME, np.empty(0, np.int64))
    assert np.isnan(moving["events_a_slice"]) and np.isnan(moving["band_3_10_hz"])


def test_largest_gap() -> None:
    """Assert the distance of two samples: 0 of equal ones, 1 of separate ones, a half of a shifted half."""
    first = np.arange(100)
    assert realism.largest_gap(first, first) == 0.0
    assert realism.largest_gap(first, first + 1000) == 1.0
    assert realism.largest_gap(first, first + 50) == 0.5
    assert np.isnan(realism.largest_gap(first, first[:0]))
