"""errors.py: how a hint says what to install, and that no other place says it in another way."""

import ast
import re
import sys
import tomllib
from pathlib import Path

import pytest

from evetac_cli import errors
from evetac_cli.cli.commands import PIPELINE
from evetac_cli.errors import EXTRAS, INSTALLERS, MADE_BY, install_hint, made_by
from evetac_cli.resources import PACKAGE
from evetac_cli.store.calibration import MAKE_GRID
from evetac_cli.store.schema import KINDS

ROOT = PACKAGE.parent
OFFERED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
OTHERS = ("inspect/doctor.py",)  # it mends a library that is there, but broken or twice


INSTALLS = re.compile(r"pipx? install|evetac\[|'\.\[\w")


def sources() -> list[tuple[str, ast.AST]]:
    """Names and trees of the modules that install anything."""
    texts = [(str(path.relative_to(PACKAGE)), path.read_text()) for path in sorted(PACKAGE.rglob("*.py"))]
    return [(name, ast.parse(text)) for name, text in texts if "install_hint" in text or INSTALLS.search(text)]


def test_one_function_makes_all_hints_that_install() -> None:
    """Assert that no other string of the package names pip, pipx or an extra, and that each extra asked for exists."""
    said, asked = [], set()
    for name, tree in sources():
        docstrings = {
            node.body[0].value
            for node in ast.walk(tree)
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and isinstance(node.body[0], ast.Expr)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "install_hint":
                asked |= {one.value for one in node.args if isinstance(one, ast.Constant)}
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in docstrings:
                said += [name] if INSTALLS.search(node.value) and name != "errors.py" else []
    assert set(said) <= set(OTHERS)
    assert {"camera", "convert", "plot"} <= asked <= EXTRAS.keys()


ASKS = {  # what a message asks for, and the command that it has to name: the one that makes it
    r"--calibration\b": "evetac calibrate",
    r"have no labels": "evetac label",
    r"no dot grid|dots .* (are|is) unknown": "evetac calibrate",
    r"dot grid than|for another dot grid": "evetac train",
    r"and the features have none": "evetac featurize",
    r"tracks of this recording are missing": "evetac track",
    r"no (\w+ )?files? (are|is) (given|named)|no file is left": "evetac|made_by",
    r"has no truth": "evetac record|another --method",
    r"no window": "evetac calibrate",
}


def messages() -> list[tuple[str, str]]:
    """Where an error of ours is raised, and its message, what is expected and its hint, as the source has them."""
    kinds = {name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, Exception)}
    texts = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in kinds and node.args:
                parts = [node.args[0], *(key.value for key in node.keywords if key.arg in ("expected", "hint"))]
                text = " ".join(map(ast.unparse, parts))
                for name, words in (("MAKE_GRID", MAKE_GRID), ("MAKE_MODEL", errors.MAKE_MODEL)):
                    text = text.replace(name, words)
                texts.append((f"{path.relative_to(PACKAGE)}:{node.lineno}", text))
    return texts


@pytest.mark.parametrize("asked", ASKS)
def test_what_asks_for_something_names_the_command_that_makes_it(asked: str) -> None:
    """Assert that no message asks for a grid, labels, tracks, features or a model without saying what makes them."""
    asking = [(where, text) for where, text in messages() if re.search(asked, text)]
    assert asking
    assert [(where, text) for where, text in asking if not re.search(ASKS[asked], text)] == []


def test_every_kind_of_file_is_made_by_a_command() -> None:
    """Assert that there is a command for each kind, of this name."""
    assert set(MADE_BY) == set(KINDS)
    assert set(MADE_BY.values()) <= {command.name for command in PIPELINE} | {"evaluate"}
    assert made_by("tracks") == "evetac track makes tracks files"


@pytest.mark.parametrize("mark", [None, *INSTALLERS])
def test_a_hint_installs_into_the_environment_that_it_is_for(
    mark: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert pip in an environment of one's own, and the program that made it where pipx or uv did."""
    if mark is not None:
        (tmp_path / mark).touch()
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setattr(errors, "find_spec", lambda name: name in (*EXTRAS["convert"], "bokeh") or None)
    kept = "convert,plot" if mark else "plot"  # pip adds to what there is, the others make it anew
    assert install_hint("plot") == f"in the clone: {INSTALLERS.get(mark, 'pip install')} '.[{kept}]'"
    assert install_hint() == ("in the clone: pip install ." if mark is None else install_hint("convert"))


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
