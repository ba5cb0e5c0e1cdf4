"""Tables of docs/evidence/likeness.md: figures of the paper on its own sensor, from the rows of paper_sensor.py."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np

from evetac_cli.evaluate import PAPER
from evetac_cli.evaluate.common import marks
from evetac_cli.jobs import Row
from evetac_cli.kernels.estimates import LEVEL, share
from scripts.reproduce.facts import RESULTS
from scripts.reproduce.table_text import as_table

PATH = RESULTS / "likeness" / "paper-sensor.json"
SEED = 71_000
DOTS = {"paper": "the paper's, literally", "paper-5-events": "... 5 events, as its code counts", "stable": "`stable`"}
DOTS |= {"rgb": "dots in RGB frames"}
# Grasps by name: the flags, and the paper's figure.
GRASPS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "20 g dropped on object 16": (("--scene", "drop-20g", "--object", "16"), ("kept", "drop-20g")),
    "100 g dropped on it, double gain": (
        ("--scene", "drop-100g", "--object", "16", "--gain", "2"),
        ("kept", "drop-100g"),
    ),
    "object 14": (("--object", "14"), ("kept", "14", "1")),
    "object 18": (("--object", "18"), ("kept", "18", "1")),
    "object 20, double gain": (("--object", "20", "--gain", "2"), ("kept", "20", "2")),
    "second sensor, object 17": (("--object", "17", "--sensor", "second"), ("kept", "another sensor")),
    "closed gel, object 17": (("--object", "17", "--gel", "closed"), ("kept", "another sensor")),
}
SPEEDS_MM_S = (0, 3, 10, 33, 100)  # where a range of sliding speeds begins


def read(results: Path = RESULTS) -> Row:
    """Return the stored rows, by their group."""
    path = results / "likeness" / PATH.name
    stored: Row = (
        json.loads(path.read_text()) if path.exists() else {"name": "likeness-paper-sensor", "simulated": True}
    )
    return stored


def _made(group: Row) -> str:
    return f"Made at {group['commit']}; seeds from {SEED}; rows: `docs/results/likeness/{PATH.name}`.\n"


def force_page(results: Path) -> str:
    """Return the table of forces, with the paper's figures for its own tracker and for RGB."""
    stored = read(results)["force"]
    lines = []
    for row in stored["rows"]:
        camera = "frames" if row["dots"] == "rgb" else "events"
        beside = [PAPER.figures["mae", row["model"], camera, axis].value for axis in "xy"]
        cells = [
            f"{row[f'mae_n_{axis}']:.2f} ({row[f'mae_n_{axis}_interval'][0]:.2f} to"
            f" {row[f'mae_n_{axis}_interval'][1]:.2f})"
            for axis in "xy"
        ]
        mark = marks.SIZE if row["dots"] in ("paper", "rgb") else marks.METHOD
        figures = ", ".join(f"{value:g}" for value in beside)
        lines.append([DOTS[row["dots"]], row["model"], *cells, f"{figures}, {mark}"])
    count = stored["rows"][0]["trajectories"]
    heads = ["dots", "model", "Fx [N]", "Fy [N]", "paper, Fx, Fy [N]"]
    said = f"Simulated; mean absolute errors over {count} trajectories, with intervals of {LEVEL:.0%} by trajectory:"
    return "\n\n".join([said, as_table(heads, lines), _made(stored)])


def slip_page(results: Path) -> str:
    """Return the tables of slip detection, and of how long a detector stays on."""
    stored = read(results)["slip"]
    lines, speeds = [], []
    for row in stored["rows"]:
        who = f"{row['horizon_ms']} ms ahead, {row['objects']} objects"
        timing = f"{row['slip_correct']:.2f} ({row['slip_correct_low']:.2f} to {row['slip_correct_high']:.2f})"
        f1 = f"{row['f1']:.2f} ({row['f1_low']:.2f} to {row['f1_high']:.2f})"
        first = f"{row['first_10_to_0_ms']:.2f}"
        lines.append([who, str(row["trajectories"]), timing, f"{row['slip_early']:.2f}", f1, first])
        cells = [f"{hits / ms:.2f} of {ms} ms" if ms else "-" for hits, ms in row["detected_ms"]]
        hits, ms = np.sum(row["detected_ms"], axis=0)
        speeds.append([who, *cells, f"{hits / ms:.2f}"])
    heads = ["`fast-slow`", "slips", "timing correct", "early", "F1", "first in -10 to 0 ms"]
    ranges = [f"{low} to {high} mm/s" for low, high in pairwise(SPEEDS_MM_S)] + [f"over {SPEEDS_MM_S[-1]} mm/s"]
    said = "Simulated; the paper's recipe, one training, judged by its labels, with intervals by object:"
    stays = (
        "Simulated; share of the ms from the onset to the end of contact in which slip is detected, by sliding speed:"
    )
    two = [said, as_table(heads, lines), stays, as_table(["`fast-slow`", *ranges, "all"], speeds), _made(stored)]
    return "\n\n".join(two)


def grasps_page(results: Path) -> str:
    """Return the table of grasps beside the paper's figures."""
    stored = read(results)["grasps"]
    lines = []
    for row in stored["rows"]:
        kept = share(row["kept"], row["trials"])
        median = row["moved_lift_mm_median"]
        figure = PAPER.figures[GRASPS[row["name"]][1]]
        beside = f"{figure.value:g}, {marks.SAME if figure.trials == row['trials'] else marks.SIZE}"
        cells = [f"{row['kept']} of {row['trials']} ({kept.low:.2f} to {kept.high:.2f})", beside]
        far = sum(moved > 10.0 for moved in row["moved_mm"])
        lines.append([row["name"], *cells, "-" if median is None else f"{median:.2f}", str(far)])
    heads = ["grasp", "kept", "paper, share", "moved in the lift, median of those kept [mm]", "moved over 10 mm"]
    said = "Simulated; the paper's controller and tracker, with `fast-slow` 10 ms ahead by the paper's recipe:"
    return "\n\n".join([said, as_table(heads, lines), _made(stored)])


PAGES = {"likeness-paper-force": force_page, "likeness-paper-slip": slip_page, "likeness-paper-grasps": grasps_page}
