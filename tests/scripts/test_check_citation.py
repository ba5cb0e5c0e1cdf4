"""Tests of the check of CITATION.cff."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts" / "docs"))
import check_citation


def test_a_citation_names_authors() -> None:
    """Assert that the file of the repository is valid, and that one without authors is not."""
    citation = (Path(__file__).resolve().parents[2] / "CITATION.cff").read_text("utf-8")
    assert check_citation.faults(citation) == []
    assert check_citation.faults(citation.replace("\nauthors:\n", "\nwriters:\n"))
