"""What tests of importing ask of `read_events`."""

from pathlib import Path
from typing import Any

import pytest

from evetac_cli.errors import InputError
from evetac_cli.formats.imports import Imported, read_events


def event_rows(imported: Imported) -> list[tuple[int, ...]]:
    """Its events, one (t_us, x, y, p) after the other."""
    return [tuple(int(value) for value in row) for row in zip(*imported.events, strict=True)]


def refusal(path: Path, **options: Any) -> str:
    """The words with which a file is refused; they name the file and hold no trace of the libraries."""
    with pytest.raises(InputError) as caught:
        read_events(path, **options)
    words = str(caught.value)
    assert words.startswith(f"{path}: ")
    assert not any(trace in words for trace in ("Traceback", "Stacktrace", "std::"))
    return words
