"""scripts/reproduce/frozen.py: which files have changed since the freeze, and where they are now."""

import json
from dataclasses import replace
from pathlib import Path

from scripts.reproduce import frozen
from scripts.reproduce.frozen import Freeze, digest

TRACKER, EDGE = "evetac_cli/kernels/tracker.py", "evetac_cli/data/scenes/edge.toml"
CODE = '''"""A tracker."""

from math import (
    pi,
)


def radius() -> float:
    """Of a dot."""
    return pi  # px
'''


def write(root: Path, path: str, text: str) -> None:
    (root / path).parent.mkdir(parents=True, exist_ok=True)
    (root / path).write_text(text)


def test_the_stored_freeze() -> None:
    """Assert that the freeze is of the rule, and that moves lead from frozen files to files that exist."""
    freeze = frozen.read()
    assert (frozen.SEEDS.start, frozen.SEEDS.stop) == (100_000, 110_000)
    assert json.loads(frozen.FILE.read_text())["rule"] == frozen.RULE
    assert set(freeze.files) >= {"evetac_cli/kernels/tracking/tracker.py", "evetac_cli/data/sensors.toml"}
    assert all(frozen.is_frozen(path) for path in freeze.files)
    assert not frozen.is_frozen("evetac_cli/data/page.css") and not frozen.is_frozen("evetac_cli/errors.py")
    assert freeze.moved.keys() <= freeze.files.keys()
    assert all((frozen.ROOT / path).exists() for path in freeze.moved.values()), "run frozen.py --moves"


def test_frozen_tables_are_as_they_were_made(tmp_path: Path) -> None:
    """Assert the digest of each table made with frozen methods, which no file differed from, and that others count not.

    A changed digit gives another digest.
    """
    freeze = frozen.read()
    assert frozen.tables(freeze) == freeze.tables, "run frozen.py --tables after an experiment"
    for name in freeze.tables:
        assert json.loads((frozen.ROOT / "docs" / "results" / f"{name}.json").read_text())["changed_since"] == [], name
    table = {"frozen": freeze.commit[:8], "rows": [{"share": 0.9}]}
    write(tmp_path, "a.json", json.dumps(table))
    write(tmp_path, "b.json", json.dumps(table | {"frozen": "f9c755f9"}))
    first = frozen.tables(freeze, tmp_path)
    write(tmp_path, "a.json", json.dumps(table).replace("0.9", "0.8"))
    assert set(first) == {"a"} and frozen.tables(freeze, tmp_path) != first


def test_what_has_changed_since_the_freeze(tmp_path: Path) -> None:
    """Assert that changed, removed and new files are listed; comments, docstrings, imports and moves do not count."""
    files = {TRACKER: CODE, EDGE: "contrast = 2\n"}
    freeze = Freeze("0" * 40, "2026-11-27", {path: digest(path, text.encode()) for path, text in files.items()})
    for path, text in files.items():
        write(tmp_path, path, text)
    assert frozen.changed(freeze, tmp_path) == []
    assert "None of them has changed since." in frozen.in_words(freeze, [])
    same = (
        CODE.replace("from math import (\n    pi,\n)", "from numpy import pi")
        .replace("  # px", "")
        .replace("Of", "Its")
    )
    write(tmp_path, TRACKER, same)
    assert frozen.changed(freeze, tmp_path) == []
    write(tmp_path, TRACKER, same.replace("return pi", "return 2 * pi"))
    write(tmp_path, EDGE, "contrast = 2  # as before\n")
    write(tmp_path, "evetac_cli/kernels/new.py", "")
    write(tmp_path, "evetac_cli/data/page.css", "")
    assert frozen.changed(freeze, tmp_path) == [EDGE, "evetac_cli/kernels/new.py", TRACKER]
    (tmp_path / TRACKER).unlink()
    assert TRACKER in frozen.changed(freeze, tmp_path)
    write(tmp_path, "evetac_cli/dots/tracker.py", CODE)
    moved = replace(freeze, moved={TRACKER: "evetac_cli/dots/tracker.py"})
    assert frozen.changed(moved, tmp_path) == [EDGE, "evetac_cli/kernels/new.py"]


def test_moves_are_followed() -> None:
    """Assert that a file that was moved twice, or back, has its present path, and that others do not count."""
    renames = ["R100\ta.py\tb.py", "R090\tother.py\tnew.py", "R080\tb.py\tc.py", "R100\td.py\te.py", "R100\te.py\td.py"]
    assert frozen.followed(["a.py", "d.py", "kept.py"], renames) == {"a.py": "c.py"}
