"""evaluate vibration: recordings without dots, with truth, of noise, too short; what the rows say; memory."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.record import Record
from evetac_cli.evaluate.vibration import SUBJECT, EvaluateVibration
from evetac_cli.evaluate.vibration import measure as vibration
from evetac_cli.events import SLICE_US, Events
from evetac_cli.jobs import Outcome
from evetac_cli.trials import record
from tests.make import event_arrays, run_stage, truth_arrays, write_recording

FRAME_PX = (64, 48)


def swing(
    folder: Path,
    tone_hz: float,
    *,
    seconds: float = 2.0,
    events_a_s: int = 20_000,
    silent_s: float = 0.0,
    truth: bool = False,
    name: str = "a",
) -> Path:
    """A recording without dots: pixels on two sides of rims that swing at a tone, and noise; no tone is noise alone.

    Events are as frequent as the rims are fast, so that their number beats at twice the tone.
    """
    rng = np.random.default_rng(round(10 * tone_hz))
    count = round(events_a_s * seconds)
    time_s = np.sort(rng.uniform(0.0, seconds, count))
    x_px, y_px = (rng.integers(0, most, count).astype(np.uint16) for most in FRAME_PX)
    speed = np.where(time_s >= silent_s, np.cos(2 * np.pi * tone_hz * time_s), 0.0) if tone_hz else np.zeros(count)
    side = np.where(x_px // 16 % 2 == 0, 1.0, -1.0)
    lit = (side * speed > 0) if tone_hz else rng.random(count) < 0.5
    seen = rng.random(count) < 0.1 + 0.9 * np.abs(speed)
    t_us = np.floor(time_s * 1e6).astype(np.int64)[seen]
    slices = round(seconds * 1000)
    brighter = np.where(rng.random(count) < 0.3, rng.random(count) < 0.5, lit)
    events = Events(t_us, x_px[seen], y_px[seen], brighter.astype(np.uint8)[seen])
    arrays = event_arrays(events, slices, FRAME_PX)
    assert t_us[-1] < slices * SLICE_US
    if truth:
        arrays |= _truth(slices, tone_hz, silent_s)
    return write_recording(folder / f"{name}.recording.h5", arrays, simulated=truth)


def _truth(slices: int, tone_hz: float, silent_s: float) -> dict[str, Any]:
    """The truth of a tone, and of nothing else."""
    sounds = (np.arange(slices) + 1) / 1000 > silent_s
    return truth_arrays(np.zeros((slices, 1, 2))) | {"truth/tone_hz": np.where(sounds, tone_hz, 0.0).astype(np.float32)}


def evaluated(path: Path | list[Path], out: Path | None = None, **chosen: Any) -> Outcome:
    params = EvaluateVibration(**chosen)
    return run_stage(vibration, [path] if isinstance(path, Path) else path, params, out, force=True)[1]


def test_the_three_strongest_frequencies() -> None:
    """Assert that they are those of the largest amplitudes above the lowest frequency, and none where nothing moves."""
    time_s = np.arange(1000) / 1000
    waves = [(20.0, 90), (50.0, 40), (100.0, 30), (200.0, 20), (300.0, 10)]
    counts = np.round(100 + sum(size * np.cos(2 * np.pi * hz * time_s) for hz, size in waves)).astype(np.int64)
    assert vibration._strongest_hz(counts, EvaluateVibration()) == [50.0, 100.0, 200.0]
    assert vibration._strongest_hz(np.full(1000, 3), EvaluateVibration()) == []


def test_a_tone_without_dots(tmp_path: Path) -> None:
    """Assert that the default finds the tone where the paper's method takes twice of it, and that rows say so."""
    outcome = evaluated(swing(tmp_path, 140.5), windows="1,0.25", true_hz=140.5)
    first, second, *windows = outcome.rows
    assert (first["method"], second["method"]) == ("default", "paper")
    assert first["frequency_hz"] == pytest.approx(140.5, abs=4 * first["uncertainty_hz"] + 1e-3)
    assert 0 < first["uncertainty_hz"] < 0.05
    assert first["correct"] and not second["correct"]
    assert second["frequency_hz"] == pytest.approx(281.0, abs=0.5)
    reported = [(row["method"], row["window_s"], row["windows"]) for row in windows]
    assert reported == [("default", 1.0, 2), ("default", 0.25, 8), ("paper", 1.0, 2), ("paper", 0.25, 8)]
    assert [row["share"] for row in windows[:3]] == [1.0, 1.0, 0.0]
    assert [row["among_three"] is None for row in windows] == [True, True, False, False]
    assert windows[2]["among_three_share"] == windows[2]["among_three"] / 2
    assert (
        windows[2]["windows_at_double_tone"] == 2
        and windows[2]["windows_at_half_tone"] == windows[2]["windows_at_other_frequency"] == 0
    )
    assert outcome.summary["default_share_1_s"] == 1.0
    assert not outcome.simulated


