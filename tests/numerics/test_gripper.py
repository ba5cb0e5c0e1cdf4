"""The extreme cases of the gripper: a finger closes without turning back, and one that chatters would be seen."""

import math

import pytest

from evetac_cli.numerics import gripper as cases
from evetac_cli.numerics.gripper import FingerCase, finger_cases, finger_rows
from evetac_cli.sim import gripper


@pytest.mark.parametrize("case", finger_cases(), ids=lambda case: case.name)
def test_extremes_of_the_gripper(case):
    """Assert that a finger without damping or mass, or however stiff, closes without turning back."""
    rows = finger_rows(case)
    assert all(row["ok"] for row in rows), rows
    assert len(rows) >= 2  # a valid case may not hide behind a refusal


@pytest.mark.parametrize(
    ("speeds", "force_n", "quantity", "value"),
    [
        ([1e-3, -1e-3] * 5, 1.0, cases.TURNS.quantity, 9.0),
        ([1e-3] * 9 + [math.nan], 1.0, cases.FINITE.quantity, 1.0),
        ([0.0] * 10, 24.0 + 2 * 3.87, cases.SURPLUS.quantity, (3.87 - 0.03 * 31.74) / (3.87 + 0.03 * 31.74)),
    ],
)
def test_a_finger_gone_wrong_is_seen(monkeypatch, speeds, force_n, quantity, value):
    """Assert that a finger is not ok which chatters, is nowhere, or rests where its friction cannot hold it."""
    given = iter(speeds)

    def step(state, *_):
        state.speed_m_s, state.force_n = next(given), force_n

    monkeypatch.setattr(cases.gripper, "step", step)
    rows = finger_rows(FingerCase("wrong", gripper.Drive(friction_n=3.87, friction_share=0.03)), 10)
    assert [(row["quantity"], row["value"]) for row in rows if not row["ok"]] == [(quantity, pytest.approx(value))]
