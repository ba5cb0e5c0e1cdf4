"""Closing until contact, on made-up positions and on the simulated drive."""

import pytest

from evetac_cli.devices.rh_p12_rn.close_until_contact import Closing, ClosingSettings
from evetac_cli.devices.virtual.servo_plant import Goals, Obstacle, OwnDynamics
from evetac_cli.errors import DeviceError

FEW = ClosingSettings(still_cycles=3, longest_cycles=20, last_tick=660)


def test_contact_is_a_position_that_stays() -> None:
    """Assert that contact is seen after so many readings without a new position, and how far it moved until then."""
    closing = Closing(FEW)
    positions = [400, 401, 401, 401, 402, 402, 402, 402]
    assert [closing.step(position) for position in positions] == [False] * 7 + [True]
    assert closing.moved_ticks == 2


def test_a_position_that_falls_back_is_no_motion() -> None:
    """Assert that only a position further than all before counts: an encoder that flickers between two ticks rests."""
    closing = Closing(FEW)
    assert [closing.step(position) for position in (400, 401, 400, 401, 400)] == [False] * 4 + [True]


def test_closing_on_nothing_is_an_error() -> None:
    """Assert an error in words where the fingers meet, and where they never stop."""
    with pytest.raises(DeviceError, match="without contact"):
        Closing(FEW).step(660)
    closing = Closing(FEW)
    with pytest.raises(DeviceError, match="still closing"):
        for position in range(400, 421):
            closing.step(position)


def test_closing_on_the_simulated_drive() -> None:
    """Assert that at the default current the simulated finger stops at the obstacle, and is found there."""
    plant = OwnDynamics(Obstacle(at_ticks=404.0), position_ticks=400.0)
    closing = Closing()
    goals = Goals(torque=True, mode=0, goal_current_ma=closing.settings.current_ma, current_limit_ma=661)
    now_s = 0.0
    while not closing.step(plant.advance(goals, now_s).position_ticks):
        now_s += 0.002
    assert plant.advance(goals, now_s).position_ticks == 404
    assert closing.moved_ticks == 4


@pytest.mark.parametrize("name", ["current_ma", "still_cycles", "longest_cycles"])
def test_impossible_settings_are_refused(name: str) -> None:
    """Assert that a setting below 1 is a ValueError that names it."""
    with pytest.raises(ValueError, match=name):
        ClosingSettings(**{name: 0})
