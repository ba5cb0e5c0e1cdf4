"""An extension of griffe, which reads docstrings for mkdocstrings: turns examples (`>>> ...`) into code blocks."""

import re
from typing import Any

import griffe

EXAMPLE = re.compile(r"(?:^[ ]*(?:>>>|\.\.\.).*\n?(?:^[ ]*(?!>>>)\S.*\n?)*)+", re.MULTILINE)


def with_blocks(text: str) -> str:
    """Return a docstring with every example in a fence, together with the output that it prints."""
    return EXAMPLE.sub(lambda match: f"```pycon\n{match[0].rstrip()}\n```\n", text)


class Doctests(griffe.Extension):
    """Puts the examples of all docstrings into code blocks."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of a module, class, function or attribute."""
        if obj.docstring is not None:
            obj.docstring.value = with_blocks(obj.docstring.value)
