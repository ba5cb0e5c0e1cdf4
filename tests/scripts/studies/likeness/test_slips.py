"""Scripts of likeness that simulate slips: what is changed, which trials are missing, what their rows say."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.evaluate.likeness.measures import NEVER_MS, THRESHOLDS
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.trials.record import simulated
from scripts.studies.likeness import convergence, trials
from scripts.studies.likeness.trials import SLIP, Task


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


# Beyond the bounds at half the pitch: object 12 is so narrow that few spots of its rough surface touch the gel, and the
# burst of object 4 has 2 slices just above the limit.
BEYOND = ("object 12, half the pitch: onset_ms", "object 12, half the pitch: events_ms_30_before", "object 4, half")


def test_what_was_kept_lies_within_the_bounds() -> None:
    """Assert that all slips that the page is made of lie within the bounds that it states, except those in BEYOND."""
    rows = json.loads((trials.FOLDER / f"{convergence.NAME}.json").read_text())["rows"]
    of = {setting: [row for row in rows if row["setting"] == setting] for setting in convergence.SETTINGS}
    default = of.pop(convergence.DEFAULT)
    assert len(default) == len(convergence.OBJECTS)
    beyond = [line for finer in of.values() for line in convergence.beyond_bounds(default, finer)]
    assert [line for line in beyond if not line.startswith(BEYOND)] == []
    assert len(beyond) == len(BEYOND)


@pytest.mark.slow
@pytest.mark.parametrize("number", [1])
def test_slips_converge(number: int, tmp_path: Path) -> None:
    """Assert that events before a slip are as by default on a finer grid, with finer steps and sub-steps: place too.

    Of the ten, this is the one with long bursts.
    """
    tasks = [task for task in convergence.tasks() if task.object == number]
    rows = [{**task.key, **trials.measured(convergence.plan(task, tmp_path))} for task in tasks]
    default, *finer = rows
    assert default["loud_ms"] and (default["slip_half_wavelength_nodes"] or math.inf) > 4  # None: slip is stable
    assert [convergence.beyond_bounds([default], [row]) for row in finer] == [[]] * len(finer)
