"""errors.py: how a hint says what to install, and that no other place says it in another way."""

import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest

from evetac_cli.commands import PIPELINE
from evetac_cli.errors import EXTRAS, MADE_BY, install_hint, made_by
from evetac_cli.resources import PACKAGE
from evetac_cli.store.layout.schema import KINDS

ROOT = PACKAGE.parent
OFFERED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def test_every_kind_of_file_is_made_by_a_command() -> None:
    """Assert that there is a command for each kind, of this name."""
    assert set(MADE_BY) == set(KINDS)
    assert set(MADE_BY.values()) <= {command.name for command in PIPELINE} | {"evaluate"}
    assert made_by("tracks") == "evetac track makes tracks files"


def test_a_hint_installs_into_the_environment_that_runs() -> None:
    """Assert the command, with and without an extra."""
    assert install_hint() == f"in the clone of evetac: {shlex.quote(sys.executable)} -m pip install ."
    assert install_hint("plot").endswith(" -m pip install '.[plot]'")


def test_the_page_on_installing_has_every_extra() -> None:
    """Assert a row for each extra that a user may want, with the libraries that it brings."""
    rows = re.findall(r"^\| `(\w+)` \| ([^|]+) \|", (ROOT / "docs" / "install.md").read_text(), re.MULTILINE)
    brought = {extra: [re.split("[><=]", one)[0] for one in OFFERED[extra]] for extra in EXTRAS}
    assert {extra: libraries.split(", ") for extra, libraries in rows if extra in brought} == brought


@pytest.mark.parametrize("page", [ROOT / "README.md", ROOT / "Dockerfile", *sorted((ROOT / "docs").rglob("*.md"))])
def test_extras_that_pages_name_can_be_installed(page: Path) -> None:
    """Assert that a page names extras of a folder, of a clone, and only such as there are."""
    text = page.read_text()
    assert not re.search(r"install ['\"]?evetac\b", text)
    named = {extra for listed in re.findall(r"install [^\n`]*\[([\w,]+)\]", text) for extra in listed.split(",")}
    assert named <= OFFERED.keys()
