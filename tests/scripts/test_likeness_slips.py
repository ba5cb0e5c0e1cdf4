"""Scripts of likeness that simulate slips: what is changed, which trials are missing, what their rows say."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import likeness_convergence as convergence
import likeness_grid as grid
import likeness_sensitivity as sensitivity
import likeness_trials as trials
from likeness_trials import SLIP, Task

from evetac_cli.evaluate.likeness.counts import NEVER_MS, THRESHOLDS, SliceCounts
from evetac_cli.sim.setup.plan import Plan, first_plan
from evetac_cli.store.recordings.slip_grid import resolving_mm
from evetac_cli.trials.record import simulated


def as_row(task: Task, **more: Any) -> dict[str, Any]:
    """A row of a slip: loud from its onset on, quiet before it."""
    after_ms = [0 if k < 500 else NEVER_MS for k in THRESHOLDS]
    row = {
        **task.key,
        "record_method": simulated.METHOD,
        "commit": "c",
        "onset_ms": 1000,
        "after_ms": after_ms,
        "loud_ms": [],
        "us_a_slice": 200.0,
    }
    row |= dict.fromkeys(convergence.MEASURES, 10.0) | {"onset_ms": 1000, "slip_half_wavelength_nodes": 6.0}
    return row | more


def constants(plan: Plan) -> dict[str, float]:
    """The constants that are changed, of a plan of the data-rate scene."""
    assert plan.scene.object is not None
    varied = {name: getattr(plan.scene.randomise, name) for name in ("kinetic_share", "memory_um", "pressure_exponent")}
    ends = {f"{name} {end}": value for name, both in varied.items() for end, value in zip("ab", both, strict=True)}
    return ends | {"dot_radius_px": plan.sensor.dot_radius_px, "mass_g": plan.scene.object.mass_g}


@pytest.mark.parametrize("constant", list(sensitivity.WORDS))
def test_one_constant_is_changed(constant: str) -> None:
    """Assert that a setting changes its constant alone, both ends of a range by the same factor."""
    plan = first_plan("data-rate", "1")
    before, after = constants(plan), constants(sensitivity.changed(plan, constant, 1.3))
    assert {name.partition(" ")[0] for name in before if after[name] != before[name]} == {constant}
    for name in before:
        assert after[name] == pytest.approx(before[name] * (1.3 if name.startswith(constant) else 1.0))


def test_a_scene_without_the_constant_is_refused() -> None:
    """Assert that the weight of a scene that names none is not changed in silence."""
    with pytest.raises(ValueError, match="weight"):
        sensitivity.changed(first_plan("slip", "8"), sensitivity.WEIGHT, 1.3)


def test_halves_have_no_object_in_common() -> None:
    """Assert that each object lies in one half, and that both have as many slips."""
    first, second = (set(objects) for objects, _ in sensitivity.HALVES)
    assert not first & second
    assert len({len(objects) * len(seeds) for objects, seeds in sensitivity.HALVES}) == 1
    assert sensitivity.slips_of("mass_g x 1.3") == [] and sensitivity.rates_of("mass_g x 1.3") != []


def test_predictions_of_a_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert the share by a threshold of the other half, medians, means, and that other settings' rows are left out."""
    monkeypatch.setattr(sensitivity, "RATE_SEEDS", (1, 2))
    setting = "memory_um x 0.7"
    early = [-400 if k < 100 else 0 for k in THRESHOLDS]  # right with 100 to 1500 events, not with fewer
    rows = [as_row(task, after_ms=early, half_slips_ms=20.0) for task in sensitivity.slips_of(setting)[:12]]
    rows += [as_row(task, half_slips_ms=40.0) for task in sensitivity.slips_of(setting)[12:]]
    rows[0]["slip_half_wavelength_nodes"] = 3.0
    for task, share in zip(sensitivity.rates_of(setting), (0.01, 0.03), strict=True):
        rows.append({**task.key, "share_whole": share, "share_contact": None, "share_slip": share})
    rows += [as_row(task, half_slips_ms=900.0) for task in sensitivity.slips_of(sensitivity.AS_SET)]
    found = sensitivity.predictions(setting, rows)
    # the second half is right with 25 events, the lowest; with those the first is early: of 24, 12 are right
    assert found["one_threshold_correct"] == 0.5 and (found["slips"], found["rates"]) == (24, 2)
    assert found["best_for_all"] == 1.0  # with 100 events both halves are right
    assert (found["one_threshold_low"], found["one_threshold_high"]) == (25, 100)
    assert found["half_slips_ms"] == 30.0 and found["unresolved"] == 1
    assert found["share_whole"] == 0.02 and found["share_contact"] is None


