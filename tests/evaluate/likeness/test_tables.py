"""What docs/results say of a fact: columns, figures that follow from several rows, and what the tables do not have."""

import json
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.errors import InputError
from evetac_cli.evaluate.likeness.facts import IN_A_CLONE, ResultTables, by_name, facts


def tables(folder: Path, **rows: list[dict[str, Any]]) -> ResultTables:
    """Tables of these rows, by name with _ for -."""
    for name, of_table in rows.items():
        text = json.dumps({"made": "commit abc", "rows": of_table, "sizes": {"recordings": 7}})
        (folder / f"{name.replace('_', '-')}.json").write_text(text)
    return ResultTables(folder)


def network(name: str, correct: float, f1: float, **more: Any) -> dict[str, Any]:
    """A row of the networks that were trained by the paper's recipe, judged on the objects that they learned from."""
    of_recipe = {"objects_words": "trained on", "preset": "paper", "horizon_ms": 0}
    return {"model": name, **of_recipe, "slip_correct": correct, "f1": f1, **more}


def test_a_column_and_its_trials(tmp_path: Path) -> None:
    """Assert that a column of the row is taken, with its number of trials and the version of the table."""
    found = tables(tmp_path, grasps=[{"setting": "paper", "success": 0.9, "trials": 12}]).ours(by_name("grasps-kept"))
    assert found.values == (0.9,) and found.n == 12
    assert found.origin == "docs/results/grasps.json, commit abc"


def test_order_of_networks(tmp_path: Path) -> None:
    """Assert that the order counts pairs, of timing and F1, and is not told where a network is missing."""
    rows = [network("fast-slow", 0.9, 0.8), network("hist20", 0.8, 0.9), network("hist10", 0.7, 0.7)]
    fact = by_name("order-of-networks")
    missing = tables(tmp_path, paper_recipe=rows).ours(fact)
    assert missing.values == () and "does not have it" in missing.untold
    others = [network("hist10", 0.0, 0.0, objects_words="unseen")]  # which do not count
    found = tables(tmp_path, paper_recipe=[*rows, network("no-hist", 0.1, 0.1), *others]).ours(fact)
    assert found.values == pytest.approx((11 / 12,)) and found.n == 7


def test_differences_and_ratios(tmp_path: Path) -> None:
    """Assert that differences, ratios and correlations are those of the rows that they name."""
    both = [network("events-only", 0.6, 0.5), network("disp-only", 0.2, 0.7)]
    found = tables(tmp_path, paper_recipe=both).ours(by_name("events-against-displacement"))
    assert found.values == pytest.approx((0.4, -0.2))
    grip = [{"object": number, "setting": "paper", "force_end_n": float(20 - number)} for number in range(10, 19)]
    force = tables(tmp_path, grasps_by_object=grip).ours(by_name("force-follows-mass"))
    masses = [72, 108, 38, 116, 166, 56, 74, 248, 550]  # grip falls by object number
    falling = sum(masses[a] > masses[b] for a in range(9) for b in range(a))
    assert falling > 18 and force.values[0] is not None and force.values[0] < 0
    still = [{"preset": "official", "scene": scene, "gel": "cut", "error_px_rms": 3.0, "still_px_rms": 2.0}
             for scene in ("slip", "edge")]  # fmt: skip
    assert tables(tmp_path, tracking_distance=still).ours(by_name("official-2024")).values == (1.5, 1.5)


def test_what_is_not_there(tmp_path: Path) -> None:
    """Assert that a missing table, row or tracker is said, and that another file is refused."""
    fact = by_name("grasps-kept")
    assert "no table grasps" in ResultTables(tmp_path).ours(fact).untold
    assert "has no row" in tables(tmp_path, grasps=[{"setting": "none"}]).ours(fact).untold
    stable = {"sensor_name": "evetac", "sensor": "events", "model": "regression", "mae_n_x": 0.1, "mae_n_y": 0.1}
    assert "does not have it" in tables(tmp_path, force=[stable]).ours(by_name("force-by-papers-tracker")).untold
    for text, said in (("[1]", "not a table"), ('{"rows": 3}', "not a table"), ("{", "not valid JSON")):
        (tmp_path / "grasps.json").write_text(text)
        with pytest.raises(InputError, match=said):
            ResultTables(tmp_path).ours(fact)
    with pytest.raises(InputError, match="no such folder"):
        ResultTables(tmp_path / "nowhere")


def test_every_table_that_a_fact_names_is_there() -> None:
    """Assert that docs/results of this clone has the tables, and that most facts find their figures in them."""
    known = ResultTables(IN_A_CLONE)
    named = [fact for fact in facts() if fact.table]
    assert all(known.table(fact.table) is not None for fact in named)
    told = [fact.name for fact in named if known.ours(fact).values]
    assert len(told) >= len(named) - 2