def test_recordings_shorter_than_a_window_are_counted(tmp_path: Path) -> None:
    """Assert that a share says how many windows and recordings are behind it, and how many are too short."""
    paths = [swing(tmp_path, 140.5, seconds=seconds, name=f"{seconds}") for seconds in (2.0, 0.5)]
    outcome = evaluated(paths, tmp_path / "both.report.h5", windows="1,0.25", true_hz=140.5, preset="paper")
    counts = [
        outcome.summary[f"paper_{what}_{length}_s"] for length in ("1", "0.25") for what in ("windows", "recordings")
    ]
    assert counts == [2, 1, 10, 2]
    assert outcome.summary["recordings_with_tone"] == outcome.summary["recordings"] == 2
    _, lines = vibration.for_people(outcome.rows, EvaluateVibration(windows="1,0.25"))
    short = "Windows of 1 s: 1 of 2 recordings are left out, because they are shorter."
    assert lines[-1] == short and len(lines) == 2
    on_page = SUBJECT.tables[0].rows(outcome.rows, outcome.summary)
    assert [(row["window_s"], row["recordings"], row["windows"]) for row in on_page] == [(1, 1, 2), (0.25, 2, 10)]


def test_the_papers_preset(tmp_path: Path) -> None:
    """Assert that the preset `paper` gives the paper's rows alone, with the paper's share beside them."""
    outcome = evaluated(swing(tmp_path, 100.0), preset="paper", windows="2,1", true_hz=100.0)
    assert {row["method"] for row in outcome.rows} == {"paper"}
    assert [row["paper_share"] for row in outcome.rows[1:]] == [0.98, 0.96]
    assert outcome.summary["published_share_1_s"] == 0.924


def test_noise_is_no_vibration(tmp_path: Path) -> None:
    """Assert that noise alone has no frequency, in the whole recording and in windows, without a tone to compare."""
    rows = evaluated(swing(tmp_path, 0.0), windows="1").rows
    assert rows[0]["method"] == "default"
    assert rows[0]["frequency_hz"] is None and rows[0]["correct"] is None
    assert rows[2]["windows_without_vibration"] == rows[2]["windows"] == 2
    assert "share" not in rows[2]


def test_a_real_recording_of_noise(tmp_path: Path, outside_file: Callable[[str], Path]) -> None:
    """Assert that a real camera's noise, with its hot pixels, is no vibration, in any window."""
    params = Record(source=outside_file("dvxplorer_static_noise.aedat4"))
    output, _ = run_stage(record, [], params, tmp_path)
    rows = evaluated(output, windows="2,1,0.25").rows
    assert rows[0]["frequency_hz"] is None
    assert all(row["windows_without_vibration"] == row["windows"] for row in rows[2:] if row["method"] == "default")


