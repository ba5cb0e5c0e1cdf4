"""scripts/words.py, which `make check` runs: it sees every kind of place."""

import ast
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import words

PLANTED = '''
def look(thing: int, *, ahead: int = 0) -> None:
    """Prose is free: thing, look, told."""
    told = open(found="--crossings 3")
    told.carried = {"control/drag_px": thing}
'''


def test_every_kind_of_place_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that names, arguments, attributes, strings and flags of a module are found, and prose is not."""
    monkeypatch.setattr(words, "ROOT", tmp_path)
    path = tmp_path / "planted.py"
    path.write_text(PLANTED)
    ast.parse(PLANTED)
    places = {(place.kind, place.word) for place in words.python_places(path)}
    assert {("name", "look"), ("name", "thing"), ("name", "ahead"), ("name", "told"), ("name", "carried")} <= places
    assert {("text", "control/drag_px"), ("flag", "--crossings")} <= places
    assert ("name", "found") not in places


@pytest.mark.parametrize(
    ("places", "word"),
    [
        (words.module_places, "tracker"),
        (words.command_places, "trim"),
        (words.dataset_places, "sensor/name"),
        (words.make_places, "JOBS"),
    ],
)
def test_other_places_are_listed(places, word: str) -> None:
    """Assert that modules, commands, datasets and make variables are there to be compared."""
    assert word in {place.word for place in places()}
