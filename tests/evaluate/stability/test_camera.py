"""The camera's part of the stability suite in a short form: extremes stay sane, and wrong events would be seen."""

import numpy as np
import pytest

from evetac_cli.evaluate.stability import camera as stability
from evetac_cli.evaluate.stability.bounds import EVENTS, FINITE, ORDER
from evetac_cli.evaluate.stability.camera import CameraCase, camera_cases, camera_rows
from evetac_cli.sim.camera.scanning import camera


def not_ok(rows):
    return {row["quantity"] for row in rows if not row["ok"]}


@pytest.mark.parametrize("case", camera_cases(), ids=lambda case: case.name)
def test_extremes_of_the_camera(case):
    """Assert that slices are empty, full or wild as they should be, and their events in order and in the frame."""
    rows = camera_rows(case, slices=2)
    assert not not_ok(rows), rows
    assert [row["quantity"] for row in rows] == [FINITE.quantity, EVENTS.quantity, ORDER.quantity]


def test_wrong_events_are_seen(monkeypatch):
    """Assert that too many events, times out of the slice and pixels out of the frame are not ok."""
    shift = {"t": 0, "x": 0}

    def step(*given):
        events = real(*given)
        return events._replace(t=events.t + shift["t"], x=events.x + shift["x"])

    real = camera.step
    monkeypatch.setattr(stability.camera, "step", step)
    moving = CameraCase("moving", camera.CameraModel(), dots=lambda k: (3.0 * k, 0.0))
    assert not not_ok(camera_rows(moving, 2))
    shift["t"] = 1000
    assert not_ok(camera_rows(moving, 1)) == {ORDER.quantity}
    shift.update(t=0, x=np.uint16(600))
    assert not_ok(camera_rows(moving, 1)) == {ORDER.quantity}
    shift.update(x=0)
    few = CameraCase("moving", moving.model, dots=moving.dots, events=(0, 3))
    assert not_ok(camera_rows(few, 1)) == {EVENTS.quantity}


def test_a_reference_that_is_no_number_is_seen(monkeypatch):
    """Assert that a pixel whose reference became NaN is counted."""

    def step(state, *given):
        events = real(state, *given)
        state.reference.flat[7] = np.nan
        return events

    real = camera.step
    monkeypatch.setattr(stability.camera, "step", step)
    assert FINITE.quantity in not_ok(camera_rows(CameraCase("still", stability.QUIET), 1))
