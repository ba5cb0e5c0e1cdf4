"""scripts/grip_trials.py: what a seed draws, and that rows are not made twice; scripts/grip_oracle.py."""

import importlib
import itertools
import json
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector
from tests.quick import few

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.fixture
def trials(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The script as a module."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    return importlib.import_module("grip_trials")


def test_a_seed_is_a_grasp(trials: Any) -> None:
    """Assert that a seed draws the same grasp again, within the ranges that are told, and another seed another."""
    for seed in (0, 3):
        one = trials.drawn(seed)
        assert one == trials.drawn(seed)
        touched = one.plan.touched
        assert trials.MASS_G[0] <= touched.mass_g <= trials.MASS_G[1]
        assert abs(touched.lever_mm) <= trials.LEVER_MM
        assert 0 <= one.latency_ms <= trials.LATENCY_MS
        devices = one.rig(camera=False)
        simulation = devices.gripper.simulation
        assert trials.FRICTION[0] <= simulation.sampled.static_friction <= trials.FRICTION[1] + 1e-9
        assert simulation.holding_n <= trials.MOST_HOLDING_N
        devices.close()
    assert trials.drawn(0) != trials.drawn(3)


def test_rows_are_not_made_twice(trials: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a grasp whose row is there is not played, and that the row of another is added."""
    asked = []

    def play(law: str, seed: int, what: Any) -> tuple[dict, dict]:
        asked.append(seed)
        return {}, {"law": law, "seed": seed, **what.row(), "failure": ""}

    monkeypatch.setattr(trials, "play", play)
    (tmp_path / "fixed-9.jsonl").write_text(json.dumps({"law": "fixed:9", "seed": 1}) + "\n")
    rows = trials.played("fixed:9", range(3), tmp_path, 1)
    assert asked == [0, 2]
    assert sorted(row["seed"] for row in rows) == [0, 1, 2]
    assert len((tmp_path / "fixed-9.jsonl").read_text().splitlines()) == 3


def test_the_oracle_holds_by_its_margin(trials: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a light object is kept with little more than 1.5 times what just holds it; margins are refused."""
    monkeypatch.setattr(trials, "LIFT_S", 4.0)
    monkeypatch.setattr(trials, "BALANCE_S", 0.5)
    _, row = trials.play("oracle:1.5", 23)
    assert row["balanced"]
    assert row["over_holding_end"] == pytest.approx(1.5, rel=0.1)
    assert row["force_end_n"] == pytest.approx(1.5 * row["holding_end_n"], rel=0.1)
    with pytest.raises(ValueError, match="margin"):
        trials.grip_oracle.of_name("oracle:0.5", None)


def test_rows_say_what_was_asked(trials: Any) -> None:
    """Assert that margin, model and threshold are flags of `grasp`, in the name of the file and in each row."""
    asked = trials.Asked(1.6, Path("a") / "b.model.h5", false_alarms_per_min=4.0)
    assert asked.flags() == {"grip_margin": 1.6, "model": Path("a") / "b.model.h5", "false_alarms_per_min": 4.0}
    assert asked.file_name("fixed:9") == "fixed-9-margin-1.6-model-b.model.h5-false-alarms-per-min-4.jsonl"
    assert trials.Asked(margin=1.6).file_name("load-proportional") == "load-proportional-margin-1.6.jsonl"
    assert trials.Asked().file_name("paper") == "paper.jsonl"
    rows = [{"law": "paper", **trials.Asked().row()}, {"law": "paper", **asked.row()}]
    assert rows[1]["model"] == "b.model.h5"


@pytest.mark.slow
@pytest.mark.parametrize("cries", few([False, True], False))
def test_the_grip_is_safe_without_a_detector(trials: Any, monkeypatch: pytest.MonkeyPatch, cries: bool) -> None:
    """Assert that an object is lifted and held where no slip is ever told, and where it always is, within a bound."""
    counts = itertools.count(0, int(cries))
    monkeypatch.setattr(OnlineSlipDetector, "count", property(lambda detector: next(counts)))
    monkeypatch.setattr(trials, "LIFT_S", 3.5)
    monkeypatch.setattr(trials, "BALANCE_S", 0.5)
    arrays, row = trials.play("load-proportional", 116)
    assert row["balanced"], row["failure"]
    assert (arrays["control/slip"][10:] == cries).all()
    assert 1.0 < row["over_holding_end"] < (12.0 if cries else 4.0)
