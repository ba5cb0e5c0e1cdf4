"""The fuzzer: the same damage from the same seed, damage that damages, and a thousand damaged files."""

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from scripts.attack.fuzz import mutations

ROOT = Path(__file__).resolve().parents[3]
FUZZ = ROOT / "scripts" / "attack" / "fuzz"


@pytest.mark.parametrize("family", ["bytes", "text", "hdf5"])
def test_the_same_seed_does_the_same_damage(family: str, tmp_path: Path) -> None:
    made = []
    for name in ("a", "b"):
        path = tmp_path / name
        if family == "hdf5":
            with h5py.File(path, "w") as file:
                file["events/t"] = np.arange(50)
                file["sensor/name"] = "evetac"
        else:
            path.write_bytes(b"key = 12.5\n[table]\nother = 7\n" * 5)
        made.append([mutations.mutate(path, family, np.random.default_rng([3, number])) for number in range(20)])
    assert made[0] == made[1]


def test_most_damage_changes_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a"
    whole = b"key = 12.5\n[table]\nother = 7\n" * 5
    changed = 0
    for number in range(100):
        path.write_bytes(whole)
        mutations.mutate(path, "text", np.random.default_rng(number))
        changed += path.read_bytes() != whole
    assert changed > 90


@pytest.mark.slow
def test_a_thousand_damaged_files(tmp_path: Path) -> None:
    command = [sys.executable, str(FUZZ / "run.py"), str(tmp_path / "fuzz.jsonl"), "--count", "1000", "--seed", "1"]
    result = subprocess.run(
        [*command, "--corpus", str(tmp_path / "corpus")], check=False, capture_output=True, text=True, cwd=ROOT
    )
    assert result.returncode == 0, result.stdout[-4000:] + result.stderr[-2000:]
