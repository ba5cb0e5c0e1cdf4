"""docs/add-your-own.md: the code that it shows is that of tests/plugin, which is tested.

`python -m tests.test_add_your_own` writes it anew.
"""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "add-your-own.md"
SHOWN = re.compile(r"<!-- ([\w./-]+) -->\n(?:\n```\w+\n.*?\n```\n)?", re.DOTALL)
LANGUAGES = {".py": "python", ".toml": "toml"}


def with_code(page: str) -> str:
    """The page with the code as it is today, a block behind the comment that names its file."""

    def block(match: re.Match[str]) -> str:
        path = ROOT / "tests" / "plugin" / match[1]
        return f"<!-- {match[1]} -->\n\n```{LANGUAGES[path.suffix]}\n{path.read_text().strip()}\n```\n"

    return SHOWN.sub(block, page)


def test_the_page_shows_the_code() -> None:
    """Assert that each block is the file that it names; `python -m tests.test_add_your_own` mends it."""
    page = PAGE.read_text()
    assert with_code(page) == page


def test_the_page_shows_every_module() -> None:
    """Assert that no module of the package is left out."""
    folder = ROOT / "tests" / "plugin"
    modules = {str(path.relative_to(folder)) for path in folder.rglob("*.py") if path.name != "__init__.py"}
    assert modules <= {match[1] for match in SHOWN.finditer(PAGE.read_text())}


if __name__ == "__main__":
    PAGE.write_text(with_code(PAGE.read_text()))
