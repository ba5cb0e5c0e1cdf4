"""The camera's part of the stability suite in a short form: extremes stay sane, and wrong events would be seen."""

import numpy as np
import pytest

from evetac_cli.numerics.camera import stability
from evetac_cli.numerics.camera.stability import CameraCase, camera_cases, camera_row
from evetac_cli.sim.camera.scanning import camera


@pytest.mark.parametrize("case", camera_cases(), ids=lambda case: case.name)
def test_extremes_of_the_camera(case):
    """Assert that slices are empty, full or wild as they should be, and their events in order and in the frame."""
    row = camera_row(case, slices=2)
    assert row["ok"], row
    assert row["outcome"].startswith("finite")  # a valid case may not hide behind a refusal


def test_wrong_events_are_seen(monkeypatch):
    """Assert that too many events, times out of the slice and pixels out of the frame are not ok."""
    shift = {"t": 0, "x": 0}

    def step(*given):
        events = real(*given)
        return events._replace(t=events.t + shift["t"], x=events.x + shift["x"])

    real = camera.step
    monkeypatch.setattr(stability.camera, "step", step)
    moving = CameraCase("moving", camera.CameraModel(), dots=lambda k: (3.0 * k, 0.0))
    assert camera_row(moving, 2)["ok"]
    shift["t"] = 1000
    assert "time stamps of slice 0" in camera_row(moving, 1)["outcome"]
    shift.update(t=0, x=np.uint16(600))
    assert "coordinates of slice 0" in camera_row(moving, 1)["outcome"]
    shift.update(x=0)
    few = CameraCase("moving", moving.model, dots=moving.dots, events=(0, 3))
    assert not camera_row(few, 1)["ok"]
    assert "events in slice 0" in camera_row(few, 1)["outcome"]
