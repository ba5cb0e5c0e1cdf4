"""speed/stage_costs.py: how start-up is told from work, and that runs on small trials measure every stage."""

import json
from pathlib import Path
from typing import Any

import pytest

from scripts.speed import stage_costs


def taken(few_s: float, all_s: float, memory_mb: float = 100.0, **more: float) -> dict[str, Any]:
    return {"few_s": few_s, "all_s": all_s, "memory_mb": memory_mb, **more}


def test_start_up_is_told_from_work() -> None:
    """Assert that what more trials take is work per trial, the rest start-up, and that the least of rounds counts."""
    quiet = {"track": taken(3.0, 6.0, 90.0, again_s=0.5, bytes=5_000.0), "info": taken(1.0, 1.0)}
    busy = {"track": taken(9.0, 9.0, 95.0, again_s=0.9, bytes=5_000.0), "info": taken(1.5, 2.0)}
    track, info = stage_costs.table([busy, quiet], trials=5)
    expected = {"cpu_s_per_trial": 1.0, "share": 1.0, "start_cpu_s": 1.0, "again_cpu_s": 0.5, "memory_mb": 95.0}
    assert track == {"stage": "track", **expected, "kilobytes_per_trial": 1.0}
    assert (info["cpu_s_per_trial"], info["share"], info["start_cpu_s"]) == (0.0, 0.0, 1.0)
    assert info["again_cpu_s"] is info["kilobytes_per_trial"] is None
    both = stage_costs.summary([track, info])
    assert (both["cpu_s_per_trial"], both["start_cpu_s"]) == (1.0, 2.0)
    assert both["start_share_of_one_trial"] == pytest.approx(2.0 / 3.0)


def run(monkeypatch: pytest.MonkeyPatch, *flags: str) -> None:
    monkeypatch.setattr("sys.argv", ["speed/stage_costs.py", *flags])
    stage_costs.main()


@pytest.mark.slow
def test_stages_are_measured_on_the_smallest_scene(
    short_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Assert a figure of each kind for each stage that is asked for, in the table and as JSON."""
    chosen = ("record", "track", "featurize", "info")
    flags = ("--scene", str(short_scene), "--trials", "3", "--rounds", "1", "--only", ",".join(chosen))
    run(monkeypatch, *flags, "-o", str(tmp_path / "costs.json"))
    made = json.loads((tmp_path / "costs.json").read_text())
    rows = {row["stage"]: row for row in made["rows"]}
    assert tuple(rows) == chosen and made["simulated"] is True
    assert all(tuple(row) == stage_costs.AS_SHOWN and row["memory_mb"] > 10.0 for row in rows.values())
    assert rows["record"]["kilobytes_per_trial"] > rows["track"]["kilobytes_per_trial"] > 0.0
    assert rows["track"]["again_cpu_s"] > 0.0 and rows["info"]["again_cpu_s"] is None
    assert sum(row["share"] or 0.0 for row in rows.values()) in (0.0, pytest.approx(1.0))
    shown = capsys.readouterr().out
    assert "stage costs (simulated)" in shown and all(stage in shown for stage in chosen)
