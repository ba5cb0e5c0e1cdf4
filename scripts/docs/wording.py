"""Count hard words and long sentences in evetac's texts, list its messages, and draw random samples.

    python scripts/docs/wording.py                         # one row per pattern, one column per kind of text
    python scripts/docs/wording.py --list told             # each use of a pattern that wording.toml does not list
    python scripts/docs/wording.py --messages              # every message of the program, file by file
    python scripts/docs/wording.py --draw 10 --seed 43     # ten paragraphs, messages and docstrings, drawn at random
    python scripts/docs/wording.py --root OTHER_CHECKOUT   # the same of another checkout

There are five kinds of text:

- `docs`: paragraphs, list items and table cells of README, CONTRIBUTING and docs/
- `help`: help texts of flags and commands
- `messages`: any other text of four words or more in the package, such as errors, notes and pages
- `docstrings` and `comments`: those of the package, scripts and examples

Code and descriptions of pictures are not counted.

Some uses of a pattern are correct, such as "a cylinder stands upright". wording.toml next to this script lists
them with the reason, and they are counted as `kept`. With --check the exit status is 1 if any other use is left.
"""

import argparse
import ast
import json
import random
import re
import sys
import tokenize
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
KEPT = Path(__file__).with_name("wording.toml")
KINDS = ("docs", "help", "messages", "docstrings", "comments")
MOST_WORDS = 35  # longer sentences are counted as `long`
DRAWN_WORDS = {"docs": 25, "messages": 8}  # minimum length for --draw, to exclude table cells and labels
MESSAGE_WORDS = 4  # minimum length of a string or table cell that is treated as prose
UNIT = "second|millisecond|microsecond|minute|hour|day|ms|s|slice|trial|file|frame|pixel|dot|step|event|grasp|core|cell"
VERBS = "(?:is|was|has|as|this|its|does|takes|makes|gives|uses|needs|holds|shows|writes|ends|follows|moves|unless)"
PATTERNS = {
    "told": r"\b(?:told|tells?|telling)\b",
    "stands": r"\b(?:stands?|stood|standing)\b",
    "lies": r"\b(?:lies|lie|lay|lain)\b",
    "met": r"\b(?:met|meets?)\b",
    "whoever": r"\b(?:who|what|which)ever\b",
    "a for per": rf"(?:\b(?!{VERBS}\b)\w*[a-z]s|\b(?:px|mm|um|ms|MB|kB|GB|N|once|twice)|\d|%) an? (?:{UNIT})\b",
    "at hand": r"\bat hand\b",
    "all the same": r"\ball the same\b",
    "nobody": r"\bnobody\b",
}


class Text(NamedTuple):
    """A piece of prose. place: `file:line`; owner: the heading, function or class that contains it."""

    kind: str
    place: str
    owner: str
    words: str


def markdown_texts(path: Path, root: Path) -> Iterator[Text]:
    """Yield paragraphs, list items and table cells of a page, without code blocks and comments."""
    source = re.sub(r"^```.*?^```$", lambda found: "\n" * found[0].count("\n"), path.read_text(), flags=re.M | re.S)
    source = re.sub(r"<!--.*?-->", lambda found: "\n" * found[0].count("\n"), source, flags=re.S)
    heading, block, first = "", [], 0
    for number, line in enumerate([*source.splitlines(), ""], start=1):
        begins = re.match(r"\s*(?:[-*]|\d+\.) ", line) or line.startswith(("|", "#", "    ")) or not line.strip()
        if begins and block:
            yield Text("docs", f"{path.relative_to(root)}:{first}", heading, " ".join(block))
            block = []
        if line.startswith("#"):
            heading = line.lstrip("# ")
        elif line.startswith("|"):
            for cell in line.strip("| ").split(" | "):
                if len(cell.split()) >= MESSAGE_WORDS:
                    yield Text("docs", f"{path.relative_to(root)}:{number}", heading, cell.strip())
        elif line.strip() and not (line.startswith("    ") and not block):
            first = first if block else number
            block.append(re.sub(r"^\s*(?:[-*]|\d+\.) ", "", line).strip())


