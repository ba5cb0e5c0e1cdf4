"""Do the events before a slip converge? Compares ten slips on the default grid and steps with finer ones.

    python scripts/studies/likeness/convergence.py [--out docs/results/likeness/convergence.json]

The onset alone may converge although the events before it, which detectors use, do not. Four finer settings are
compared with the default:

- half the pitch of the nodes
- half the tolerance of a step, which also halves the shortest step
- fixed steps of 1/8 ms
- two straight segments of a dot's path per slice

Each row is written to the file as soon as it is measured; a second run measures only the missing rows. This takes about
two minutes of processor time. `make results` writes the tables into docs/simulator.md.
"""

from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.jobs import Row
from evetac_cli.sim.setup.scene import Solver
from evetac_cli.trials.trial import SimulatedTrial
from scripts.reproduce.table_text import as_table
from scripts.studies.likeness.trials import (
    FOLDER,
    LOUD,
    SLIP,
    Task,
    arguments,
    kept,
    made_by,
    measure_missing,
    of_tasks,
    planned,
)

NAME = "convergence"
COMMAND = "python scripts/studies/likeness/convergence.py"
# Objects that the default grid resolves, among them some on which slip is stable.
OBJECTS = (3, 4, 8, 11, 12, 1, 7, 10, 15, 16)
SEED = 1
DEFAULT = "default"
SETTINGS: dict[str, dict[str, Any]] = {
    DEFAULT: {},
    "half the pitch": {"node_pitch_mm": Solver.node_pitch_mm / 2},
    "half the tolerance and step": {"tolerance_um": Solver.tolerance_um / 2},
    "fixed 1/8 ms": {"step_ms": 0.125},
    "2 camera sub-steps": {"camera_substeps": 2},
}
MEASURES = {
    "onset_ms": "onset after the current begins to fall [ms]",
    "half_slips_ms": "half of the contact slips for [ms]",
    "events_ms_500_to_100_before": "events per ms, -500 to -100 ms",
    "events_ms_100_to_30_before": "-100 to -30 ms",
    "events_ms_30_before": "-30 ms to the onset",
    "events_ms_30_after": "the onset to 30 ms",
    "loudest_slice_50_before": "loudest slice before -50 ms [events]",
}
PAUSE_MS = 20  # longest pause between loud slices within a burst
# Largest allowed difference of a finer simulation from the default, for each slip: an absolute part, plus a share of
# the default's value.
BOUNDS = {
    "onset_ms": (2.0, 0.0),
    "events_ms_500_to_100_before": (2.0, 0.2),
    "events_ms_100_to_30_before": (2.0, 0.2),
    "events_ms_30_before": (2.0, 0.2),
    "events_ms_30_after": (2.0, 0.2),
    "loudest_slice_50_before": (25.0, 0.0),
}
BURST_MS = 2  # largest allowed difference of the ends of a burst; the number of bursts must be equal


def tasks() -> list[Task]:
    """Return ten slips for each setting."""
    return [Task(setting, SLIP, number, SEED) for setting in SETTINGS for number in OBJECTS]


def plan(task: Task, folder: Path) -> SimulatedTrial:
    """Return the trial of a task."""
    return planned(task, folder, **SETTINGS[task.setting])


def as_page(results: Path) -> str:
    """Return the tables of docs/simulator.md."""
    rows = kept(results / FOLDER.name / f"{NAME}.json")
    of = {setting: of_tasks([task for task in tasks() if task.setting == setting], rows) for setting in SETTINGS}
    finer = [setting for setting in SETTINGS if setting != DEFAULT]
    lines = [
        [
            words,
            f"{np.mean([row[name] for row in of[DEFAULT]]):.1f}",
            *(apart(name, of[DEFAULT], of[one]) for one in finer),
        ]
        for name, words in MEASURES.items()
    ]
    us = [f"{np.median([row['us_a_slice'] for row in of[setting]]):.0f}" for setting in SETTINGS]
    measures = as_table(
        ["", "default, mean", *(f"{one}: rms, worst" for one in finer)], [*lines, ["us per slice, median", *us]]
    )
    loud = [
        [str(each[0]["object"]), *(bursts_in_words(row["loud_ms"]) for row in each)]
        for each in zip(*of.values(), strict=True)
        if any(row["loud_ms"] for row in each)
    ]
    bursts_table = as_table(["object", *SETTINGS], loud)
    objects = ", ".join(map(str, OBJECTS))
    said = [
        f"Simulated; slips of objects {objects}: differences from the default, slip by slip:",
        f"Bursts: slices of more than {LOUD} events in the 500 ms before the onset, of slips that have any: how many ms"
        " before the onset a burst begins and ends, and its loud slices:",
    ]
    return "\n\n".join([said[0], measures, said[1], bursts_table, made_by(rows, COMMAND)]) + "\n"


def apart(name: str, default: list[Row], finer: list[Row]) -> str:
    """Return a measure's difference from the default as text: rms over slips, then the largest."""
    off = differences(name, default, finer)
    return f"{np.sqrt(np.mean(np.square(off))):.2g}, {max(map(abs, off)):.2g}"


def differences(name: str, default: list[Row], finer: list[Row]) -> list[float]:
    """Return the measure in a finer simulation minus that in the default, for each slip."""
    return [float(row[name] - as_default[name]) for row, as_default in zip(finer, default, strict=True)]


def bursts(loud_ms: list[int]) -> list[list[int]]:
    """Group loud slices (ms before the onset) into bursts; a pause of more than PAUSE_MS ends a burst."""
    found: list[list[int]] = []
    for at_ms in sorted(loud_ms, reverse=True):
        if found and found[-1][-1] - at_ms <= PAUSE_MS:
            found[-1].append(at_ms)
        else:
            found.append([at_ms])
    return found


def bursts_in_words(loud_ms: list[int]) -> str:
    """Return a text with the two ends of each burst and the number of its loud slices."""
    return ", ".join(f"{burst[0]} to {burst[-1]} ({len(burst)})" for burst in bursts(loud_ms)) or "none"


def beyond_bounds(default: list[Row], finer: list[Row]) -> list[str]:
    """Return a line for each measure that does not converge within the bounds stated in docs/simulator.md.

    Both lists have the same slips in the same order.
    """
    found = [
        f"object {row['object']}, {row['setting']}: {name} {row[name]:.4g}, {as_default[name]:.4g} by default"
        for name, (absolute, share) in BOUNDS.items()
        for row, as_default in zip(finer, default, strict=True)
        if abs(row[name] - as_default[name]) > absolute + share * abs(as_default[name])
    ]
    for row, as_default in zip(finer, default, strict=True):
        loud, as_many = bursts(row["loud_ms"]), bursts(as_default["loud_ms"])
        ends = [[(burst[0], burst[-1]) for burst in each] for each in (loud, as_many)]
        if len(loud) != len(as_many) or np.abs(np.subtract(*ends)).max(initial=0) > BURST_MS:
            words = (bursts_in_words(each["loud_ms"]) for each in (row, as_default))
            found.append(f"object {row['object']}, {row['setting']}: bursts {', by default '.join(words)}")
    return found


def main() -> None:
    """Measure the missing rows."""
    chosen = arguments(__doc__, NAME)
    measure_missing(chosen.out, tasks(), plan, COMMAND)


if __name__ == "__main__":
    main()
