"""CONTRIBUTING: its table of imports is the one the tests keep, its walk is in order, and what it names exists.

`python -m tests.test_contributing` writes the table anew.
"""

import ast
import re
from pathlib import Path

import pytest

from tests.test_imports import GROUND, MAY_IMPORT

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "CONTRIBUTING.md"
MARKS = re.compile(r"(<!-- imports -->\n).*?(<!-- end of imports -->)", re.DOTALL)
STOPS = re.findall(r"^\d+\. \[([\w./]+)\]\(([^)]+)\)", PAGE.read_text(), re.MULTILINE)


def imports_table() -> str:
    """Who may import whom, as a table; `evetac_cli` stands for its own names, such as the version."""
    lines = ["| package | may import |", "| --- | --- |"]
    for package, allowed in MAY_IMPORT.items():
        names = [name for name in MAY_IMPORT if name in allowed] + sorted(allowed - set(MAY_IMPORT))
        module = f"{package}.py" if package in GROUND and package != "commands" else package
        lines.append(f"| `{module}` | {', '.join(names) or 'nothing of ours'} |")
    return "\n".join(lines) + "\n"


def with_table(page: str) -> str:
    """The page with the table as it is today."""
    return MARKS.sub(lambda match: f"{match[1]}\n{imports_table()}\n{match[2]}", page)


def test_the_table_of_imports_is_that_of_the_tests() -> None:
    """Assert that the table of CONTRIBUTING is made from MAY_IMPORT; `python -m tests.test_contributing` mends it."""
    assert MARKS.search(PAGE.read_text())
    assert with_table(PAGE.read_text()) == PAGE.read_text()


@pytest.mark.parametrize(("name", "path"), STOPS)
def test_a_stop_exists(name: str, path: str) -> None:
    """Assert that the file that a stop leads to holds the function or method that it names."""
    body: list[ast.stmt] = ast.parse((ROOT / path).read_text()).body
    for part in name.split("."):
        (node,) = [each for each in body if isinstance(each, ast.FunctionDef | ast.ClassDef) and each.name == part]
        body = node.body


def test_the_walk_is_in_order_of_time() -> None:
    """Assert a dozen stops at most, from a camera to a gripper."""
    packages = [Path(path).parts[1] for _, path in STOPS]
    assert 3 <= len(STOPS) <= 12 and packages[0] == packages[-1] == "devices"


def test_the_page_names_what_there_is() -> None:
    """Assert that files and folders that the page names exist, and that files hold the names said to be theirs.

    A path may begin in evetac_cli or scripts.
    """
    page = PAGE.read_text()
    made = (ROOT / ".gitignore").read_text().replace("\n/", "\n").split()  # by `make docs`
    folders = (ROOT, ROOT / "evetac_cli", ROOT / "scripts")
    names = [*re.findall(r"`([\w.-]+/[\w./-]*)`", page), *re.findall(r"\]\((?!http)([^)#]+)", page)]
    assert len(names) > 40
    missing = [name for name in names if "NAME" not in name and not any((at / name).exists() for at in folders)]
    assert [name for name in missing if name not in made] == []
    for name, path in re.findall(r"`(\w+)`[^`.]*?\bof\s+`([\w./-]+\.py)`", page):
        assert any(
            re.search(rf"^(?:def |class )?{name}\b", (at / path).read_text(), re.MULTILINE)
            for at in folders
            if (at / path).exists()
        ), (name, path)


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
