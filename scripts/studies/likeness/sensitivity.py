"""Which predictions depend on unknown constants? Varies each fitted constant by 30 % and measures the predictions.

    python scripts/studies/likeness/sensitivity.py [--out docs/results/likeness/sensitivity.json]

The constants are changed one at a time:

- of the scenes: the ratio of kinetic to static friction, the memory length and the pressure exponent
- of the sensor: the radius of the dots
- of the data-rate scene: the weight of the object

Only predictions that can be measured in a recording are included. Each setting has 24 slips of 18 objects and one
recording of the data-rate scene, with the same seeds in all settings.

Each row is written to the file as soon as it is measured; a second run measures only the missing rows. This takes about
six minutes of processor time. `make results` writes the table into docs/evidence/likeness.md.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from evetac_cli.evaluate.likeness.measures import Slip, judge
from evetac_cli.jobs import Row
from evetac_cli.kernels.slip.metrics import EARLIEST_MS, LATEST_MS
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.store.recordings.slip_grid import COLUMN, is_unresolved
from evetac_cli.trials.trial import SimulatedTrial
from scripts.reproduce.table_text import as_table
from scripts.studies.likeness.trials import (
    FOLDER,
    RATE,
    SLIP,
    Task,
    arguments,
    kept,
    made_by,
    measure_missing,
    of_tasks,
    planned,
)

NAME = "sensitivity"
COMMAND = "python scripts/studies/likeness/sensitivity.py"
# Two halves of 12 slips each: the objects, and the seeds used for each object.
HALVES = (
    ((3, 4, 8, 11, 12, 18), (1, 2)),
    ((1, 2, 5, 6, 7, 9, 10, 13, 15, 16, 17, 19), (3,)),
)
RATE_OBJECT, RATE_SEEDS = 1, (1,)
FACTORS = (0.7, 1.3)
AS_SET = "as set"
RADIUS, WEIGHT = "dot_radius_px", "mass_g"
WORDS = {
    "kinetic_share": "kinetic over static friction",
    "memory_um": "memory length",
    "pressure_exponent": "pressure exponent",
    RADIUS: "dot radius",
    WEIGHT: "weight of the data-rate object",
}  # heading of each constant that is changed


def changed(plan: Plan, constant: str, factor: float) -> Plan:
    """Return the plan with one constant multiplied by `factor`.

    Raises ValueError if the constant is the weight and the scene sets no weight of its object.
    """
    if constant == RADIUS:
        return replace(plan, sensor=replace(plan.sensor, dot_radius_px=factor * plan.sensor.dot_radius_px))
    scene = plan.scene
    if constant == WEIGHT:
        if scene.object is None:
            raise ValueError(f"expected a scene that sets the weight of its object, found {scene.name}")
        return replace(plan, scene=replace(scene, object=replace(scene.object, mass_g=factor * scene.object.mass_g)))
    low, high = getattr(scene.randomise, constant)
    return replace(
        plan, scene=replace(scene, randomise=replace(scene.randomise, **{constant: (factor * low, factor * high)}))
    )


SETTINGS: dict[str, Callable[[Plan], Plan] | None] = {
    AS_SET: None,
    **{
        f"{constant} x {factor:g}": partial(changed, constant=constant, factor=factor)
        for constant in WORDS
        for factor in FACTORS
    },
}


def slips_of(setting: str) -> list[Task]:
    """Return the slips of a setting, or none if the setting changes only the data-rate scene."""
    if setting.startswith(WEIGHT):
        return []
    return [Task(setting, SLIP, number, seed) for objects, seeds in HALVES for seed in seeds for number in objects]


def rates_of(setting: str) -> list[Task]:
    """Return the recordings of the data-rate scene of a setting."""
    return [Task(setting, RATE, RATE_OBJECT, seed) for seed in RATE_SEEDS]


def tasks() -> list[Task]:
    """Return all trials: slips first, then data rates by seed, so that an interrupted run has the most useful rows."""
    rates = sorted((task for setting in SETTINGS for task in rates_of(setting)), key=lambda task: task.seed)
    return [*(task for setting in SETTINGS for task in slips_of(setting)), *rates]


def plan(task: Task, folder: Path) -> SimulatedTrial:
    """Return the trial of a task."""
    return planned(task, folder, SETTINGS[task.setting])


def predictions(setting: str, rows: list[Row]) -> Row:
    """Return the prediction figures of a setting, each None or missing if no trial provides it.

    The figures `one_threshold_...` are shares of slips, with a threshold chosen on the other half of the objects.
    The figure `best_for_all` uses the single threshold that is correct most often on all slips: an upper bound.
    The other figures are medians over slips and means over recordings of the data-rate scene.
    """
    slips = [row for row in of_tasks(slips_of(setting), rows) if row["onset_ms"] is not None]
    rates = of_tasks(rates_of(setting), rows)
    judged = judge([Slip(half_of(row["object"]), tuple(row["after_ms"])) for row in slips])
    found: Row = {"setting": setting, "slips": len(slips), "rates": len(rates), **judged}
    if judged:
        after_ms = np.array([row["after_ms"] for row in slips])
        in_time = (after_ms >= EARLIEST_MS) & (after_ms <= LATEST_MS)
        found["best_for_all"] = float(in_time.mean(axis=0).max())
    for name in ("events_ms_100_to_30_before", "events_ms_30_after", "loudest_slice_50_before", "half_slips_ms"):
        found[name] = float(np.median([row[name] for row in slips])) if slips else None
    found["unresolved"] = sum(is_unresolved(row[COLUMN]) for row in slips)
    for name in ("share_whole", "share_contact", "share_slip"):
        known = [row[name] for row in rates if row[name] is not None]
        found[name] = float(np.mean(known)) if known else None
    return found


def half_of(number: int) -> str:
    """Return the name of the half that contains an object."""
    return next(f"half {place}" for place, (objects, _) in enumerate(HALVES) if number in objects)


COLUMNS = (
    ("right by one threshold", "{one_threshold_correct:.2f}"),
    ("by the best for all", "{best_for_all:.2f}"),
    ("k", "{one_threshold_low}-{one_threshold_high}"),
    ("first in [-10, 0] ms", "{one_threshold_10_to_0_ms_ahead:.2f}"),
    ("in [-30, -11] ms", "{one_threshold_30_to_11_ms_ahead:.2f}"),
    ("half slips for [ms]", "{half_slips_ms:.0f}"),
    ("events per ms, -100 to -30", "{events_ms_100_to_30_before:.0f}"),
    ("0 to 30", "{events_ms_30_after:.0f}"),
    ("loudest slice before -50", "{loudest_slice_50_before:.0f}"),
    ("slips under 4 nodes", "{unresolved}"),
)  # columns on slips
RATE_COLUMNS = (
    ("data rate, whole", "{share_whole:.4f}"),
    ("contact", "{share_contact:.4f}"),
    ("slip", "{share_slip:.3f}"),
)


def as_page(results: Path) -> str:
    """Return the table of docs/evidence/likeness.md."""
    rows = of_tasks(tasks(), kept(results / FOLDER.name / f"{NAME}.json"))
    found = [predictions(setting, rows) for setting in SETTINGS]
    heads = ["constant", "times", *(head for head, _ in (*COLUMNS, *RATE_COLUMNS))]
    slips, rates = (max(each[kind] for each in found) for kind in ("slips", "rates"))
    said = f"Simulated; {slips} slips for each setting, and {rates} of the data-rate scene:"
    lines = [line(each) for each in found]
    return "\n\n".join([said, as_table(heads, lines), made_by(rows, COMMAND)]) + "\n"


def line(found: Row) -> list[str]:
    """Return the cells of a setting, with `-` for figures that its trials do not provide."""
    constant, _, factor = found["setting"].partition(" x ")
    cells = [cell.format(**found) if "one_threshold_correct" in found else "-" for _, cell in COLUMNS]
    of_rates = ["-" if found["share_whole"] is None else cell.format(**found) for _, cell in RATE_COLUMNS]
    return [WORDS.get(constant, AS_SET), factor or "1", *cells, *of_rates]


def main() -> None:
    """Measure the missing rows."""
    measure_missing(arguments(__doc__, NAME).out, tasks(), plan, COMMAND)


if __name__ == "__main__":
    main()
