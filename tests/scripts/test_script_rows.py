"""What scripts share: seeds that they are asked for, and rows that they keep."""

import argparse
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import script_rows


def test_seeds_are_a_range() -> None:
    """Assert that FIRST-LAST holds both ends, that one number is one seed, and that other text is refused."""
    assert script_rows.seeds_of("3-5") == range(3, 6)
    assert script_rows.seeds_of("7") == range(7, 8)
    for text in ("", "5-3", "3-", "a", "-3", "1,2"):
        with pytest.raises(argparse.ArgumentTypeError, match="FIRST-LAST"):
            script_rows.seeds_of(text)


def test_rows_come_back(tmp_path: Path) -> None:
    """Assert that rows are added to those that are there, and that a line which was cut off is named."""
    path = tmp_path / "new" / "rows.jsonl"
    assert script_rows.rows_in(path) == []
    script_rows.add_rows(path, [{"seed": 1}])
    script_rows.add_rows(path, [{"seed": 2}, {"seed": 3}])
    assert [row["seed"] for row in script_rows.rows_in(path)] == [1, 2, 3]
    with path.open("a") as file:
        file.write('{"seed": ')
    with pytest.raises(SystemExit, match="rows.jsonl, line 4: expected a row"):
        script_rows.rows_in(path)
