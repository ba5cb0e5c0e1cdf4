"""errors.py: how a hint says what to install, and that no other place says it in another way."""

import ast
import os
import re
import shlex
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from evetac_cli import errors
from evetac_cli.commands import PIPELINE
from evetac_cli.errors import EXTRAS, INSTALLERS, MADE_BY, install_hint, made_by
from evetac_cli.resources import PACKAGE
from evetac_cli.store.calibration import MAKE_GRID
from evetac_cli.store.layout.schema import KINDS

ROOT = PACKAGE.parent
OFFERED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
OTHERS = ("inspect/doctor/__init__.py",)  # it mends a library that is there, but broken or twice


INSTALLS = re.compile(r"pipx? install|evetac\[|'\.\[\w")


def sources() -> list[tuple[str, ast.AST]]:
    """Names and trees of the modules that install anything."""
    texts = [(str(path.relative_to(PACKAGE)), path.read_text()) for path in sorted(PACKAGE.rglob("*.py"))]
    return [
        (name, ast.parse(text))
        for name, text in texts
        if re.search("install_hint|missing_extra", text) or INSTALLS.search(text)
    ]


def test_one_function_makes_all_hints_that_install() -> None:
    """Assert that no other string of the package names pip, pipx or an extra, and that each extra asked for exists.

    An extra that is missing is said by one function, so that it ends with one exit code.
    """
    said, asked, itself = [], set(), set()
    for name, tree in sources():
        docstrings = {
            node.body[0].value
            for node in ast.walk(tree)
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and isinstance(node.body[0], ast.Expr)
        }
        for node in ast.walk(tree):
            called = node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else ""
            if called in ("install_hint", "missing_extra"):
                place = {"install_hint": 0, "missing_extra": 1}[called]
                asked |= {one.value for one in node.args[place : place + 1] if isinstance(one, ast.Constant)}
            if called == "install_hint" and node.args:
                itself.add(name)
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in docstrings:
                said += [name] if INSTALLS.search(node.value) and name != "errors.py" else []
    assert set(said) <= set(OTHERS)
    assert itself <= {"errors.py", "inspect/doctor/__init__.py", "evaluate/picture.py"}  # the last two go on without it
    assert {"camera", "convert", "plot"} <= asked <= EXTRAS.keys()


ASKS = {  # what a message asks for, and the command that it has to name: the one that makes it
    r"--calibration\b": "evetac calibrate",
    r"have no labels": "evetac label",
    r"no dot grid|dots .* (are|is) unknown": "evetac calibrate",
    r"different dot grid from the force|for another dot grid": "evetac train",
    r"but the features have none": "evetac featurize",
    r"tracks of this recording are missing": "evetac track",
    r"no (\w+ )?files? (are|is) (given|named)|no file is left": "evetac|made_by",
    r"has no truth": "evetac record|another --method",
    r"no window": "evetac calibrate",
}


@cache
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


