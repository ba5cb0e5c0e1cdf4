"""For griffe, which reads docstrings for mkdocstrings: examples (`>>> ...`) become blocks of code."""

import re
from typing import Any

import griffe

EXAMPLE = re.compile(r"(?:^[ ]*(?:>>>|\.\.\.).*\n?(?:^[ ]*(?!>>>)\S.*\n?)*)+", re.MULTILINE)


def with_blocks(text: str) -> str:
    """A docstring in which every example is fenced; what an example prints belongs to it."""
    return EXAMPLE.sub(lambda match: f"```pycon\n{match[0].rstrip()}\n```\n", text)


class Doctests(griffe.Extension):
    """Puts the examples of all docstrings into blocks."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for every module, class, function and attribute."""
        if obj.docstring is not None:
            obj.docstring.value = with_blocks(obj.docstring.value)
