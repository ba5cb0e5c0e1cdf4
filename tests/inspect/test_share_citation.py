"""share: how cards say to cite a thing, and which evetac made it."""

import re
from pathlib import Path

from evetac_cli import __version__
from evetac_cli.commands.share import Share
from evetac_cli.inspect.share import sections
from tests import small_files
from tests.inspect.test_share import shared

ROOT = Path(__file__).resolve().parents[2]


def test_the_paper_is_that_of_citation_cff() -> None:
    """Assert that authors, title, journal and year are those of CITATION.cff."""
    paper = (ROOT / "CITATION.cff").read_text().partition("preferred-citation:")[2]
    people = re.findall(r"family-names: (\S+), given-names: (\S+)}", paper)
    assert " and ".join(f"{family}, {given}" for family, given in people) in sections.PAPER
    for name in ("title", "journal"):
        (value,) = re.findall(rf'^  {name}: "(.+)"$', paper, re.MULTILINE)
        assert value in sections.PAPER
    (year,) = re.findall(r"^  year: (\d+)$", paper, re.MULTILINE)
    assert f"year = {{{year}}}" in sections.PAPER


def test_nobody_is_invented() -> None:
    """Assert that without an author there is no entry of the thing itself, and that it is said."""
    page = "\n".join(sections.citation(Share(), "Slips", "data set", "2026"))
    assert page.count("@") == 1 and "not named; `evetac share --author` adds" in page


def test_odd_names_stay_one_entry() -> None:
    """Assert that no text ends a field, a block or the page, whatever signs it has."""
    page = sections.citation(Share(author="A} }\n```\n# B & C_1 \\x"), "100 % {slip}\n", "model", None)
    entry = page[-1]
    assert entry.count("```") == 3 and re.findall(r"^```.*$", entry, re.MULTILINE) == ["```bibtex", "```"]
    assert "author = {A\\} \\} ``` \\# B \\& C\\_1 \\textbackslash{}x}," in entry
    assert "title = {{100 \\% \\{slip\\}}}," in entry and "year" not in entry
    assert entry.splitlines()[1] == "@misc{100-slip,"


def test_a_card_says_what_made_it(tmp_path: Path) -> None:
    """Assert that version, numbers of formats and the command that uploads stand in the card and the answer."""
    folder = tmp_path / "a trial"
    folder.mkdir()
    small_files.recording(folder / "a.recording.h5")
    row = shared(folder, out=tmp_path / "hub", tables="none")
    page = (tmp_path / "hub" / "README.md").read_text()
    assert f"written by evetac {__version__}, files by evetac {__version__}." in page
    assert re.search(r"files \(`schemas/` in evetac\): recording \d\.\d+\.", page)
    assert "`hf upload NAME/a-trial . --repo-type dataset`" in page
    assert row["upload"] == f"hf upload NAME/a-trial {tmp_path / 'hub'} --repo-type dataset"
