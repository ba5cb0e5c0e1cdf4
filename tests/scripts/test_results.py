"""scripts/results.py: run times are put into their place in a page."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import results


def test_rows_are_put_into_a_page(tmp_path: Path) -> None:
    """Assert that a table takes the place of the one before, in its own place only, and a place has to be there."""
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- measured a -->\nold\n<!-- end of a -->\n<!-- measured b -->\n<!-- end of b -->\n")
    for took_s in (1.23456, 12_345.6):
        results.put_measured(page, "a", [{"files": 10_000, "took_s": took_s}, {"files": 1, "what": "x"}], "Said")
    assert page.read_text() == (
        "before\n<!-- measured a -->\n\nSaid:\n\n| files | took s | what |\n| --- | --- | --- |\n"
        "| 10,000 | 12,346 |  |\n| 1 |  | x |\n\n<!-- end of a -->\n<!-- measured b -->\n<!-- end of b -->\n"
    )
    with pytest.raises(SystemExit, match="measured c"):
        results.put_measured(page, "c", [], "Said")