def _string(node: ast.expr) -> str | None:
    """Return the text of a string or f-string, with {...} for its values; None for any other expression."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "{...}" for part in node.values)
    return None


def _strings(node: ast.AST, owner: str, is_help: bool) -> Iterator[tuple[int, str, bool, str]]:
    """Yield line, owner, whether it is help, and text of every string below a node, except docstrings."""
    for child in ast.iter_child_nodes(node):
        text = _string(child) if isinstance(child, ast.expr) else None
        if isinstance(child, ast.Expr) and _string(child.value) is not None:
            continue  # a docstring
        if text is not None:
            yield child.lineno, owner, is_help, text
            continue
        name = getattr(child, "name", None) if isinstance(child, (ast.FunctionDef, ast.ClassDef)) else None
        helps = is_help or (isinstance(child, ast.keyword) and child.arg in ("help", "epilog", "short_help"))
        yield from _strings(child, name or owner, helps)


def python_texts(path: Path, root: Path, with_messages: bool) -> Iterator[Text]:
    """Yield docstrings and comments of a module and, with_messages, the texts that it prints."""
    name, tree = path.relative_to(root), ast.parse(path.read_text())
    defines_flags = name.is_relative_to("evetac_cli/commands")
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and (words := ast.get_docstring(node)):
            line = node.body[0].lineno
            owner = getattr(node, "name", "module")
            kind = "help" if defines_flags and isinstance(node, ast.ClassDef) else "docstrings"
            yield Text(kind, f"{name}:{line}", owner, words)
    for line, owner, is_help, words in _strings(tree, "", defines_flags) if with_messages else ():
        if len(re.findall(r"[A-Za-z]{2,}", words.replace("{...}", ""))) >= MESSAGE_WORDS and " " in words.strip():
            yield Text("help" if is_help else "messages", f"{name}:{line}", owner, words)
    block, first, last = [], 0, -1
    with tokenize.open(path) as file:
        for token in [*tokenize.generate_tokens(file.readline), None]:
            if token is not None and token.type != tokenize.COMMENT:
                continue
            if block and (token is None or token.start[0] != last + 1 or token.line.strip() != token.string):
                yield Text("comments", f"{name}:{first}", "", " ".join(block))
                block = []
            if token is not None and not re.match(r"#\s*(?:noqa|type:|mypy|fmt|!)", token.string):
                first = first if block else token.start[0]
                last = token.start[0] if token.line.strip() == token.string else -1  # behind code: a comment by itself
                block.append(token.string.lstrip("# ").rstrip("- "))


def texts(root: Path) -> list[Text]:
    """Return all texts of a checkout, in the order of its files."""
    pages = [root / "README.md", root / "CONTRIBUTING.md", *sorted((root / "docs").glob("*.md"))]
    found = [text for page in pages for text in markdown_texts(page, root)]
    for folder in ("evetac_cli", "scripts", "examples"):
        for path in sorted((root / folder).rglob("*.py")):
            found += python_texts(path, root, folder == "evetac_cli")
    return found


def prose(words: str) -> str:
    """Return a text without code, examples, targets of links and descriptions of pictures."""
    words = re.sub(r"(?m)^\s*(?:>>>|\.\.\.).*$|^ {4,}\S.*$", "", words)
    words = re.sub(r"!\[[^\]]*\]", "", re.sub(r"`[^`]*`", "CODE", words))  # with descriptions of pictures removed
    return re.sub(r"\]\([^)]*\)", "]", words)


def long_sentences(words: str) -> list[str]:
    """Return the sentences of more than MOST_WORDS words; a colon or semicolon does not end a sentence."""
    parts = re.split(r"(?<=[.!?])(?:\*\*)?\s+(?=[A-Z`\[\"(*])|\n\s*\n|\n\s*(?=[-*|] )", prose(words))
    return [" ".join(part.split()) for part in parts if len(re.findall(r"[\w'.-]+", part)) > MOST_WORDS]


def occurrences(found: list[Text], pattern: str) -> Iterator[tuple[Text, str]]:
    """Yield each use of a pattern: the text, and the words around the use."""
    for text in found:
        if pattern == "long":
            yield from ((text, sentence) for sentence in long_sentences(text.words))
            continue
        words = " ".join(prose(text.words).split())
        for match in re.finditer(PATTERNS[pattern], words, re.IGNORECASE):
            yield text, words[max(0, match.start() - 50) : match.end() + 50]


def reason(text: Text, pattern: str, context: str, kept: dict[str, dict[str, str]]) -> str:
    """Return the reason why a use of a pattern may stay; empty if wording.toml does not list it."""
    path = text.place.split(":")[0]
    return next(
        (why for what, why in kept.get(pattern, {}).items() if path.startswith(what) or re.search(what, context, re.I)),
        "",
    )


def main() -> int:
    """Print the counts, or the list that the flags request; return the exit status."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--root", type=Path, default=ROOT, help="checkout to read (default: this one)")
    arguments.add_argument("--list", choices=[*PATTERNS, "long"], help="print each place of a pattern that is not kept")
    arguments.add_argument("--under", default="", help="only files below this path, for example evetac_cli/sim")
    arguments.add_argument("--messages", action="store_true", help="print every message, file by file")
    arguments.add_argument("--draw", type=int, metavar="N", help="print N random paragraphs, messages and docstrings")
    arguments.add_argument("--seed", type=int, default=0, help="seed of --draw (default: 0)")
    arguments.add_argument("--json", action="store_true", help="counts as one JSON object")
    arguments.add_argument(
        "--check", action="store_true", help="exit status 1 if a use is left that wording.toml does not list"
    )
    options = arguments.parse_args()
    found = [text for text in texts(options.root) if text.place.startswith(options.under)]
    kept = tomllib.loads(KEPT.read_text()) if KEPT.exists() else {}
    if options.messages:
        for text in found:
            if text.kind == "messages":
                print(f"{text.place} {text.owner}: {' '.join(text.words.split())}")
        return 0
    if options.draw:
        generator = random.Random(options.seed)
        for kind in ("docs", "messages", "docstrings"):
            long_enough = [
                text for text in found if text.kind == kind and len(text.words.split()) >= DRAWN_WORDS.get(kind, 0)
            ]
            for text in generator.sample(long_enough, options.draw):
                print(f"\n[{kind}] {text.place} {text.owner}\n{text.words}")
        return 0
    if options.list:
        for text, context in occurrences(found, options.list):
            if not reason(text, options.list, context, kept):
                print(f"{text.place} [{text.kind}] {context}")
        return 0
    counts = {name: {kind: [0, 0] for kind in KINDS} for name in [*PATTERNS, "long"]}
    for name, row in counts.items():
        for text, context in occurrences(found, name):
            row[text.kind][bool(reason(text, name, context, kept))] += 1
    left = sum(cell[0] for row in counts.values() for cell in row.values())
    if options.json:
        print(json.dumps({"texts": Counter(text.kind for text in found), "left, kept": counts}, indent=2))
    else:
        print(f"{'':14}" + "".join(f"{kind:>14}" for kind in KINDS) + "     left + kept")
        for name, row in counts.items():
            print(f"{name:14}" + "".join(f"{f'{row[kind][0]} + {row[kind][1]}':>14}" for kind in KINDS))
    return int(options.check and left > 0)


if __name__ == "__main__":
    sys.exit(main())
