"""info of a folder: counts and the files that fit."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.errors import InputError
from evetac_cli.inspect import folder as folder_info
from tests.conftest import Made
from tests.make import evetac


@pytest.fixture
def folder(made: Made, tmp_path: Path) -> Path:
    """A data set of two trajectories, one in a folder below, and a broken file."""
    (tmp_path / "below").mkdir()
    for path, place in zip(made.recordings[:2], (tmp_path, tmp_path / "below"), strict=True):
        for kind in ("recording", "labels"):
            shutil.copy(made.beside(path, kind), place)
    (tmp_path / "broken.h5").write_text("no")
    return tmp_path


def paths(folder: Path, *conditions: str) -> list[str]:
    return [row["path"] for row in folder_info.answer(folder, conditions).rows]


def test_a_folder_is_counted(folder: Path) -> None:
    """Assert that there is a row for every kind, object, sensor, scene and outcome, and one for the broken file."""
    result = folder_info.answer(folder, ())
    assert result.simulated
    counts = {"folder": str(folder), "files": 5, "unreadable": 1, "foreign": 0}
    assert result.summary.items() >= counts.items()
    kinds = {row["kind"]: row["files"] for row in result.rows if "slices" in row}
    assert kinds == {"labels": 2, "recording": 2}
    for name, value in (("sensor", "evetac"), ("scene", "short"), ("outcome", "slips")):
        assert {name: value, "labels": 2, "recording": 2} in result.rows
    (unreadable,) = [row for row in result.rows if "unreadable" in row]
    assert unreadable["unreadable"] == "broken.h5" and unreadable["reason"]


def test_files_are_selected(folder: Path) -> None:
    """Assert that conditions select as the rows say, by text, number, range, list, truth and absence."""
    rows = folder_info.answer(folder, ("kind=recording,labels",)).rows
    assert len(rows) == 4
    objects = {row["object"] for row in rows}
    for wanted in objects:
        assert paths(folder, f"object={wanted}") == [row["path"] for row in rows if row["object"] == wanted]
    low, high = min(objects), max(objects)
    assert len(paths(folder, f"object={low}-{high}")) == 4
    assert paths(folder, f"object={high + 1}-{high + 9}") == []
    assert len(paths(folder, "simulated=yes", "kind=labels")) == 2
    assert paths(folder, "simulated=no") == []
    assert paths(folder, "kind=none") == ["broken.h5"]
    assert len(paths(folder, "kind=none,labels")) == 3
    assert paths(folder, "sensor=evetac' OR '1'='1") == []


@pytest.mark.parametrize("condition", ["", "object", "objekt=3", "=3", "path; DROP TABLE files=1"])
def test_other_conditions_are_refused(folder: Path, condition: str) -> None:
    """Assert that what names no column is refused with those that there are."""
    with pytest.raises(InputError, match="object, sensor, seed"):
        folder_info.answer(folder, (condition,))


def code_and_answer(*words: Any) -> tuple[int, Any]:
    done = evetac(*words, "--json")
    return done.exit_code, json.loads(done.stdout)


def test_the_command(folder: Path, made: Made) -> None:
    """Assert that info says what it found, and that --where without a folder is refused."""
    code, result = code_and_answer("info", folder, "--where", "kind=labels", "--where", "outcome=slips")
    assert (code, result["summary"]["fit"], len(result["rows"])) == (0, 2, 2)
    code, result = code_and_answer("info", made.recordings[0], "--where", "kind=labels")
    assert (code, result["error"]["where"]) == (2, "--where")
    assert code_and_answer("info", made.recordings[0])[0] == 0
