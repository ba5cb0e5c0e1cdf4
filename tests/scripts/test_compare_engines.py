"""scripts/compare_engines.py and growth.py: what they compare, and when they say that a stage is not linear."""

import shutil
import subprocess
import sys
import time
from pathlib import Path

import h5py
import pytest

from tests.conftest import Made

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import compare_engines
import growth


def test_another_array_is_seen(made: Made, tmp_path: Path) -> None:
    """Assert that a changed value and a missing file are named, and copies are equal."""
    one, other = tmp_path / "one", tmp_path / "other"
    for folder in (one, other):
        folder.mkdir()
        for kind in ("labels", "tracks"):
            shutil.copy(made.beside(made.recordings[0], kind), folder)
    assert compare_engines.different(one, other) == (2, [])
    labels, tracks = sorted(path.name for path in other.iterdir())
    with h5py.File(other / labels, "r+") as file:
        file["label"][0] += 1
    assert compare_engines.different(one, other) == (2, [labels])
    (one / tracks).unlink()
    assert compare_engines.different(one, other) == (2, [labels, tracks])


@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
def test_a_worker_is_held_to_its_share() -> None:
    """Assert that a busy process gets no more than its share, however busy the machine, and runs on afterwards."""
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        with compare_engines.held_to(0.2, [process]):
            began, before_s = time.monotonic(), compare_engines.cpu_s(process)
            time.sleep(1.0)
            used_s, took_s = compare_engines.cpu_s(process) - before_s, time.monotonic() - began
        assert used_s < 0.6 * took_s
        assert Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0] != "T"
    finally:
        process.kill()
        process.wait()


def test_what_is_not_linear() -> None:
    """Assert that start-up is taken away, and that twice the time of a slice in an hour is 100 % too much."""
    rows = [
        {"stage": "track", "length_s": length, "cpu_s": 2.0 + 0.1 * (length - 1) * (2 if length == 3600 else 1)}
        for length in growth.LENGTHS_S
    ]
    over = [row.get("over_linear") for row in growth.with_linear(rows)]
    assert over == [None, None, pytest.approx(0.0), pytest.approx(1.0)]


def test_stages_are_measured_again() -> None:
    """Assert that rows of some stages take the place of theirs, in order, and that the page says at which commit."""
    old = [{"stage": stage, "length_s": length, "cpu_s": 1.0} for length in (1, 60) for stage in ("track", "import")]
    new = [{"stage": "import", "length_s": length, "cpu_s": 2.0, "commit": "b"} for length in (1, 60)]
    rows = growth.replaced(old, new)
    assert [(row["length_s"], row["stage"], row["cpu_s"]) for row in rows] == [
        (1, "track", 1.0), (1, "import", 2.0), (60, "track", 1.0), (60, "import", 2.0),
    ]  # fmt: skip
    assert growth.said({"commit": "a", "rows": rows}) == "Simulated, by growth.py at commit a; import at commit b"
