"""--preview: shows a camera, and writes nothing."""

from pathlib import Path

import pytest

from evetac_cli.commands.record import Record
from evetac_cli.errors import InputError
from evetac_cli.trials import record
from tests.conftest import Made
from tests.trials.live_view.fake_view import FakeView


def preview(camera: str, folder: Path, **flags: str) -> None:
    params = Record(camera=camera, preview=True, seconds=0.2, **flags)
    (job,) = record.jobs([], params, folder)
    shown = record.run(job, params)
    assert shown.rows[0]["slices"] == 200
    assert shown.rows[0]["events_per_s"] == shown.rows[0]["events"] / 0.2
    assert shown.simulated
    assert list(folder.iterdir()) == []


def test_nothing_is_written(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a preview hands over every slice, with where the dots are, reports its rate and leaves no file."""
    view = FakeView()
    view.put_in_place(monkeypatch)
    preview(f"replay:{made.recordings[0]}", tmp_path)
    assert len(view.slices) == 200
    assert "sensor/dot_xy_px" in view.sensor


@pytest.mark.slow
def test_a_scene_can_be_looked_at(made: Made, tmp_path: Path) -> None:
    """Assert the same of a simulation, with a view."""
    preview("sim", tmp_path, scene=str(made.scene))


def test_a_real_gripper_moves_with_arm_alone(tmp_path: Path) -> None:
    """Assert that a live view of a recording asks for --arm, as the recording does, and a preview does not."""
    named = {"camera": "dvxplorer", "gripper": "/dev/ttyUSB0"}
    with pytest.raises(InputError, match="would move a real gripper"):
        record.jobs([], Record(**named, live=True), tmp_path)
    assert len(record.jobs([], Record(**named, preview=True), tmp_path)) == 1