CLONE = {"dir_info": {}, "url": "file://CLONE"}
ORIGINS: dict[str, tuple[dict[str, Any], str]] = {
    "clone, editable": (CLONE | {"dir_info": {"editable": True}}, "WAY --editable 'CLONE[plot]'"),
    "clone": (CLONE, "WAY 'CLONE[plot]'"),
    "clone that is gone": (CLONE | {"url": "file:///gone/evetac"}, "in a clone of evetac: WAY '.[plot]'"),
    "git": (
        {"url": "https://example.org/evetac.git", "vcs_info": {"vcs": "git", "commit_id": "12ab"}},
        "WAY 'evetac[plot] @ git+https://example.org/evetac.git@12ab'",
    ),
    "git, a branch, in a folder": (
        {
            "url": "ssh://git@example.org/lab.git",
            "vcs_info": {"vcs": "git", "commit_id": "12ab", "requested_revision": "stable"},
            "subdirectory": "tools/evetac",
        },
        "WAY 'evetac[plot] @ git+ssh://git@example.org/lab.git@stable#subdirectory=tools/evetac'",
    ),
    "wheel": (
        {"url": "file://WHEEL", "archive_info": {"hash": "sha256=0"}},
        "WAY 'evetac[plot] @ file://WHEEL'",
    ),
    "wheel that is gone": (
        {"url": "file:///gone/evetac-1-py3-none-any.whl", "archive_info": {}},
        "in a clone of evetac: WAY '.[plot]'",
    ),
    "wheel of a page": (
        {"url": "https://example.org/evetac-1-py3-none-any.whl", "archive_info": {}},
        "WAY 'evetac[plot] @ https://example.org/evetac-1-py3-none-any.whl'",
    ),
    "package index": ({"index": True}, "WAY 'evetac[plot]'"),
    "not installed": ({}, "in a clone of evetac: WAY '.[plot]'"),
}


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed package, without its source beside it, and folders `a clone` and `environment`."""
    (tmp_path / "a clone").mkdir()
    (tmp_path / "a clone" / "pyproject.toml").touch()
    (tmp_path / "a.whl").touch()
    (tmp_path / "environment").mkdir()
    monkeypatch.setattr(errors, "PACKAGE", tmp_path / "site-packages" / "evetac_cli")
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "environment"))
    monkeypatch.setattr(errors, "pip", lambda action: f"pip {action}")
    monkeypatch.setattr(errors, "find_spec", lambda name: name == "bokeh" or None)
    return tmp_path


@pytest.mark.parametrize("name", ORIGINS)
@pytest.mark.parametrize("mark", [None, *INSTALLERS])
def test_a_hint_installs_from_where_evetac_came(
    installed: Path, name: str, mark: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert a command that holds wherever it is typed, or that says where, by pip or what made the environment."""
    origin, expected = ORIGINS[name]
    places = {"CLONE": str(installed / "a clone"), "WHEEL": str(installed / "a.whl")}

    def filled(text: str) -> str:
        for place, path in places.items():
            text = text.replace(place, path)
        return text

    if mark is not None:
        (installed / "environment" / mark).touch()
        expected = expected.replace("--editable ", "")
    url = {"url": filled(origin["url"])} if "url" in origin else {}
    monkeypatch.setattr(errors, "_origin", lambda: origin | url)
    assert install_hint("plot") == filled(expected).replace("WAY", INSTALLERS.get(mark or "", "pip install"))


@pytest.mark.parametrize("mark", [None, *INSTALLERS])
def test_a_hint_keeps_the_extras_that_are_there(
    installed: Path, mark: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that extras which are there are named where the environment is made anew, and not where pip adds to it."""
    if mark is not None:
        (installed / "environment" / mark).touch()
    monkeypatch.setattr(errors, "find_spec", lambda name: name in (*EXTRAS["convert"], "bokeh") or None)
    monkeypatch.setattr(errors, "_origin", lambda: {"index": True})
    kept = "[convert,plot]" if mark else "[plot]"
    assert install_hint("plot").endswith(f"'evetac{kept}'")
    assert install_hint() == f"{INSTALLERS.get(mark or '', 'pip install')} " + (
        "'evetac[convert]'" if mark else "evetac"
    )


def test_a_hint_in_the_clone_is_as_the_pages_say(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that in the clone itself the folder is `.`, and that a working folder that is gone does no harm."""
    monkeypatch.setattr(errors, "_origin", dict)
    monkeypatch.setattr(errors, "pip", lambda action: f"pip {action}")
    monkeypatch.chdir(ROOT)
    assert install_hint("plot") == "in the clone: pip install '.[plot]'"
    assert install_hint() == "in the clone: pip install ."
    monkeypatch.chdir(PACKAGE)
    assert install_hint("plot") == f"pip install {shlex.quote(f'{ROOT}[plot]')}"
    monkeypatch.setattr(os, "curdir", str(ROOT / "gone"))
    assert install_hint("plot") == f"pip install {shlex.quote(f'{ROOT}[plot]')}"


def test_pip_is_that_of_this_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that pip is called by name only where that is the one of this Python, and uv where there is no pip."""
    (tmp_path / "pip").touch()
    (tmp_path / "pip").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert errors.pip("install") == f"{shlex.quote(sys.executable)} -m pip install"
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    assert errors.pip("install") == "pip install"
    (tmp_path / "pip").rename(tmp_path / "uv")
    assert errors.pip("install").endswith("python -m pip install")
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    assert errors.pip("uninstall") == f"uv pip uninstall --python {tmp_path / 'python'}"


def test_what_pip_wrote_down_is_that_of_this_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that an installed copy of another place does not say where this one came from."""
    info = tmp_path / "evetac-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: evetac\nVersion: 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert errors._origin() == {}
    monkeypatch.setattr(errors, "PACKAGE", tmp_path / "evetac_cli")
    assert errors._origin() == {"index": True}
    (info / "direct_url.json").write_text('{"url": "https://example.org/a.whl", "archive_info": {}}')
    assert errors._origin()["url"] == "https://example.org/a.whl"
    (info / "direct_url.json").write_text("no JSON")
    assert errors._origin() == {}


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
