"""scripts/speed/bench.py: what it compares with does the same, and a comparison has the rows that both sides have."""

from pathlib import Path

import numpy as np
import pytest

from evetac_cli.evaluate.cost.tracker import DOTS_PX, rim_events
from evetac_cli.events import Events
from evetac_cli.kernels.tracking import presets, tracker
from scripts.speed import baselines, bench, commands
from scripts.speed.baselines import DenseFrames, NumpyTracker, fastest, gel_camera, seen


def test_dense_frames_make_the_same_events() -> None:
    """Assert that the obvious simulator and our camera make the same events, slice for slice."""
    state = gel_camera()
    frames = DenseFrames(state)
    for slice_ in range(3):
        ours, theirs = seen(state, slice_), frames.slice(slice_)
        assert ours.size > 100
        order = [np.lexsort((events.x, events.y, events.t)) for events in (ours, theirs)]
        for mine, other in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(mine[order[0]], other[order[1]])


def test_the_numpy_tracker_is_the_paper_preset() -> None:
    """Assert that plain numpy moves the dots as the preset `paper` does; ours sums pulls in small units."""
    rng = np.random.default_rng(3)
    state, plain = tracker.start(DOTS_PX, presets.PRESETS["paper"]), NumpyTracker(DOTS_PX)
    for _ in range(20):
        x, y, p = rim_events(rng, 2000)
        tracker.step(state, x, y, p)
        plain.step(Events(np.zeros(len(x), np.int64), x, y, p))
    assert np.abs(plain.dot_xy_px - DOTS_PX).max() > 0.01
    np.testing.assert_allclose(plain.dot_xy_px, state.dot_xy_px, atol=1e-4)


def test_a_row_says_how_much_longer_the_other_way_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the fastest run of each call counts, by what it did."""
    clock = iter([0.0, 4.0, 10.0, 30.0, 30.0, 32.0, 40.0, 80.0])  # two rounds of two calls
    monkeypatch.setattr(baselines.time, "thread_time", lambda: next(clock))
    monkeypatch.setattr(baselines, "REPEATS", 2)
    calls = {"ours": lambda: 2, "other": lambda: 4}
    assert fastest(calls) == {"ours": 1.0, "other": 5.0}


def test_rows_of_both_checkouts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Assert that rows which one of two checkouts lacks are left out, and that the fastest rounds are compared."""
    times = {
        bench.ROOT: iter([{"step": 6.0, "new": 1.0}, {"step": 4.0, "new": 1.0}]),
        tmp_path: iter([{"step": 8.0}, {"step": 9.0}]),
    }
    monkeypatch.setattr(bench, "times_us", lambda code, group: next(times[code]))
    (row,) = bench.against(tmp_path, ["touch"], rounds=2)
    assert row == {"what": "step", "time_us": 4.0, "time_us_base": 8.0, "ratio": 0.5}


def test_commands_of_two_checkouts_take_turns(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Assert that each makes its trial first, that no first run counts, and that the cheapest of the others does."""
    ran: list[tuple[str, str]] = []

    def spent(code: Path, words: str, folder: Path) -> float:
        ran.append((code.name, words.split()[0]))
        return 1.0 if len(ran) % 4 == 2 else 3.0 if code == tmp_path else 2.0

    monkeypatch.setattr(commands, "cpu_s", spent)
    found = commands.cheapest([bench.ROOT, tmp_path], 2, {"info": "info a.recording.h5"})
    made = ["record", "track", "label", "featurize", "predict-touch", "info"]
    assert ran[:12] == [(code.name, words) for code in (bench.ROOT, tmp_path) for words in made]
    assert ran[12:] == [(code.name, "info") for _ in range(3) for code in (bench.ROOT, tmp_path)]
    assert found == {"info": [2.0, 1.0]}
