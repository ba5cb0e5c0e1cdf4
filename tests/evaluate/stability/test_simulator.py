"""The part `sim`: its extreme cases are there, a finger gone wrong is seen, nonsense is refused, rows by hand."""

import math

import numpy as np
import pytest

from evetac_cli.evaluate.common.rows import Extent
from evetac_cli.evaluate.stability import cases as stability_cases
from evetac_cli.evaluate.stability import gel as gel_stability
from evetac_cli.evaluate.stability import simulator as simulator_stability
from evetac_cli.evaluate.stability.cases import EVENTS, FINITE, ORDER
from evetac_cli.evaluate.stability.gel import onset_cases
from evetac_cli.evaluate.stability.simulator import (
    CameraCase,
    FingerCase,
    camera_cases,
    camera_rows,
    finger_cases,
    finger_rows,
)
from evetac_cli.sim import gripper
from evetac_cli.sim.camera.scanning import camera


def test_the_suite_holds_all_that_it_should(monkeypatch):
    """Assert that the extremes which the physics names are among the cases, and that nothing has two names."""
    monkeypatch.setattr(simulator_stability, "GEL_STEPS", Extent(2, 2))
    monkeypatch.setattr(simulator_stability, "CAMERA_SLICES", 1)
    monkeypatch.setattr(gel_stability, "onset_error", lambda *given: ([(stability_cases.ONSET, 0.0)], "not tried"))
    cases = [run() for run in simulator_stability.cases(0, False)]
    assert all(row["ok"] for rows in cases for row in rows)
    assert {row["part"] for rows in cases for row in rows} == {"gel", "gripper", "camera"}
    assert sum(row["quantity"] == stability_cases.ONSET.quantity for rows in cases for row in rows) == len(
        onset_cases()
    )
    names = [rows[0]["case"] for rows in cases]
    assert len(names) == len(set(names))


@pytest.mark.parametrize("case", finger_cases(), ids=lambda case: case.name)
def test_extremes_of_the_gripper(case):
    """Assert that a finger without damping or mass, or however stiff, closes without turning back."""
    rows = finger_rows(case)
    assert all(row["ok"] for row in rows), rows
    assert len(rows) >= 2  # a valid case may not hide behind a refusal


@pytest.mark.parametrize(
    ("speeds", "force_n", "quantity", "value"),
    [
        ([1e-3, -1e-3] * 5, 1.0, stability_cases.TURNS.quantity, 9.0),
        ([1e-3] * 9 + [math.nan], 1.0, stability_cases.FINITE.quantity, 1.0),
        ([0.0] * 10, 24.0 + 2 * 3.87, stability_cases.SURPLUS.quantity, (3.87 - 0.03 * 31.74) / (3.87 + 0.03 * 31.74)),
    ],
)
def test_a_finger_gone_wrong_is_seen(monkeypatch, speeds, force_n, quantity, value):
    """Assert that a finger is not ok which chatters, is nowhere, or rests where its friction cannot hold it."""
    given = iter(speeds)

    def step(state, *_):
        state.speed_m_s, state.force_n = next(given), force_n

    monkeypatch.setattr(simulator_stability.gripper, "step", step)
    rows = finger_rows(FingerCase("wrong", gripper.Drive(friction_n=3.87, friction_share=0.03)), 10)
    assert [(row["quantity"], row["value"]) for row in rows if not row["ok"]] == [(quantity, pytest.approx(value))]


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
    monkeypatch.setattr(simulator_stability.camera, "step", step)
    moving = CameraCase("moving", camera.CameraModel(), dots=lambda k: (3.0 * k, 0.0))
    assert not not_ok(camera_rows(moving, 2))
    shift["t"] = 1000
    assert not_ok(camera_rows(moving, 1)) == {ORDER.quantity}
    shift.update(t=0, x=np.uint16(600))
    assert not_ok(camera_rows(moving, 1)) == {ORDER.quantity}
    shift.update(x=0)
    few = CameraCase("moving", moving.model, dots=moving.dots, events=(0, 3))
    assert not_ok(camera_rows(few, 1)) == {EVENTS.quantity}
