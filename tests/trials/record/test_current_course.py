"""The current that a gripper follows: as scenes name it, and as devices are commanded."""

from pathlib import Path

import numpy as np
import pytest

from evetac_cli.commands.record import Record
from evetac_cli.devices import GripperReading
from evetac_cli.errors import InputError
from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.held import GripperCurrent, SquareWave
from evetac_cli.trials import record
from evetac_cli.trials.record.current_ramp import COMMAND_MS, Hold, HoldState, step


def test_a_line_with_a_square_wave() -> None:
    """Assert the current at its points, between them, before and after them, and in the square wave."""
    square = SquareWave(from_s=2.5, to_s=3.5, every_ms=100, by_ma=4.0)
    course = GripperCurrent(at_s=(1.0, 2.0, 4.0), ma=(0.0, 10.0, 10.0), square=square)
    assert [course.at(time_s) for time_s in (0.0, 1.0, 1.5, 2.0, 9.0)] == [0.0, 0.0, 5.0, 10.0, 10.0]
    assert [course.at(time_s) for time_s in (2.49, 2.5, 2.599, 2.6, 2.7, 3.45, 3.5)] == [10, 10, 10, 6, 10, 6, 10]
    assert course.ends_s == 4.0


def test_what_the_scene_grip_steps_is_for() -> None:
    """Assert that its currents open and close more than once, hold for 15 s and fall below 0."""
    course = scene_file.load("grip-steps").gripper.current
    assert course is not None and course.square is not None and course.square.every_ms % 2 == 1
    turns = np.flatnonzero(np.diff(np.sign(np.diff(course.ma))))
    assert len(turns) >= 6 and min(course.ma) < 0
    assert any(
        after - before > 15 and low == high
        for before, after, low, high in zip(course.at_s, course.at_s[1:], course.ma, course.ma[1:], strict=False)
    )
    assert scene_file.load("slip").gripper.current is None


def test_a_device_follows_it() -> None:
    """Assert that commands follow the course whatever is read, and end with it."""
    course = GripperCurrent(at_s=(0.0, 0.1), ma=(0.0, 50.0))
    hold = Hold(10, 50.0, 1.0, -50.0, course)
    state, rng = HoldState(), np.random.default_rng(0)
    given = []
    while not state.ended:
        given.append(step(state, hold, GripperReading(0.0, 100), rng))
    assert given == pytest.approx(np.linspace(0, 50, 51)) and len(given) * COMMAND_MS == 102


def test_a_virtual_world_follows_the_current_of_its_scene(tmp_path: Path) -> None:
    """Assert that a dry run says so and how long it takes, and that options for another grip are refused."""
    asked = Record(camera="virtual", scene="grip-steps", dry_run=True)
    shown = str(record.dry_run(record.jobs([], asked, tmp_path), asked).rows)
    assert "-25 to 60 mA for 35.5 s" in shown and "until the gripper has followed its current, 35.5 s" in shown
    assert "events/s for 35.5 s" in shown
    held = Record(camera="virtual", scene="grip-steps", holding_ma=30.0, dry_run=True)
    with pytest.raises(InputError, match="--holding-ma: has no effect with --scene grip-steps"):
        record.dry_run(record.jobs([], held, tmp_path), held)
