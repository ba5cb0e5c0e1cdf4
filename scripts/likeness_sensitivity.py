"""Which predictions hang on what nobody knows? Each fitted constant 30 % up and down, and what it does to predictions.

    python scripts/likeness_sensitivity.py [--out docs/results/likeness/sensitivity.json]

Changed one at a time: kinetic over static friction, the memory length and the pressure exponent of the scenes, the
radius of the sensor's dots, and the weight of the data-rate scene's object. Measured are the predictions that a
recording tells, on 24 slips of 18 objects and a recording of the data-rate scene for each setting, the same seeds in
all. Rows go to the file as they come; a second run measures what is missing. Some six minutes of processor time.
`make results` puts the table into docs/likeness.md.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from likeness_trials import (
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

from evetac_cli.evaluate.likeness.single_slice import Slip, judge
from evetac_cli.jobs import Row
from evetac_cli.kernels.slip.metrics import EARLIEST_MS, LATEST_MS
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.store.recordings.slip_grid import COLUMN, is_unresolved
from evetac_cli.trials.trial import SimulatedTrial

NAME = "sensitivity"
COMMAND = "python scripts/likeness_sensitivity.py"
# Two halves, of 12 slips each: objects, and the seeds of each of them.
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
}  # of each constant that is changed


def changed(plan: Plan, constant: str, factor: float) -> Plan:
    """The plan with one constant so many times what it is; ValueError where the plan has none of it."""
    if constant == RADIUS:
        return replace(plan, sensor=replace(plan.sensor, dot_radius_px=factor * plan.sensor.dot_radius_px))
    scene = plan.scene
    if constant == WEIGHT:
        if scene.object is None:
            raise ValueError(f"expected a scene that names the weight of its object, found {scene.name}")
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
    """The slips of a setting; none where it changes the data-rate scene alone."""
    if setting.startswith(WEIGHT):
        return []
    return [Task(setting, SLIP, number, seed) for objects, seeds in HALVES for seed in seeds for number in objects]


def rates_of(setting: str) -> list[Task]:
    """The recordings of the data-rate scene of a setting."""
    return [Task(setting, RATE, RATE_OBJECT, seed) for seed in RATE_SEEDS]


def tasks() -> list[Task]:
    """All trials: slips first, then the data rate seed by seed, so that a run that is stopped has told most."""
    rates = sorted((task for setting in SETTINGS for task in rates_of(setting)), key=lambda task: task.seed)
    return [*(task for setting in SETTINGS for task in slips_of(setting)), *rates]


def plan(task: Task, folder: Path) -> SimulatedTrial:
    """The trial of a task."""
    return planned(task, folder, SETTINGS[task.setting])


def predictions(setting: str, rows: list[Row]) -> Row:
    """What the trials of a setting say of each prediction; no figure where no trial tells it.

    Shares are of slips, judged by a threshold that was chosen on the other half of the objects, and (best_for_all) by
    the one that is right most often on all, which is an upper bound; else medians over slips, and means of data rates.
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
    """In which half of the objects one is."""
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
)  # of slips
RATE_COLUMNS = (
    ("data rate, whole", "{share_whole:.4f}"),
    ("contact", "{share_contact:.4f}"),
    ("slip", "{share_slip:.3f}"),
)


def as_page(results: Path, as_table: Callable[[list[str], list[list[str]]], str]) -> str:
    """The table of docs/likeness.md; as_table makes Markdown of heads and rows."""
    rows = of_tasks(tasks(), kept(results / FOLDER.name / f"{NAME}.json"))
    found = [predictions(setting, rows) for setting in SETTINGS]
    heads = ["constant", "times", *(head for head, _ in (*COLUMNS, *RATE_COLUMNS))]
    slips, rates = (max(each[kind] for each in found) for kind in ("slips", "rates"))
    said = f"Simulated; {slips} slips for each setting, and {rates} of the data-rate scene:"
    lines = [line(each) for each in found]
    return "\n\n".join([said, as_table(heads, lines), made_by(rows, COMMAND)]) + "\n"


def line(found: Row) -> list[str]:
    """The cells of a setting; `-` for what its trials do not tell."""
    constant, _, factor = found["setting"].partition(" x ")
    cells = [cell.format(**found) if "one_threshold_correct" in found else "-" for _, cell in COLUMNS]
    of_rates = ["-" if found["share_whole"] is None else cell.format(**found) for _, cell in RATE_COLUMNS]
    return [WORDS.get(constant, AS_SET), factor or "1", *cells, *of_rates]


def main() -> None:
    """Measure what is missing."""
    measure_missing(arguments(__doc__, NAME).out, tasks(), plan, COMMAND)


if __name__ == "__main__":
    main()
