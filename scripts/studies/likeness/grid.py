"""Which objects does the default grid resolve? Gives half the wavelength of unstable slip in nodes for every object.

    python scripts/studies/likeness/grid.py [--out docs/results/likeness/grid.json]

The value is that at the slip limit, as shown by `evetac record --scene slip --object 1-20 --seed N --dry-run`, for the
random draws of five seeds. An object is not resolved if half its wavelength spans fewer than 4 nodes with any seed. The
table then shows the pitch that resolves it. This takes seconds. `make results` writes the table into docs/simulator.md.
"""

import math
from pathlib import Path

from evetac_cli.commands.record import Record
from evetac_cli.jobs import Row
from evetac_cli.store.recordings.slip_grid import is_unresolved, resolving_mm
from evetac_cli.trials import record
from evetac_cli.trials.record import simulated
from evetac_cli.trials.trial import SimulatedTrial, nodes_of_slip
from scripts.reproduce.facts import commit_in_words
from scripts.reproduce.table_text import as_table
from scripts.studies.likeness.trials import FOLDER, SLIP, arguments, kept, made_by, write

NAME = "grid"
COMMAND = "python scripts/studies/likeness/grid.py"
OBJECTS, SEEDS = "1-20", range(1, 6)


def measured() -> list[Row]:
    """Return a row for each object and seed, with the number of nodes (None if slip is stable) and their pitch."""
    made = commit_in_words()
    rows: list[Row] = []
    for seed in SEEDS:
        planned = record.jobs([], Record(scene=SLIP, objects=OBJECTS, seed=seed, texture="off"), Path())
        trials = [trial for trial in planned if isinstance(trial, SimulatedTrial)]
        pitch_mm = trials[0].plan.scene.solver.node_pitch_mm
        for trial in trials:
            nodes = nodes_of_slip(trial)
            row = {"object": trial.plan.object_name, "seed": seed, "nodes": nodes if math.isfinite(nodes) else None}
            rows.append({**row, "pitch_mm": pitch_mm, "record_method": simulated.METHOD, "commit": made})
    return rows


def as_page(results: Path) -> str:
    """Return the table of docs/simulator.md."""
    rows = kept(results / FOLDER.name / f"{NAME}.json")
    lines = [line([row for row in rows if row["object"] == called]) for called in {row["object"]: None for row in rows}]
    heads = ["object", "nodes, fewest", "most", "pitch that resolves it [mm]"]
    said = (
        f"Simulated; half the wavelength of unstable slip at the slip limit, over {len(SEEDS)} draws of the slip scene:"
    )
    return "\n\n".join([said, as_table(heads, lines), made_by(rows, COMMAND)]) + "\n"


def line(rows: list[Row]) -> list[str]:
    """Return the cells of an object from its rows."""
    nodes = [math.inf if row["nodes"] is None else row["nodes"] for row in rows]
    fewest = min(nodes)
    finer = f"{resolving_mm(fewest, rows[0]['pitch_mm']):.2f}" if is_unresolved(fewest) else "default"
    return [str(rows[0]["object"]), *(in_words(each) for each in (fewest, max(nodes))), finer]


def in_words(nodes: float) -> str:
    """Return a number of nodes as text; beyond 20 the exact number does not matter."""
    return "stable" if math.isinf(nodes) else "above 20" if nodes > 20 else f"{nodes:.1f}"


def main() -> None:
    """Measure all objects and replace the file."""
    write(arguments(__doc__, NAME).out, measured(), COMMAND)


if __name__ == "__main__":
    main()
