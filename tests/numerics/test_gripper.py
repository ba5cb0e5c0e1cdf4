"""The extreme cases of the gripper: a finger closes without turning back, and one that chatters would be seen."""

import pytest

from evetac_cli.numerics import gripper as cases
from evetac_cli.numerics.gripper import FingerCase, finger_cases, finger_row
from evetac_cli.sim import gripper


@pytest.mark.parametrize("case", finger_cases(), ids=lambda case: case.name)
def test_extremes_of_the_gripper(case):
    """Assert that a finger without damping or mass, or however stiff, closes without turning back."""
    row = finger_row(case)
    assert row["ok"]
    assert row["outcome"].startswith("finite")  # a valid case may not hide behind a refusal


def test_a_finger_that_turns_back_is_seen(monkeypatch):
    """Assert that a finger which chatters is not ok."""
    speeds = iter([1e-3, -1e-3] * 5)

    def step(state, *_):
        state.speed_m_s = next(speeds)

    monkeypatch.setattr(cases.gripper, "step", step)
    row = finger_row(FingerCase("chatters", gripper.Drive()), 10)
    assert not row["ok"]
    assert "turned back 9 times" in row["outcome"]
