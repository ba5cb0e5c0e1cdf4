"""Helpers of the tests of importing: recordings made by others, and what `read_events` makes of a file."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.formats.imports import Imported, read_events
from tests.conftest import DATA

FRAME = (640, 480)


def real(name: str) -> Path:
    """A recording made by others; the test is skipped where the folder is absent."""
    path = DATA / name
    if not path.is_file():
        pytest.skip(f"{name} is not there")
    return path


def same(a: Events, b: Events) -> bool:
    """Whether two sets of columns are equal, dtypes included."""
    pairs: list[tuple[Any, Any]] = list(zip(a, b, strict=True))
    return all(np.array_equal(left, right) and left.dtype == right.dtype for left, right in pairs)


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
