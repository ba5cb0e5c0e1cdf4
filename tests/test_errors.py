"""errors.py: the checks of numbers, how a hint says what to install, and that no other place says it in another way."""

import math
import re
import shlex
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.commands import pipeline
from evetac_cli.errors import EXTRAS, MADE_BY, check_range, check_whole, install_hint, made_by
from evetac_cli.resources import PACKAGE
from evetac_cli.store.layout.schema import KINDS

ROOT = PACKAGE.parent
OFFERED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def test_every_kind_of_file_is_made_by_a_command() -> None:
    """Assert that there is a command for each kind, of this name."""
    assert set(MADE_BY) == set(KINDS)
    assert set(MADE_BY.values()) <= {command.name for command in pipeline()} | {"evaluate"}
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


# --- numbers out of range -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "ends", "words"),
    [
        (-0.1, {}, "0 or more, found -0.1"),
        (math.inf, {}, "0 or more, finite, found inf"),
        (math.nan, {}, "0 or more, found nan"),
        (0.0, {"above": True}, "above 0, found 0.0"),
        (101.0, {"high": 100, "unit": "ticks"}, "0 to 100 ticks, found 101.0"),
        (1.0, {"high": 1.0, "below": True}, "0 to below 1, found 1.0"),
        (0.0, {"high": 1.0, "above": True}, "above 0 to 1, found 0.0"),
        (1.0, {"high": 1.0, "above": True, "below": True}, "above 0 to below 1, found 1.0"),
    ],
)
def test_a_number_out_of_range_is_refused(value: float, ends: dict[str, float], words: str) -> None:
    """Assert that ends belong to a range unless said, and that the error names range and number."""
    with pytest.raises(ValueError, match=f"^share: expected {words}$"):
        check_range("share", value, **ends)  # type: ignore[arg-type]


def test_ends_belong_to_a_range() -> None:
    """Assert that both ends are in the range, and infinity where it is named as the end."""
    for value in (0.0, 1.0):
        check_range("share", value, 0.0, 1.0)
    check_range("at_s", math.inf, 0.0, math.inf)


def test_whole_numbers() -> None:
    """Assert that numpy's integers are whole numbers, that a float is none, and that steps are kept."""
    check_whole("count", np.int64(3), 0, 3)
    for value, words in ((3.0, "a whole number, found 3.0"), (4, "0 to 3, found 4")):
        with pytest.raises(ValueError, match=f"count: expected {words}"):
            check_whole("count", value, 0, 3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="0 to 508 in steps of 2, found 3"):
        check_whole("delay_us", 3, 0, 508, step=2)
