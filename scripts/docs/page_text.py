"""Text of the command line, of schemas and of comments as Markdown: tables, code, and prose that stays as it was."""

import inspect
import re
from collections.abc import Iterable, Sequence
from typing import Any

MADE = "<!-- made by scripts/docs/pages.py from the code: edit that -->\n\n"
FLAG = re.compile(r"(?<![\w`/-])(--?[a-z][\w-]*(?:/--?[a-z][\w-]*)*)")
MARKS = re.compile(r"([\\*_\[\]<>#|])")  # what Markdown takes for more than a sign


def code(text: object) -> str:
    """A name or value as code."""
    return f"`{text}`"


def prose(text: str) -> str:
    """Plain text as Markdown: flags become code, what stands in backticks stays, all other signs are themselves."""
    parts = text.replace("\\[", "[").split("`")
    for place in range(0, len(parts), 2):
        pieces = FLAG.split(parts[place])
        parts[place] = "".join(
            MARKS.sub(r"\\\1", piece) if number % 2 == 0 else code(piece) for number, piece in enumerate(pieces)
        )
    return "".join(part if number % 2 == 0 else code(part) for number, part in enumerate(parts))


def sentence(text: str) -> str:
    """A text with a capital at its beginning and a full stop at its end."""
    text = " ".join(text.split())
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", ":", "!", "?")) else ".")


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; cells are Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines) + "\n"


def _cell(text: str) -> str:
    return " ".join(re.sub(r"(?<!\\)\|", r"\|", text).split())


def fenced(text: str, language: str) -> str:
    """A block of code."""
    return f"```{language}\n{text.strip()}\n```\n"


def folded(title: str, text: str) -> str:
    """A block that opens with a click."""
    indented = "\n".join(f"    {line}" if line else "" for line in text.strip().splitlines())
    return f'??? note "{title}"\n\n{indented}\n'


def bounds(low: float | None, high: float | None, above: float | None = None) -> str:
    """The range of a number in words, ends included but for `above`; nothing where there is none."""
    if above is not None:
        return f"above {number(above)}" + ("" if high is None else f", up to {number(high)}")
    if low is None:
        return "" if high is None else f"up to {number(high)}"
    return f"from {number(low)}" if high is None else f"{number(low)} to {number(high)}"


def number(figure: float) -> str:
    """A number as a reader writes it: whole ones in full."""
    return f"{int(figure):,}" if float(figure).is_integer() and abs(figure) < 1e15 else f"{figure:g}"


def value(item: Any) -> str:
    """A value of a table in TOML or of a dataclass, as a reader writes it."""
    if isinstance(item, bool):
        return "yes" if item else "no"
    if isinstance(item, (int, float)):
        return number(item)
    if isinstance(item, (list, tuple)):
        return ", ".join(map(value, item))
    return str(item)


def comments(of: type) -> dict[str, str]:
    """What a dataclass says of its fields, by their names: the comments behind them."""
    pattern = re.compile(r"^    (\w+): [^#\n]+#\s*(.+)$", re.MULTILINE)
    return {name: said.removeprefix("...").lstrip() for name, said in pattern.findall(inspect.getsource(of))}
