"""Tests of the check of CITATION.cff."""

from pathlib import Path

from scripts.docs import check_citation


def test_a_citation_names_authors() -> None:
    """Assert that the file of the repository is valid, and that one without authors is not."""
    citation = (Path(__file__).resolve().parents[3] / "CITATION.cff").read_text("utf-8")
    assert check_citation.faults(citation) == []
    assert check_citation.faults(citation.replace("\nauthors:\n", "\nwriters:\n"))
