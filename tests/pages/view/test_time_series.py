"""Series and stretches of slip: decimated without losing extremes, and the output of a model."""

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.commands.view import View
from evetac_cli.kernels.slip.alarms import ALARM_SLICES
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, UNKNOWN_SENSITIVITY
from evetac_cli.pages.view import collect_view, time_series
from evetac_cli.pages.view.trial_files import open_trial
from evetac_cli.pages.view.view_data import Panel, ViewData
from evetac_cli.resources import MODEL
from evetac_cli.store.recordings.read import open_recording
from tests.conftest import Made
from tests.pages.view.trials import ONSET, SLICES, moving, shown, write_labels, write_touch, write_tracks


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

        def probability(self, batch: np.ndarray) -> np.ndarray:
            return batch[:, 0, :10].mean(axis=1)

    monkeypatch.setattr("evetac_cli.stages.slip_detectors.load_detector", lambda model: Fake())
    displacement = np.linspace(0, 1, SLICES, dtype=np.float32)[:, None]
    features = SimpleNamespace(
        length=lambda path: SLICES,
        read=lambda path, start=0, stop=None: displacement[start:stop],
        has=lambda path: False,
        sensitivity=UNKNOWN_SENSITIVITY,
    )
    model = SimpleNamespace(read=lambda path: 0.5)
    with open_trial([trial]) as real:
        real.model_input, real.model = features, model  # type: ignore[assignment]
        real_files = [file for file in real.files if file is not model]
        monkeypatch.setattr(type(real), "files", real_files)
        whole = collect_view(real, View(), lambda done, total: None)
        monkeypatch.setattr(time_series, "BLOCK_ROWS", 7)
        part = time_series.model_output(real, (40, 90))
    (panel,) = [panel for panel in whole.panels if panel.title == "Slip probability, model"]
    lane = whole.lanes[-1]
    np.testing.assert_allclose(part, panel.lines[0].value[40:90], rtol=1e-6)
    expected = int(np.flatnonzero(panel.lines[0].value >= 0.5)[ALARM_SLICES - 1])
    assert whole.onsets["model"] == expected
    assert (lane.slip, lane.unknown) == ([(expected / 1000, 0.3)], [(0.0, 0.009)])
    assert panel.levels == {"threshold": 0.5}


def panel_of(data: ViewData, title: str) -> Panel:
    """The panel whose title begins so."""
    (panel,) = [panel for panel in data.panels if panel.title.startswith(title)]
    return panel


@pytest.mark.parametrize(
    ("method", "after", "onset", "words"),
    [
        (
            {"method": "event-flow", "slip_distance_px": 0.3},
            12_428.0,
            ONSET,
            "slide of more than 0.3 px",
        ),
        ({"method": "event-flow", "slip_distance_px": 1.5}, 640.0, ONSET - 40, "more than 1.5 px"),
        ({"method": "dis", "threshold_px": 12.0, "look_ahead_ms": 4}, 25.0, ONSET, "12 px"),
    ],
)
def test_flow_is_no_larger_than_it_means(
    trial: Path, method: dict[str, Any], after: float, onset: int, words: str
) -> None:
    """Assert that the axis ends near the limit, however far the flow runs away after the onset, that what labels do not
    examine is another line, and that words say what is summed.
    """
    with open_recording(trial) as recording:
        header = recording.header
    flow = np.full(SLICES, -0.003, np.float32)
    flow[onset : onset + 20] = np.linspace(0.1, 3.0, 20)
    flow[onset + 20 :] = after
    write_labels(trial.with_name("a.labels.h5"), header, onset, onset + 20, relative_flow_px=flow, **method)
    panel = panel_of(shown(trial, images=1), "Flow that labels slip")
    assert panel.ends is not None
    low, high = panel.ends
    (limit,) = panel.levels.values()
    assert low < 0.02 and limit <= high / 3 and high <= 100  # at most four decades
    examined, rest = panel.lines
    assert (examined.name, rest.name) == ("window against gel", "not examined")
    assert np.nanmax(examined.value) == pytest.approx(3.0) and np.isnan(examined.value[:50]).all()
    assert np.nanmax(rest.value) == pytest.approx(after) and np.isnan(rest.value[50 : onset + 20]).all()
    assert words in panel.caption
    assert ("lost" in panel.caption) == (after > high)


