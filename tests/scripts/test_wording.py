"""scripts/docs/wording.py: uses of hard words and long sentences are found in every kind of text, and nowhere else."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts" / "docs"))
import wording

PAGE = """# A page

The sensor was told of it. `told` in code does not count.

    evetac told

| column | what the second column tells |
"""
MODULE = '''"""Docstring of a module that stands here."""

LIMIT = 3  # events a slice
raise ValueError("nobody can read this file")
'''


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout with one page and one module."""
    for folder in ("docs", "evetac_cli", "scripts", "examples"):
        (tmp_path / folder).mkdir()
    (tmp_path / "README.md").write_text(PAGE)
    (tmp_path / "CONTRIBUTING.md").write_text("# Contributing\n")
    (tmp_path / "evetac_cli" / "a.py").write_text(MODULE)
    return tmp_path


@pytest.mark.parametrize(
    ("pattern", "kinds"),
    [
        ("told", ["docs", "docs"]),
        ("stands", ["docstrings"]),
        ("a for per", ["comments"]),
        ("nobody", ["messages"]),
        ("met", []),
    ],
)
def test_uses_are_found_by_kind(checkout: Path, pattern: str, kinds: list[str]) -> None:
    """Assert that a use is found in its kind of text, and that code is not read."""
    assert [text.kind for text, _ in wording.occurrences(wording.texts(checkout), pattern)] == kinds


def test_a_sentence_ends_at_a_full_stop() -> None:
    """Assert that words are counted per sentence, and that a semicolon does not end one."""
    half = " ".join(["word"] * 20)
    assert wording.long_sentences(f"{half}. {half.capitalize()}.") == []
    assert len(wording.long_sentences(f"{half}; {half}.")) == 1


def test_a_listed_use_has_its_reason(checkout: Path) -> None:
    """Assert that a use is excused by its words or by its path, and by nothing else."""
    text, context = next(wording.occurrences(wording.texts(checkout), "stands"))
    assert wording.reason(text, "stands", context, {"stands": {"stands here": "literal"}}) == "literal"
    assert wording.reason(text, "stands", context, {"stands": {"evetac_cli/a.py": "stored"}}) == "stored"
    assert wording.reason(text, "stands", context, {"told": {"stands here": "literal"}}) == ""
