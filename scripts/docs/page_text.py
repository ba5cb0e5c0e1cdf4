"""Turn texts of the command line, the schemas and comments into Markdown: tables, code and prose."""

import inspect
import re
from collections.abc import Iterable, Sequence
from typing import Any

MADE = "<!-- made by scripts/docs/pages.py from the code: edit that -->\n\n"
FLAG = re.compile(r"(?<![\w`/-])(--?[a-z][\w-]*(?:/--?[a-z][\w-]*)*)")
MARKS = re.compile(r"([\\*_\[\]<>#|])")  # characters that Markdown would interpret


def code(text: object) -> str:
    """Return a name or value as inline code."""
    return f"`{text}`"


def prose(text: str) -> str:
    """Return plain text as Markdown: flags become code, text in backticks stays code, other characters are escaped."""
    parts = text.replace("\\[", "[").split("`")
    for place in range(0, len(parts), 2):
        pieces = FLAG.split(parts[place])
        parts[place] = "".join(
            MARKS.sub(r"\\\1", piece) if number % 2 == 0 else code(piece) for number, piece in enumerate(pieces)
        )
    return "".join(part if number % 2 == 0 else code(part) for number, part in enumerate(parts))


def sentence(text: str) -> str:
    """Return a text with an initial capital and a final full stop."""
    text = " ".join(text.split())
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", ":", "!", "?")) else ".")


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; cells are Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines) + "\n"


def _cell(text: str) -> str:
    return " ".join(re.sub(r"(?<!\\)\|", r"\|", text).split())


def fenced(text: str, language: str) -> str:
    """Return a block of code."""
    return f"```{language}\n{text.strip()}\n```\n"


def folded(title: str, text: str) -> str:
    """Return a block that opens with a click."""
    indented = "\n".join(f"    {line}" if line else "" for line in text.strip().splitlines())
    return f'??? note "{title}"\n\n{indented}\n'


def bounds(low: float | None, high: float | None, above: float | None = None) -> str:
    """Describe the range of a number, ends included except for `above`; empty if there is no limit."""
    if above is not None:
        return f"above {number(above)}" + ("" if high is None else f", up to {number(high)}")
    if low is None:
        return "" if high is None else f"up to {number(high)}"
    return f"from {number(low)}" if high is None else f"{number(low)} to {number(high)}"


def number(figure: float) -> str:
    """Return a number as text: whole numbers with thousands separators, others in short form."""
    return f"{int(figure):,}" if float(figure).is_integer() and abs(figure) < 1e15 else f"{figure:g}"


def value(item: Any) -> str:
    """Return a TOML or dataclass value as text for readers."""
    if isinstance(item, bool):
        return "yes" if item else "no"
    if isinstance(item, (int, float)):
        return number(item)
    if isinstance(item, (list, tuple)):
        return ", ".join(map(value, item))
    return str(item)


def comments(of: type) -> dict[str, str]:
    """Return the comments after a dataclass's fields, by field name."""
    pattern = re.compile(r"^    (\w+): [^#\n]+#\s*(.+)$", re.MULTILINE)
    return {name: text.removeprefix("...").lstrip() for name, text in pattern.findall(inspect.getsource(of))}
