"""The recipe of evetac-bench: its trials, seeds, sensors and objects, and that no method learned from them."""

import hashlib
import json
from pathlib import Path

import pytest

from scripts.benchmark import files, make
from scripts.benchmark import trials as benchmark_trials
from scripts.studies import motions

ROOT = Path(__file__).resolve().parents[3]
RECIPE = benchmark_trials.recipe()
SIZES = ("small", "full")


def test_the_small_version_is_part_of_the_full_one() -> None:
    """Assert that its trials, with their names and seeds, are all in the full version, and names are unique."""
    small, full = (benchmark_trials.slots(RECIPE, size) for size in SIZES)
    assert set(small) < set(full)
    assert len({slot.name for slot in full}) == len({slot.seed for slot in full}) == len(full)


def test_seeds_and_sensors_are_those_of_the_benchmark() -> None:
    """Assert that seeds and sensors are within 105000 to 105999, and two splits share none."""
    full = benchmark_trials.slots(RECIPE, "full")
    sensors = {
        slot.split: {
            name for one in full if one.split == slot.split for name, _ in benchmark_trials.candidates(RECIPE, one)
        }
        for slot in full
    }
    numbers = {int(name.partition(":")[2]) for names in sensors.values() for name in names if name != "evetac"}
    assert all(105_000 <= number <= 105_999 for number in numbers | {slot.seed for slot in full})
    assert sensors["known-sensor"] == {"evetac"}
    assert not sensors["known-object"] & sensors["all-new"]


def test_no_constant_saw_the_seeds() -> None:
    """Assert that no group of scripts/reproduce/seeds.json has a seed of the make."""
    for group in json.loads((ROOT / "scripts" / "reproduce" / "seeds.json").read_text())["groups"]:
        for one in group["seeds"] or []:
            first, last = one if isinstance(one, list) else (one, one)
            assert last < 105_000 or first > 105_999, group["name"]


def test_known_objects_were_trained_on() -> None:
    """Assert that the objects of `known-object` are among those that weights were fitted to, and new ones are not."""
    assert set(RECIPE["known_objects"]) <= set(motions.TRAINED)
    for slot in benchmark_trials.slots(RECIPE, "full"):
        name = benchmark_trials.object_of(RECIPE, slot)[1]
        assert name.startswith("paper-") == (slot.split == "known-object")


def test_digests_are_those_of_the_recipe() -> None:
    """Assert that the digests in the repository are of this recipe, and of all recordings of the small size."""
    about = json.loads(make.digests_path("small").read_text())
    recorded = {slot.name for slot in benchmark_trials.slots(RECIPE, "small") if slot.kind != "grip"}
    assert set(about["recordings"]) == recorded
    assert about["method"] == files.METHOD
    assert about["recipe_sha256"] == hashlib.sha256(benchmark_trials.RECIPE.read_bytes()).hexdigest()


def test_finished_recordings_are_kept_for_the_same_recipe_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a recording whose row exists is not simulated again, unless the recipe is another one."""
    parts = tmp_path / "a.parts"
    files._prepare_parts(parts)
    slot = benchmark_trials.slots(RECIPE, "small")[0]
    (parts / "rows" / f"{slot.name}.json").write_text('{"recording": "known"}')
    files._prepare_parts(parts)
    assert files._record((RECIPE, slot, parts)) == {"recording": "known"}
    other = tmp_path / "recipe.toml"
    other.write_text(benchmark_trials.RECIPE.read_text() + "\n")
    monkeypatch.setattr(files, "RECIPE", other)
    files._prepare_parts(parts)
    assert list((parts / "rows").iterdir()) == []
