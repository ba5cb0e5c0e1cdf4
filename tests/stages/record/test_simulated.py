"""Recordings of simulated scenes: the progress that is reported while they are made."""

from pathlib import Path

import pytest

from evetac_cli.params.recording import Record
from evetac_cli.stages import record

SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("scene", "most_off"),
    [
        ("rest", 0.0),
        pytest.param("press", 0.0, marks=SLOW),
        pytest.param("edge", 0.0, marks=SLOW),
        pytest.param("vibration", 0.0, marks=SLOW),
        pytest.param("handling", 0.0, marks=SLOW),
        pytest.param("slip", 0.1, marks=SLOW),
    ],
)
def test_progress_ends_at_its_total(scene: str, most_off: float, tmp_path: Path) -> None:
    """Assert that the total is known from the start, about so where an object slips out, and is reached at the end."""
    params = Record(scene=scene, tones="300" if scene == "vibration" else None)
    (job,) = record.jobs([], params, tmp_path)
    reports: list[tuple[float, float]] = []
    outcome = record.run(job, params, progress=lambda done, total, doing="": reports.append((done, total)))
    slices = outcome.rows[0]["slices"]
    assert reports[-1] == (slices, slices)
    assert [done for done, _ in reports[:-1]] == list(range(100, slices + 1, 100))
    assert all(done <= total for done, total in reports)
    assert reports[0][1] == pytest.approx(slices, rel=most_off, abs=0)
