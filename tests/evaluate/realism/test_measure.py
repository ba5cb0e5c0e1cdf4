"""evaluate realism: the distance of a simulated recording from a real one, beside that of the real one's halves."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.record import Record
from evetac_cli.errors import InputError
from evetac_cli.evaluate.realism import EvaluateRealism
from evetac_cli.evaluate.realism import measure as realism
from evetac_cli.events import Events
from evetac_cli.jobs import Outcome
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.sim.setup.tables import as_table
from evetac_cli.text_files import as_toml
from evetac_cli.trials import record
from tests.make import event_arrays, run_stage, write_recording


def resting(folder: Path, sensor: str, seed: int) -> Path:
    chosen = Record(scene="rest", sensor=sensor, seed=seed)
    return run_stage(record, [], chosen, folder / f"{Path(sensor).stem}-{seed}.recording.h5")[0]


def imported(path: Path, events: Events, slices: int, frame_px: tuple[int, int] = (640, 480)) -> Path:
    return write_recording(path, event_arrays(events, slices, frame_px), source=path.name)


def compared(real: Path, simulated: Path, out: Path) -> tuple[dict[tuple[str, str], dict[str, Any]], Outcome]:
    _, outcome = run_stage(realism, [real, simulated], EvaluateRealism(), out)
    return {(row["phase"], row["figure"]): row for row in outcome.rows}, outcome


@pytest.fixture(scope="module")
def same(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two recordings of one noisy sensor at rest."""
    folder = tmp_path_factory.mktemp("same")
    return resting(folder, "bare-dvxplorer", 0), resting(folder, "bare-dvxplorer", 1)


@pytest.mark.slow
def test_one_sensor_twice(same: tuple[Path, Path], tmp_path: Path) -> None:
    """Assert that two recordings of one sensor differ by little, and about as its halves do; with a picture."""
    rows, outcome = compared(*same, tmp_path)
    assert {phase for phase, _ in rows} == {"rest"}
    for name in ("events_a_slice", "on_share", "hot_pixels", "hot_event_share", "hot_interval_us_median"):
        assert rows["rest", name]["distance"] < 0.05, name
        assert rows["rest", name]["distance_of_halves"] < 0.07, name
    gap = rows["rest", "hot_interval_us, distribution"]
    assert gap["distance"] < 0.02 and gap["measure"] == "largest gap of cumulative shares"
    assert outcome.simulated and outcome.summary["figures"] == len(rows)
    picture = Path(outcome.summary["plot"])
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_another_sensor_is_far(same: tuple[Path, Path], tmp_path: Path) -> None:
    """Assert that a sensor with another polarity, and twice the noise of ordinary pixels, is told by just that."""
    row = as_table(one_sensor("bare-dvxplorer"))
    other = tmp_path / "other.toml"
    other.write_text(as_toml({**row, "noise_on_share": 0.8, "noise_hz": 2 * row["noise_hz"]}))
    rows, _ = compared(same[0], resting(tmp_path, str(other), 2), tmp_path)
    assert rows["rest", "ordinary_hz"]["distance"] == pytest.approx(1.0, abs=0.1)
    assert rows["rest", "ordinary_on_share"]["distance"] == pytest.approx(0.6, abs=0.05)
    assert rows["rest", "hot_pixels"]["distance"] < 0.05


@pytest.mark.slow
def test_motion(tmp_path: Path) -> None:
    """Assert that bursts of events are a phase of their own, whose rate and spectrum are compared."""

    def waved(seed: int, rate: float, wave_hz: float) -> tuple[Events, int]:
        rng = np.random.default_rng(seed)
        time_ms = np.arange(2000)
        wave = 1.0 + 0.8 * np.sin(2 * np.pi * wave_hz * time_ms / 1000)
        counts = rng.poisson(np.where(time_ms < 800, 2.0, rate * wave))
        t = np.concatenate([1000 * k + np.sort(rng.integers(0, 1000, count)) for k, count in enumerate(counts)])
        xy = rng.integers(0, (640, 480), (len(t), 2)).astype(np.uint16)
        return Events(t, xy[:, 0].copy(), xy[:, 1].copy(), (rng.random(len(t)) < 0.5).astype(np.uint8)), 2000

    real = imported(tmp_path / "real.recording.h5", *waved(0, 200.0, 20.0))
    rows, outcome = compared(real, imported(tmp_path / "like.recording.h5", *waved(1, 200.0, 20.0)), tmp_path)
    assert {phase for phase, _ in rows} == {"rest", "motion"} and not outcome.simulated
    assert rows["motion", "events_a_slice"]["distance"] < 0.05
    assert rows["motion", "band_10_30_hz"]["distance"] < 0.1
    rows, _ = compared(real, imported(tmp_path / "unlike.recording.h5", *waved(2, 300.0, 60.0)), tmp_path / "u")
    assert rows["motion", "events_a_slice"]["distance"] == pytest.approx(0.5, abs=0.05)
    assert rows["motion", "band_10_30_hz"]["distance"] > 0.8


