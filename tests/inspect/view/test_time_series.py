"""Series and stretches of slip: decimated without losing extremes, and the output of a model."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.inspect.view import collect_view, time_series
from evetac_cli.inspect.view.trial_files import open_trial
from evetac_cli.kernels.sensitivity import UNKNOWN
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.params.inspection import View
from tests.inspect.view.trials import SLICES


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 40_000), st.integers(0, 2**32 - 1), st.booleans())
def test_extremes_are_kept(length: int, seed: int, holes: bool) -> None:
    """Assert that decimated series are values of the series in order of time, few, and hold both extremes."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(length, 2)).astype(np.float32)
    if holes:
        rows[rng.random(rows.shape) < 0.3] = np.nan
        rows[rng.random(rows.shape) < 0.01] = np.inf
    read_rows: list[int] = []

    def read(start: int, stop: int) -> np.ndarray:
        read_rows.append(stop - start)
        return rows[start:stop]

    for column, (at, value) in zip(rows.T, time_series.extremes(length, read), strict=True):
        assert len(at) == len(value) <= 2 * time_series.BINS
        assert (np.diff(at) > 0).all()
        finite = np.isfinite(value)
        np.testing.assert_array_equal(value[finite], column[at][finite])
        assert not np.isfinite(column[at][~finite]).any()
        known = column[np.isfinite(column)]
        if len(known):
            assert (np.nanmin(value), np.nanmax(value)) == (known.min(), known.max())
    assert max(read_rows) <= time_series.BLOCK_ROWS


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 20_000), st.integers(0, 2**32 - 1))
def test_no_slip_is_lost(length: int, seed: int) -> None:
    """Assert that every slice of slip lies in a stretch of slip, exactly where there are no more slices than bins."""
    rng = np.random.default_rng(seed)
    states = rng.choice(np.array([-1, 0, 1], np.int8), length, p=[0.3, 0.6, 0.1])
    states = np.repeat(states, 3)[:length]
    slip, unknown = time_series.stretches(length, lambda first, last: states[first:last, None])
    covered = np.zeros(length, np.int8)
    for value, rows in ((1, slip), (-1, unknown)):
        for first, last in rows:
            assert first < last
            assert (covered[first:last] == 0).all()
            covered[first:last] = value
    assert (covered[states == 1] == 1).all()
    if length <= time_series.BINS:
        np.testing.assert_array_equal(covered, states)


def test_model_output(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a model named beside features gives a series, a lane and an onset, the same in blocks as at once."""

    class Fake:
        architecture = ARCHITECTURES["hist10"]

        def over(self, series: np.ndarray, first: int) -> np.ndarray:
            mean = np.convolve(series[:, 0, 0], np.full(10, 0.1), "valid")
            return np.concatenate((np.full(min(9, len(series)), np.nan), mean)).astype(np.float32)

    monkeypatch.setattr("evetac_cli.stages.slip_detectors.load_detector", lambda model: Fake())
    displacement = np.linspace(0, 1, SLICES, dtype=np.float32)[:, None]
    features = SimpleNamespace(
        length=lambda path: SLICES,
        read=lambda path, start=0, stop=None: displacement[start:stop],
        has=lambda path: False,
        sensitivity=UNKNOWN,
    )
    model = SimpleNamespace(read=lambda path: 0.5)
    with open_trial([trial]) as real:
        real.features, real.model = features, model  # type: ignore[assignment]
        real_files = [file for file in real.files if file not in (features, model)]
        monkeypatch.setattr(type(real), "files", real_files)
        whole = collect_view(real, View(), lambda done, total: None)
        monkeypatch.setattr(time_series, "BLOCK_ROWS", 7)
        part = time_series.model_output(real, (40, 90))
    (panel,) = [panel for panel in whole.panels if panel.title == "Slip probability, model"]
    lane = whole.lanes[-1]
    np.testing.assert_allclose(part, panel.lines[0].value[40:90], rtol=1e-6)
    expected = int(np.flatnonzero(panel.lines[0].value >= 0.5)[0])
    assert whole.onsets["model"] == expected
    assert (lane.slip, lane.unknown) == ([(expected / 1000, 0.3)], [(0.0, 0.009)])
    assert panel.levels == {"threshold": 0.5}
