"""Tables of predictions: complete ones come back as they were written, others are refused with file and line."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.evaluate.benchmark import predictions
from evetac_cli.evaluate.benchmark.data_set import Benchmark, Truth
from evetac_cli.evaluate.benchmark.predictions import Predictions


def some(bench: Benchmark, true: dict[str, Truth]) -> Predictions:
    """Predictions for all tasks, from random numbers."""
    rng = np.random.default_rng(0)
    return Predictions(
        onset_ms={"r0": 12, "r1": None},
        warning={name: rng.random(true[name].slices).astype(np.float32) for name in ("r0", "r1", "r3")},
        force_n={"r2": rng.normal(size=true["r2"].shear_n.shape)},
        dot_xy_px={name: rng.normal(size=one.dot_xy_px.shape) for name, one in true.items()},
    )


def test_tables_come_back(bench: Benchmark, true: dict[str, Truth], tmp_path: Path) -> None:
    """Assert that predictions read from their tables equal those that were written, to the last digit."""
    made = some(bench, true)
    predictions.write(tmp_path, made, true)
    again = predictions.read(tmp_path, bench, true)
    assert again.onset_ms == made.onset_ms
    for task in ("warning", "force_n", "dot_xy_px"):
        ours, theirs = getattr(made, task), getattr(again, task)
        assert ours.keys() == theirs.keys()
        assert all(np.array_equal(ours[name], theirs[name]) for name in ours)
    assert set(again.tables) == set(predictions.COLUMNS)


def test_a_score_holds_until_the_next() -> None:
    """Assert that a ms without a score has the one before, and none before the first."""
    score = np.array([np.nan, 0.25, np.nan, np.nan, 0.5, np.nan], np.float32)
    assert np.array_equal(predictions.held_on(score), [np.nan, 0.25, 0.25, 0.25, 0.5, 0.5], equal_nan=True)


CASES = {
    "another column": ("onset", lambda text: text.replace("onset_ms", "onset"), 1, "recording, onset_ms"),
    "a missing cell": ("onset", lambda text: text.replace("r0,12", "r0"), 2, "2 cells"),
    "an unknown recording": ("onset", lambda text: text.replace("r1,", "r9,"), 3, "kind slip"),
    "a text for a number": ("onset", lambda text: text.replace("r0,12", "r0,soon"), 2, "whole number"),
    "after the end": ("onset", lambda text: text.replace("r0,12", "r0,999999"), 2, "from 0 to"),
    "twice": ("onset", lambda text: text + "r0,13\n", 4, "one row for each"),
    "missing": ("onset", lambda text: text.replace("r0,12\n", ""), None, "one for r0"),
    "times that go back": ("warning", lambda text: text + "r3,0,0.5\n", None, "above"),
    "another instant": ("force", lambda text: text.replace("r2,100,", "r2,101,"), 2, "an instant of r2"),
    "a dot too few": ("dots", lambda text: re.sub(r"r0,100,3,.*\n", "", text), None, "r0 at 100 ms, dot 3"),
}


@pytest.mark.parametrize("case", CASES)
def test_wrong_tables_are_refused(case: str, bench: Benchmark, true: dict[str, Truth], tmp_path: Path) -> None:
    """Assert that the error of a wrong table names file, line if there is one, and what is expected."""
    task, change, line, expected = CASES[case]
    assert isinstance(change, Callable)
    predictions.write(tmp_path, some(bench, true), true)
    path = tmp_path / f"{task}.csv"
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError) as caught:
        predictions.read(path, bench, true)
    said = str(caught.value)
    assert path.name in said and expected in said
    if line is not None:
        assert f"line {line}" in said


@pytest.mark.parametrize("name", ["", "no such folder"])
def test_folders_without_a_table_are_refused(name: str, tmp_path: Path) -> None:
    """Assert that an empty folder and a missing one are refused."""
    with pytest.raises(InputError):
        predictions.find(tmp_path / name)