@pytest.mark.slow
def test_windows_are_told_apart(tmp_path: Path) -> None:
    """Assert that half seconds of another polarity are told apart, those of one camera are not, and what stands beside.

    Beside the AUC stands that of every other second of the first recording, or that of `--same`.
    """

    def noisy(seed: int, on_share: float) -> Path:
        rng = np.random.default_rng(seed)
        t_us = np.sort(rng.integers(0, 10_000_000, 20_000))
        x, y = rng.integers(0, (640, 480), (len(t_us), 2)).T.astype(np.uint16)
        events = Events(t_us, x, y, (rng.random(len(t_us)) < on_share).astype(np.uint8))
        return imported(tmp_path / f"{seed}.recording.h5", events, 10_000)

    first, second, other = noisy(0, 0.5), noisy(1, 0.5), noisy(2, 0.6)
    apart = {}
    for name, simulated, same in (("like", second, None), ("unlike", other, second)):
        asked = EvaluateRealism(same=same)
        _, outcome = run_stage(realism, [first, simulated], asked, tmp_path / f"{name}.realism.report.h5")
        rows = outcome.rows
        (apart[name],) = [row for row in rows if row["measure"] == "AUC of held-out windows"]
        assert outcome.summary["auc"] == apart[name]["distance"]
        assert outcome.summary["auc_of_same" if same else "auc_of_halves"] == apart[name]["distance_of_halves"]
        assert apart[name]["real"] == apart[name]["simulated"] == 20
        assert outcome.summary["windows"] == outcome.summary["windows_simulated"] == 20
        _, (near, *_, separability) = realism.for_people(rows, asked)
        assert near.startswith(f"{outcome.summary['figures_within_10_percent']} of ")
        assert separability.startswith("20 real and 20 simulated windows: ")
        assert f"AUC of {outcome.summary['auc']:.2f}" in separability
    assert apart["like"]["distance"] < 0.85 < 0.95 < apart["unlike"]["distance"]
    assert apart["unlike"]["distance_of_halves"] == apart["like"]["distance"]


def test_recordings_without_events(tmp_path: Path) -> None:
    """Assert that rests without an event are compared as far as that goes, drawn, and too short to be told apart."""
    nothing = Events(np.empty(0, np.int64), *(np.empty(0, np.uint16),) * 2, np.empty(0, np.uint8))
    paths = [tmp_path / f"{name}.recording.h5" for name in "ab"]
    rows, outcome = compared(*(imported(path, nothing, 1000) for path in paths), tmp_path)
    assert rows["rest", "events_a_slice"]["real"] == rows["rest", "events_a_slice"]["simulated"] == 0
    assert rows["rest", "on_share"]["distance"] is None
    assert outcome.summary["auc"] is outcome.summary["auc_of_halves"] is outcome.summary["windows"] is None
    unknown = sum(row["distance"] is None for row in outcome.rows)
    assert outcome.summary["figures_unknown"] == unknown == len(outcome.rows) - outcome.summary["figures"] > 0
    known = sum(None not in (row["distance"], row["distance_of_halves"]) for row in outcome.rows)
    assert outcome.summary["figures_with_halves"] == known
    _, lines = realism.for_people(outcome.rows, EvaluateRealism())
    assert f" of {known} differ no more" in lines[0]
    assert lines[1].startswith(f"{unknown} figures are left out") and lines[2].startswith("No AUC: ")


def test_a_slice_with_too_many_events(same: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a phase whose first slice has more events than are looked at is none."""
    monkeypatch.setattr(realism, "MOST_EVENTS", 10)
    with pytest.raises(InputError, match="no phase"):
        compared(*same, tmp_path)
