"""Helpers of the tests of importing: recordings made by others, and what `read_events` makes of a file."""

from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.formats.imports import Imported, read_events

FRAME = (640, 480)


def tonic_io() -> Any:
    """The readers of tonic, without the libraries that its data sets need; the test is skipped where it is absent.

    Of the three things that tonic 1.7.0 reads from a head, most of its readers still expect two: they get two.
    """
    package = find_spec("tonic")
    if package is None or package.origin is None:
        pytest.skip("tonic is not installed")
    spec = spec_from_file_location("tonic_io", Path(package.origin).with_name("io.py"))
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    head = module.read_aedat_header_from_file
    of_davis, module.read_davis_346 = module.read_davis_346, None
    module.read_aedat_header_from_file = lambda path: head(path)[:2]

    def read_davis_346(path: Path) -> Any:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "read_aedat_header_from_file", head)
            return of_davis(path)[::2]

    module.read_davis_346 = read_davis_346
    return module


def same(a: Events, b: Events) -> bool:
    """Whether two sets of columns are equal, dtypes included."""
    pairs: list[tuple[Any, Any]] = list(zip(a, b, strict=True))
    return all(np.array_equal(left, right) and left.dtype == right.dtype for left, right in pairs)


def event_rows(imported: Imported) -> list[tuple[int, ...]]:
    """Its events, one (t_us, x, y, p) after the other."""
    return [tuple(int(value) for value in row) for row in zip(*imported.events, strict=True)]


def drawn(count: int, frame_px: tuple[int, int] = FRAME, start_us: int = 1000, seed: int = 4) -> Events:
    """Random events in order of time, in every part of the frame."""
    rng = np.random.default_rng(seed)
    t = start_us + np.cumsum(rng.integers(0, 3000, count))
    x, y, p = (rng.integers(0, most, count) for most in (*frame_px, 2))
    return Events(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))


def assert_equal(imported: Imported, events: Events) -> None:
    """Assert that these events came in, with their times on the file's clock."""
    assert imported.t_offset_us == events.t[0]
    assert same(imported.events, events._replace(t=events.t - events.t[0]))


def refusal(path: Path, **options: Any) -> str:
    """The words with which a file is refused; they name the file and hold no trace of the libraries."""
    with pytest.raises(InputError) as caught:
        read_events(path, **options)
    words = str(caught.value)
    assert words.startswith(f"{path}: ")
    assert not any(trace in words for trace in ("Traceback", "Stacktrace", "std::"))
    return words
