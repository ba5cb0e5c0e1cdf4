"""Make the tables and the picture of the grasps run by trials.py.

    python scripts/studies/grip/tables.py --rows rows/grip --seeds 50000-50999 --shared 200

- `grip-laws`: each grip law, over the first --shared seeds, which all laws have, and over all of its seeds
- `grip-by-mass`: grip force relative to the smallest force that holds the object, by class of mass
- `grip-detectors`, with --before FILE: the same grasps before and after a change, in pairs
- docs/grip-force.png: grip force against weight

All results are simulated.
"""

import argparse
from pathlib import Path

import numpy as np

from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.common.rows import quantile
from evetac_cli.evaluate.grasp.measure import CLASSES_G, STAYED_MM, draw_forces, firmness
from evetac_cli.jobs import Row, Rows
from evetac_cli.kernels.estimates import cluster_weights, ratio_of_clusters, share
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


def pairs_table(before: Rows, now: Rows, command: str, sizes: Row) -> Row:
    """Return the table `grip-detectors`: grasps of the same seeds before and after a change, and their differences."""
    firsts, seconds = ({row["seed"]: row for row in rows} for rows in (before, now))
    seeds = sorted(firsts.keys() & seconds.keys())
    pairs = [(firsts[seed], seconds[seed]) for seed in seeds]
    shown = []
    for name, some in (("before", [one for one, _ in pairs]), ("now", [two for _, two in pairs])):
        kept = share(sum(row["balanced"] for row in some), len(some))
        moved = quantile([row["moved_mm"] for row in some if row["balanced"]], 0.5)
        shown.append(
            {"grasp": name, "kept_low": kept.low, "kept_high": kept.high, "moved_median": moved, **firmness(some)}
        )
    both = [pair for pair in pairs if all(row["balanced"] and row["over_holding_end"] is not None for row in pair)]
    columns = {
        "detector": "{grasp}",
        "grasps": "{grasps}",
        "kept": "{kept:.3f} ({kept_low:.2f} to {kept_high:.2f})",
        "force at the end over what just holds, median": "{over_holding_end_median:.2f}",
        "95th percentile": "{over_holding_end_p95:.2f}",
        **{
            f"95th percentile, {low:g} to {high:g} g": f"{{over_holding_end_p95_{low:g}_{high:g}_g:.2f}}"
            for low, high in CLASSES_G
        },
        "mean over the grasp, median": "{over_holding_mean_median:.2f}",
        "peak, 95th percentile": "{over_holding_peak_p95:.2f}",
        "moved, median [mm]": "{moved_median:.2f}",
        "reactions per grasp": "{reactions_mean:.1f}",
        "of these false": "{false_share:.2f}",
    }
    notes = ["Kept: share, with its interval of 95 % (Wilson). Force and motion are of objects kept to the end."]
    for words, key, some in (
        ("kept", "balanced", pairs),
        ("force at the end over what just holds", "over_holding_end", both),
        ("motion in mm", "moved_mm", both),
    ):
        less = np.array([float(two[key]) - float(one[key]) for one, two in some])
        mean = ratio_of_clusters(less, np.ones(len(less)), cluster_weights([one["seed"] for one, _ in some]))
        assert mean is not None  # there are pairs
        notes.append(
            f"Now less before, {words}: {mean.value:.2f} ({mean.low:.2f} to {mean.high:.2f}), n = {len(less)}."
        )
    return table_of("grip-detectors", "Grasps before and now, in pairs", columns, shown, command, sizes, notes=notes)


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
    parser.add_argument("--before", type=Path, help="rows of a law before a change: only write grip-detectors")
    chosen = parser.parse_args()
    rows = [row for path in sorted(chosen.rows.glob("*.jsonl")) for row in rows_in(path) if row["seed"] in chosen.seeds]
    if chosen.before:
        before = [row for row in rows_in(chosen.before) if row["seed"] in chosen.seeds]
        sizes = {"seeds": f"{chosen.seeds[0]}-{chosen.seeds[-1]}", "grasps": len(rows)}
        command = f"python scripts/studies/grip/tables.py --rows FOLDER --seeds {sizes['seeds']} --before FILE"
        write(RESULTS, pairs_table(before, rows, command, sizes))
        return
    laws = by_law(rows)
    words = ["python scripts/studies/grip/tables.py --rows FOLDER", f"--seeds {chosen.seeds[0]}-{chosen.seeds[-1]}"]
    command = " ".join([*words, f"--shared {chosen.shared}"])
    sizes = {"seeds": f"{chosen.seeds[0]}-{chosen.seeds[-1]}", "grasps": {law: len(of) for law, of in laws.items()}}
    shared = chosen.seeds[: chosen.shared]
    write(RESULTS, laws_table(laws, shared, command, sizes), mass_table(laws, command, sizes))
    draw(laws, PICTURE)


if __name__ == "__main__":
    main()