def test_slices_are_those_in_which_the_tone_sounds(tmp_path: Path) -> None:
    """Assert that windows lie where the tone sounds, and that it is what is expected, unless one is given."""
    path = swing(tmp_path, 120.0, seconds=2.6, silent_s=0.6, truth=True)
    outcome = evaluated(path, windows="1")
    assert outcome.simulated
    assert outcome.rows[0]["seconds"] == 2.0
    assert outcome.rows[0]["expected_hz"] == 120.0 and outcome.rows[0]["correct"]
    assert outcome.rows[2]["correct"] == outcome.rows[2]["windows"] == 2
    assert evaluated(path, windows="1", true_hz=240.0).rows[2]["windows_at_half_tone"] == 2


def test_beyond_the_band(tmp_path: Path) -> None:
    """Assert that a tone beyond half the rate is not taken for another, and is found with a higher rate."""
    path = swing(tmp_path, 1210.0)
    row = evaluated(path, windows="1").rows[0]
    assert row["frequency_hz"] is None
    assert row["line_above_band_hz"] == pytest.approx(1210.0, abs=0.1)
    row = evaluated(path, windows="1", rate=5000).rows[0]
    assert row["frequency_hz"] == pytest.approx(1210.0, abs=0.1)
    assert row["line_above_band_hz"] is None


def test_short_windows_are_judged_by_what_they_resolve(tmp_path: Path) -> None:
    """Assert that a window of 0.25 s, whose frequencies are 4 Hz apart, is right within 2 Hz, and 1 s within 1 Hz."""
    path = swing(tmp_path, 140.0)
    for expected_hz, right in ((141.5, [0.0, 1.0]), (143.0, [0.0, 0.0])):
        rows = evaluated(path, windows="1,0.25", true_hz=expected_hz, preset="default").rows[2:4]
        assert [row["tolerance_hz"] for row in rows] == [1.0, 2.0]
        assert [row["share"] for row in rows] == right
    wider = evaluated(path, windows="1,0.25", true_hz=142.5, tolerance_hz=3.0).rows[2:4]
    assert [row["share"] for row in wider] == [1.0, 1.0]


def test_the_picture_shows_each_tone_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that of many recordings of a tone the first alone is drawn, and each whose tone is not known."""
    drawn: list[str] = []
    monkeypatch.setattr(vibration, "_draw", lambda figure, spectra, *rest, **more: drawn.extend(n for n, _ in spectra))
    paths = [swing(tmp_path, hz, truth=True, name=name) for name, hz in (("a", 90.0), ("b", 90.0), ("c", 120.0))]
    evaluated([*paths, swing(tmp_path, 90.0, name="d")], windows="1")
    assert drawn == [f"{name}.recording.h5" for name in "acd"]


def test_length_costs_no_memory(tmp_path: Path) -> None:
    """Assert that a recording four times as long needs no more memory, but for its counts."""

    def peak(seconds: float) -> int:
        path = swing(tmp_path, 100.0, seconds=seconds, events_a_s=40_000, name=f"long-{seconds}")
        params = EvaluateVibration(windows="1")
        with vibration.open_recording(path) as file:
            tracemalloc.start()
            vibration._survey(file, 0, len(file), [1000], params, lambda done: None)
            _, most = tracemalloc.get_traced_memory()
            tracemalloc.stop()
        return most - round(2 * 8 * 1000 * seconds)  # its counts, int64 at 1000 Hz, in pieces and joined

    peak(1.0)  # compiles
    assert peak(8.0) < 1.1 * peak(2.0)


def test_shorter_than_its_windows(tmp_path: Path) -> None:
    """Assert that a recording shorter than some windows is looked at as a whole, and in those that fit."""
    rows = evaluated(swing(tmp_path, 100.0, seconds=0.7), windows="2,1,0.3").rows
    assert rows[0]["frequency_hz"] == pytest.approx(100.0, abs=0.3)
    assert [row["windows"] for row in rows[2:]] == [2, 2]
