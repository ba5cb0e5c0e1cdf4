"""Make the tables and the picture of the grasps run by trials.py.

    python scripts/studies/grip/tables.py --rows rows/grip --seeds 50000-50999 --shared 200

- `grip-laws`: each grip law, over the first --shared seeds, which all laws have, and over all of its seeds
- `grip-by-mass`: grip force relative to the smallest force that holds the object, by class of mass
- docs/grip-force.png: grip force against weight

All results are simulated.
"""

import argparse
from pathlib import Path

from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.grasp.measure import CLASSES_G, STAYED_MM, draw_forces, firmness
from evetac_cli.jobs import Row, Rows
from evetac_cli.kernels.estimates import share
from scripts.reproduce.facts import RESULTS
from scripts.reproduce.made_tables import table_of, write
from scripts.studies.rows import rows_in, seeds_of

PICTURE = RESULTS.parent / "grip-force.png"
SHOWN = 200  # grasps of each law in the picture


def named(row: Row) -> str:
    """Return the name of a row's law, with its margin if one was set."""
    return str(row["law"]) if row["margin"] is None else f"{row['law']}, margin {row['margin']:g}"


def by_law(rows: Rows) -> dict[str, Rows]:
    """Return the rows of each law, ordered by seed."""
    laws: dict[str, Rows] = {}
    for row in sorted(rows, key=lambda row: int(row["seed"])):
        laws.setdefault(named(row), []).append(row)
    return laws


def laws_table(laws: dict[str, Rows], shared: range, command: str, sizes: Row) -> Row:
    """Return the table `grip-laws`: the share of objects kept by each law, and its grip forces."""
    shown = []
    for law, rows in laws.items():
        sets = [[row for row in rows if row["seed"] in shared]]
        sets += [rows] * (len(rows) > len(sets[0]))
        for some in sets:
            kept = share(sum(row["balanced"] for row in some), len(some))
            shown.append({"law": law, "kept_low": kept.low, "kept_high": kept.high, **firmness(some)})
    columns = {
        "law": "{law}",
        "grasps": "{grasps}",
        "kept": "{kept:.3f} ({kept_low:.3f} to {kept_high:.3f})",
        "force at the end over what just holds, median": "{over_holding_end_median:.2f}",
        "95th percentile": "{over_holding_end_p95:.2f}",
        "mean over the grasp, median": "{over_holding_mean_median:.2f}",
        "peak, 95th percentile": "{over_holding_peak_p95:.2f}",
        "rank correlation of force with weight": "{force_follows_weight:.2f}",
        f"moved less than {STAYED_MM:g} mm": "{stayed_share:.2f}",
        "motor work, median [J]": "{motor_work_j_median:.2f}",
        "reactions per grasp": "{reactions_mean:.1f}",
        "of these false": "{false_share:.2f}",
    }
    note = "Kept: share, with its interval of 95 % (Wilson). Force and motion are of objects kept to the end."
    return table_of("grip-laws", "Grasps of randomised objects by law", columns, shown, command, sizes, notes=(note,))


def mass_table(laws: dict[str, Rows], command: str, sizes: Row) -> Row:
    """Return the table `grip-by-mass`: objects kept and lost, and relative grip force, by law and class of mass."""
    shown = []
    for law, rows in laws.items():
        for low, high in CLASSES_G:
            some = [row for row in rows if low <= row["carried_g"] < high]
            if some:
                shown.append({"law": law, "mass": f"{low:g} to {high:g} g", **firmness(some)})
    columns = {
        "law": "{law}",
        "carried at the end": "{mass}",
        "grasps": "{grasps}",
        "kept": "{kept:.3f}",
        "lost": "{lost}",
        "force at the end over what just holds, median": "{over_holding_end_median:.2f}",
        "95th percentile": "{over_holding_end_p95:.2f}",
        "mean over the grasp, median": "{over_holding_mean_median:.2f}",
    }
    return table_of("grip-by-mass", "Grasps of randomised objects by mass", columns, shown, command, sizes)


def draw(laws: dict[str, Rows], path: Path) -> None:
    """Draw grip force against weight for the first SHOWN grasps of each law."""
    held = [[row for row in rows[:SHOWN] if row["over_holding_end"] is not None] for rows in laws.values()]
    settings = [(number, law, rows) for number, (law, rows) in enumerate(zip(laws, held, strict=True)) if rows]
    picture.write(path, lambda figure: draw_forces(figure, settings), (7.5, 5.0))


def main() -> None:
    """Write the tables and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=Path, required=True, help="folder with the rows of trials.py, one file per law")
    parser.add_argument("--seeds", type=seeds_of, required=True, help="seeds of the grasps to show, as FIRST-LAST")
    parser.add_argument("--shared", type=int, default=200, help="number of first seeds for which every law has a grasp")
    chosen = parser.parse_args()
    rows = [row for path in sorted(chosen.rows.glob("*.jsonl")) for row in rows_in(path) if row["seed"] in chosen.seeds]
    laws = by_law(rows)
    words = ["python scripts/studies/grip/tables.py --rows FOLDER", f"--seeds {chosen.seeds[0]}-{chosen.seeds[-1]}"]
    command = " ".join([*words, f"--shared {chosen.shared}"])
    sizes = {"seeds": f"{chosen.seeds[0]}-{chosen.seeds[-1]}", "grasps": {law: len(of) for law, of in laws.items()}}
    shared = chosen.seeds[: chosen.shared]
    write(RESULTS, laws_table(laws, shared, command, sizes), mass_table(laws, command, sizes))
    draw(laws, PICTURE)


if __name__ == "__main__":
    main()