TOUCH = {
    "shear_n": np.stack((np.full(SLICES, 3.0), np.linspace(0.0, 4.0, SLICES)), axis=1).astype(np.float32),
    "shear_sd_n": np.stack((np.full(SLICES, 0.2), np.linspace(0.1, 0.5, SLICES)), axis=1).astype(np.float32),
    "shear_since_n": np.stack((np.linspace(0.0, 2.0, SLICES), np.full(SLICES, 1.0)), axis=1).astype(np.float32),
    "shear_since_sd_n": np.stack((np.linspace(0.1, 0.3, SLICES), np.full(SLICES, 0.2)), axis=1).astype(np.float32),
    "normal_n": np.linspace(0.0, 5.0, SLICES).astype(np.float32),
    "normal_sd_n": np.linspace(0.3, 2.5, SLICES).astype(np.float32),
    "torsion_n_mm": np.linspace(-3.0, 5.0, SLICES).astype(np.float32),
    "torsion_sd_n_mm": np.linspace(0.3, 2.5, SLICES).astype(np.float32),
    "area_mm2": np.linspace(0.0, 50.0, SLICES).astype(np.float32),
    "area_sd_mm2": np.linspace(0.3, 2.5, SLICES).astype(np.float32),
    "sticking_share": np.linspace(1.0, 0.1, SLICES).astype(np.float32),
    "sticking_share_sd": np.linspace(0.01, 0.1, SLICES).astype(np.float32),
}
DRAWN = {  # panel -> name of each line, and the dataset that it is of
    "Force on the gel": {"normal": "normal_n", "shear": "shear_n", "shear since rest": "shear_since_n"},
    "Torsion": {"torsion": "torsion_n_mm"},
    "Area of contact": {"area": "area_mm2"},
    "Share of the contact that sticks": {"sticks": "sticking_share"},
}


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        ({"known": {"mm_per_px": 0.03}}, "stiffness of this gel is not known"),
        ({"known": {"shear_modulus_pa": 5e4}}, "stiffness of this gel is taken as known"),
        ({"adapted": True}, "adapted to this sensor"),
    ],
)
@pytest.mark.parametrize("bins", [3000, 20])
def test_touch_has_its_deviation(
    trial: Path, chosen: dict[str, Any], words: str, bins: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that all that is estimated has the standard deviation of the slices that are drawn, that no band goes
    below 0 but torsion's, and that words say how well the gel is known.
    """
    monkeypatch.setattr(time_series, "BINS", bins)
    monkeypatch.setattr(time_series, "BLOCK_ROWS", 64)
    unknown = {name: values.copy() for name, values in TOUCH.items()}
    for values in unknown.values():
        values[100:110] = np.nan  # too few dots are tracked
    write_touch(trial, unknown, **chosen)
    data = shown(trial, images=1)
    assert words in panel_of(data, "Force on the gel, estimated").caption
    for title, names in DRAWN.items():
        lines = {line.name: line for line in panel_of(data, f"{title}, estimated").lines}
        assert list(lines) == list(names)
        for name, dataset in names.items():
            line, value, sd = lines[name], unknown[dataset], unknown[_sd_of(dataset)]
            if value.ndim == 2:
                value, sd = np.hypot(*value.T), sd.max(axis=1)
            at = np.rint(line.t_s * 1000).astype(int)
            assert line.sd is not None and len(at) <= 2 * bins
            np.testing.assert_allclose(line.value, value[at], rtol=1e-6)
            np.testing.assert_allclose(line.sd, sd[at], rtol=1e-6)
            low, high = line.band
            np.testing.assert_allclose(high, (value + sd)[at], rtol=1e-6)
            least = -np.inf if name == "torsion" else 0
            np.testing.assert_allclose(low, np.maximum(value - sd, least)[at], rtol=1e-5, atol=1e-7)


def _sd_of(dataset: str) -> str:
    """The dataset of a dataset's deviation, whose unit, if any, stays at the end."""
    for unit in ("_n_mm", "_mm2", "_n"):
        if dataset.endswith(unit):
            return f"{dataset.removesuffix(unit)}_sd{unit}"
    return f"{dataset}_sd"


@pytest.mark.parametrize("away_px", [5.0, 40.0, 600.0])
def test_lost_dots_are_no_displacement(trial: Path, away_px: float) -> None:
    """Assert that a dot counts while it is tracked alone, in the mean as in the farthest."""
    with open_recording(trial) as recording:
        header = recording.header
    dots, lost = moving(), np.zeros((SLICES, 6), np.uint8)
    dots[100:, 2] += away_px
    lost[100:, 2] = 1
    lost[250:] = 1
    write_tracks(trial.with_name("a.tracks.h5"), header, dots, lost)
    panel = panel_of(shown(trial, images=1), "Dots, distance from rest")
    for line in panel.lines:
        np.testing.assert_allclose(line.value[:250], np.linspace(0, 4, SLICES)[:250], atol=1e-5)
        assert np.isnan(line.value[250:]).all()


@pytest.mark.parametrize("with_tracks", [False, True])
def test_missing_features_are_computed(made: Made, tmp_path: Path, with_tracks: bool) -> None:
    """Assert that a model has the same probability without a features file as with it, and that none is left behind."""
    beside = Path(shutil.copy(made.recordings[0], tmp_path))
    if with_tracks:
        shutil.copy(made.beside(made.recordings[0], "tracks"), tmp_path)
    before = sorted(tmp_path.iterdir())
    with open_trial([made.recordings[0], made.model]) as stored, open_trial([beside, made.model]) as computed:
        assert stored.notes == []
        assert computed.features is None and "were computed as by evetac" in computed.notes[0]
        span = (0, stored.slices)
        of_file, of_recording = (time_series.model_output(one, span) for one in (stored, computed))
    assert of_file is not None and of_recording is not None and np.isfinite(of_recording).any()
    np.testing.assert_array_equal(of_recording, of_file)
    assert sorted(tmp_path.iterdir()) == before


def test_a_network_with_memory_sees_all_before_the_span(made: Made) -> None:
    """Assert that it has the same probability in a part, from features that were computed for it."""
    with open_trial([made.recordings[0], MODEL]) as trial:
        assert trial.features is not None and "were computed as by evetac" in trial.notes[0]
        whole, part = (time_series.model_output(trial, span) for span in ((0, trial.slices), (103, 200)))
    assert whole is not None and np.isfinite(whole[103:200]).any()
    np.testing.assert_array_equal(part, whole[103:200])
