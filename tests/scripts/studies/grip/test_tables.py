"""scripts/studies/grip/tables.py: what its tables say of rows."""

from evetac_cli.jobs import Row
from scripts.studies.grip import tables


def grasp(law: str, seed: int, *, kept: bool = True, over: float = 1.5) -> Row:
    """A row of studies/grip/trials.py, of an object that gets heavier with the seed."""
    known = over if kept else None
    names = ("over_holding_end", "over_holding_mean", "over_holding_peak", "holding_end_n")
    return {
        **{"law": law, "margin": None, "seed": seed, "carried_g": 50.0 + 100 * (seed % 4), "balanced": kept},
        **{"failure": "" if kept else "fell in balance", "moved_mm": 1.0, "motor_work_j": 0.1},
        **{"force_end_n": 1.0 + seed % 4, "slip_events": 4, "false_slip_events": 1},
        **dict.fromkeys(names, known),
    }


def test_laws_are_compared_on_the_same_grasps() -> None:
    """Assert that a law of more grasps has a row of those that all have, and one of all; losses count for each."""
    rows = [grasp("paper", seed, over=4.0) for seed in range(10)]
    rows += [grasp("load-proportional", seed, kept=seed != 15) for seed in range(20)]
    laws = tables.by_law(rows)
    table = tables.laws_table(laws, range(10), "command", {})
    assert [(row["law"], row["grasps"], row["kept"]) for row in table["rows"]] == [
        ("paper", 10, 1.0),
        ("load-proportional", 10, 1.0),
        ("load-proportional", 20, 0.95),
    ]
    assert table["rows"][0]["over_holding_end_median"] == 4.0
    assert table["rows"][2]["kept_low"] < 0.95 < table["rows"][2]["kept_high"]
    of_mass = {(row["law"], row["mass"]): row for row in tables.mass_table(laws, "command", {})["rows"]}
    assert of_mass["load-proportional", "250 to 600 g"]["lost"] == "1 fell in balance"
    assert of_mass["load-proportional", "30 to 100 g"]["kept"] == 1.0