def test_only_missing_trials_are_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a second run measures what is missing or another record made, and keeps rows as they come."""
    path, tasks = tmp_path / "rows.json", [Task("x", SLIP, number, 1) for number in (1, 2, 3)]
    seen: list[int] = []

    def measured(number: int) -> dict[str, Any]:
        seen.append(number)
        if number == 3:
            raise KeyboardInterrupt
        return {"us_a_slice": 1.0}

    monkeypatch.setattr(trials, "measured", measured)
    trials.write(path, [as_row(tasks[1]), as_row(tasks[0], record_method=simulated.METHOD - 1)], "made so")
    with pytest.raises(KeyboardInterrupt):
        trials.measure_missing(path, tasks, lambda task, _: task.object, "made so")  # type: ignore[arg-type,return-value]
    assert seen == [1, 3]
    assert [row["object"] for row in trials.kept(path)] == [1, 2]
    assert json.loads(path.read_text())["commands"] == ["made so"] and not list(tmp_path.glob("*.part"))


def test_loud_slices_before_the_onset() -> None:
    """Assert that those above the line in the 500 ms before the onset are told, by their time before it."""
    sensing = np.full(1000, 10)
    sensing[[100, 200, 680, 699, 700]] = trials.LOUD + 1
    sensing[690] = trials.LOUD
    counts = SliceCounts(sensing, np.zeros(1000, np.int64), 700, 50)
    assert trials.loud_ms(counts) == [500, 20, 1]
    assert trials.loud_ms(replace(counts, onset=None)) == trials.loud_ms(replace(counts, onset=100)) == []


def test_bursts() -> None:
    """Assert that loud slices make one burst until they pause, named from their first to their last."""
    assert convergence.bursts([]) == []
    assert convergence.bursts([3, 300, 23, 290]) == [[300, 290], [23, 3]]
    assert convergence.bursts_in_words([24, 3]) == "24 to 24 (1), 3 to 3 (1)"


def test_what_does_not_converge_is_named() -> None:
    """Assert that nothing is said of slips within the bounds, and what and which of one beyond them."""
    default, finer = (Task(setting, SLIP, 8, 1) for setting in list(convergence.SETTINGS)[:2])
    as_default = [as_row(default, loud_ms=[9, 8])]
    near = as_row(finer, loud_ms=[10, 8, 7], onset_ms=1002, events_ms_30_before=14.0)
    assert convergence.beyond_bounds(as_default, [near]) == []
    for off, words in (
        ({"onset_ms": 1003}, "object 8, half the pitch: onset_ms 1003, 1000 by default"),
        ({"events_ms_500_to_100_before": 14.5}, "object 8, half the pitch: events_ms_500_to_100_before 14.5, 10"),
        ({"loud_ms": [9, 8, 400]}, "bursts 400 to 400 (1), 9 to 8 (2), by default 9 to 8 (2)"),
        ({"loud_ms": [12, 8]}, "bursts 12 to 8 (2), by default"),
        ({"loud_ms": []}, "bursts none, by default"),
    ):
        (said,) = convergence.beyond_bounds(as_default, [{**near, **off}])
        assert words in said


def test_what_was_kept_lies_within_the_bounds() -> None:
    """Assert that all slips that the page is made of lie within the bounds that it states."""
    rows = json.loads((trials.FOLDER / f"{convergence.NAME}.json").read_text())["rows"]
    of = {setting: [row for row in rows if row["setting"] == setting] for setting in convergence.SETTINGS}
    default = of.pop(convergence.DEFAULT)
    assert len(default) == len(convergence.OBJECTS)
    assert [convergence.beyond_bounds(default, finer) for finer in of.values()] == [[]] * len(of)


@pytest.mark.slow
@pytest.mark.parametrize("number", [4, 1])
def test_slips_converge(number: int, tmp_path: Path) -> None:
    """Assert that events before a slip are as by default on a finer grid, with finer steps and sub-steps: place too.

    Of the ten, these are the two that have bursts.
    """
    tasks = [task for task in convergence.tasks() if task.object == number]
    rows = [{**task.key, **trials.measured(convergence.plan(task, tmp_path))} for task in tasks]
    default, *finer = rows
    assert default["loud_ms"] and default["slip_half_wavelength_nodes"] > 4
    assert [convergence.beyond_bounds([default], [row]) for row in finer] == [[]] * len(finer)


def test_the_pitch_that_resolves_an_object() -> None:
    """Assert that an object that spans too few nodes in one draw gets a pitch, of the fewest, and others none."""

    def rows(*nodes: float | None) -> list[dict[str, Any]]:
        return [{"object": 2, "nodes": each, "pitch_mm": 0.833} for each in nodes]

    assert grid.line(rows(3.0, 5.0)) == ["2", "3.0", "5.0", f"{resolving_mm(3.0, 0.833):.2f}"]
    assert grid.line(rows(8.0, None)) == ["2", "8.0", "stable", "default"]
    assert resolving_mm(2.0, 0.8) < 0.4
