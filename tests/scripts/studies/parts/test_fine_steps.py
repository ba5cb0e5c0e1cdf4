"""What fine_steps makes of trials whose onsets and outcomes are known, and which trials it still has to run."""

import json
from pathlib import Path
from typing import Any

import pytest

from scripts.studies.parts import fine_steps as compare_steps
from scripts.studies.parts.fine_steps import DEFAULT, FINE


def trial_line(kind: str, number: int, default: dict[str, Any], fine: dict[str, Any]) -> dict[str, Any]:
    """The line of a trial."""
    made = {"kind": kind, "object": 1, "number": number, "seed": 0, "step_ms": 0.1, "commit": "c"}
    return {**made, DEFAULT: default, FINE: fine}


def slip(number: int, *onsets: tuple[int | None, ...]) -> dict[str, Any]:
    """A slip with the onsets t_s, of every node, of labels and of the detection, by default and with the fine step."""
    default, fine = (dict(zip(compare_steps.ONSETS, of_one, strict=True)) for of_one in onsets)
    return trial_line("slip", number, default, fine)


def grasp(number: int, default: bool, fine: bool) -> dict[str, Any]:
    """A grasp that held or not, by default and with the fine step."""
    return trial_line("grasp", number, {"held": default}, {"held": fine})


def table(rows: list[dict[str, Any]], column: str) -> dict[str, dict[str, Any]]:
    """The table whose first column this is, by the values of that column."""
    return {row[column]: row for row in compare_steps.tables(rows) if column in row}


SLIPS = [
    slip(0, (100, 103, 102, 90), (100, 103, 102, 90)),
    slip(1, (200, 200, 200, 215), (201, 203, 190, 225)),
    slip(2, (300, None, None, 240), (302, None, 303, 303)),
]


def test_onsets_that_differ() -> None:
    """Assert how many onsets differ by more than 1 and 5 ms, and that one found in one simulation alone does."""
    onsets = table(SLIPS, "onset")
    assert {name: (row["over_1_ms"], row["over_5_ms"], row["in_one_alone"]) for name, row in onsets.items()} == {
        "t_s": (1, 0, 0), "t_every_node": (1, 0, 0), "label": (2, 2, 1), "detection": (2, 2, 0),
    }  # fmt: skip
    assert onsets["t_s"]["median_apart_ms"] == -1.0
    of_object = table(SLIPS, "object")
    assert len(compare_steps.tables(SLIPS)) == 4 + 5 + 3
    assert of_object[1]["t_s_later_ms"] == -2.0


def test_a_line_that_was_cut_off_is_measured_again(tmp_path: Path) -> None:
    """Assert that whole lines are read, a cut one is removed from the file, and a bad one is not passed by."""
    path = tmp_path / "steps.jsonl"
    assert compare_steps.finished_rows(path) == []
    for content, rows, kept in (
        ('{"seed": 1}\n{"seed": 2}\n', [{"seed": 1}, {"seed": 2}], '{"seed": 1}\n{"seed": 2}\n'),
        ('{"seed": 1}\n{"seed": 2, "hel', [{"seed": 1}], '{"seed": 1}\n'),
        ('{"seed": 1}\n{"seed": 2}', [{"seed": 1}], '{"seed": 1}\n'),
        ('{"see', [], ""),
    ):
        path.write_text(content)
        assert compare_steps.finished_rows(path) == rows
        assert path.read_text() == kept
    path.write_text('{"see\n{"seed": 2}\n')
    with pytest.raises(json.JSONDecodeError):
        compare_steps.finished_rows(path)
