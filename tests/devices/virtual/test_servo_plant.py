"""What a virtual servo moves: the drive alone, and a world in shared memory."""

import os
import sys
import threading
from pathlib import Path

import pytest

from evetac_cli.devices.virtual.servo_plant import Goals, Obstacle, OwnDynamics, ServoMotion, SharedPlant


def moved(plant: OwnDynamics, goals: Goals, seconds: float, start_s: float) -> ServoMotion:
    motion = plant.advance(goals, start_s)
    for k in range(round(seconds / 0.002)):
        motion = plant.advance(goals, start_s + 0.002 * (k + 1))
    return motion


def test_current_closes_and_opens() -> None:
    """Assert that 5 mA move nothing, 20 mA close, -20 mA open, no torque holds still, and the ends are kept."""
    plant = OwnDynamics(position_ticks=300)
    current = Goals(torque=True, mode=0, current_limit_ma=661)
    assert moved(plant, current._replace(goal_current_ma=5), 0.3, 0.0).position_ticks == 300
    assert moved(plant, current._replace(goal_current_ma=20), 0.3, 1.0).position_ticks > 310
    assert moved(plant, current._replace(goal_current_ma=-20), 1.0, 2.0).position_ticks < 300
    here = plant.advance(current, 4.0).position_ticks
    assert moved(plant, current._replace(torque=False, goal_current_ma=600), 0.3, 5.0).position_ticks == here
    assert moved(plant, current._replace(goal_current_ma=661), 5.0, 6.0).position_ticks == 740
    assert moved(plant, current._replace(goal_current_ma=-661), 5.0, 12.0).position_ticks == 0


def test_p_gain_is_current_per_tick() -> None:
    """Assert 0.1 mA a tick and unit of gain, up to the goal current, and that the goal is reached within friction."""
    plant = OwnDynamics(Obstacle(at_ticks=300.0, stiffness_n_tick=1000.0), position_ticks=299.0)
    position = Goals(torque=True, mode=5, goal_current_ma=661, current_limit_ma=1984, goal_ticks=310, p_gain=50)
    held = moved(plant, position, 0.5, 0.0)
    assert held.position_ticks == 300
    assert held.current_ma == pytest.approx(0.1 * 50 * 10)
    assert moved(plant, position._replace(p_gain=193), 0.1, 1.0).current_ma == pytest.approx(0.1 * 193 * 10)
    assert moved(plant, position._replace(goal_current_ma=30), 0.1, 2.0).current_ma == 30
    free = OwnDynamics(position_ticks=300.0)
    assert abs(moved(free, position._replace(goal_ticks=350), 4.0, 0.0).position_ticks - 350) <= 2


def test_an_obstacle_stops_the_fingers() -> None:
    """Assert that the fingers rest where the obstacle's push and friction balance the current."""
    plant = OwnDynamics(Obstacle(at_ticks=320.0, stiffness_n_tick=0.5), position_ticks=310.0)
    goals = Goals(torque=True, mode=0, goal_current_ma=20, current_limit_ma=661)
    motion = moved(plant, goals, 3.0, 0.0)
    push_n = (0.4 * 20 - 3.87) / 1.03
    assert motion.position_ticks == int(320 + push_n / 0.5)
    assert motion.velocity_ticks_s == pytest.approx(0.0, abs=1e-6)


def test_long_sleep_is_no_long_work() -> None:
    """Assert that a servo that slept for a day wakes up at once, and moves on from there."""
    plant = OwnDynamics(position_ticks=300.0)
    goals = Goals(torque=True, mode=0, goal_current_ma=40, current_limit_ma=661)
    plant.advance(goals, 0.0)
    assert plant.advance(goals, 86_400.0).position_ticks == 300 + moved_by(goals, 2.0)
    assert plant.advance(goals._replace(goal_current_ma=0), 86_400.0005).position_ticks > 300


def moved_by(goals: Goals, seconds: float) -> int:
    return moved(OwnDynamics(position_ticks=300.0), goals, seconds, 0.0).position_ticks - 300


def test_shared_plant_passes_goals_and_motion() -> None:
    """Assert that a servo and a world meet in the block, that it is removed in the end, and that a copy is attached."""
    servo_end = SharedPlant()
    path = servo_end.path
    world_end = SharedPlant(path)
    assert world_end.goals() == Goals()
    goals = Goals(True, 5, -20, 661, 437, 50)
    assert servo_end.advance(goals, 0.0) == ServoMotion()
    assert world_end.goals() == goals
    world_end.show(ServoMotion(-12.25, 433, -1.5))
    assert servo_end.advance(goals, 1.0) == ServoMotion(-12.25, 433, -1.5)
    world_end.close()
    servo_end.close()
    servo_end.close()
    assert not path.exists()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it is a file with a name")
def test_m9_a_plant_whose_processes_are_killed_leaves_nothing() -> None:
    """Assert that the memory has no name from the start, so that whatever kills its processes, nothing stays behind."""
    named = set(Path("/dev/shm").glob("evetac-*"))
    plant = SharedPlant()
    attached = SharedPlant(plant.path)
    assert set(Path("/dev/shm").glob("evetac-*")) <= named
    assert os.stat(plant.path).st_nlink == 0
    attached.close()
    plant.close()


def test_rows_in_shared_memory_are_never_torn() -> None:
    """Assert that whoever reads while another writes as fast as it can sees whole rows only, in order."""
    ours = SharedPlant()
    theirs = SharedPlant(ours.path)
    done = threading.Event()

    def world() -> None:
        k = 0
        while not done.is_set():
            k += 1
            theirs.show(ServoMotion(float(k), k, float(k)))

    writing = threading.Thread(target=world)
    writing.start()
    last = 0
    try:
        for _ in range(5000):
            current, position, velocity = ours.advance(Goals(), 0.0)
            assert current == position == velocity
            assert position >= last
            last = position
    finally:
        done.set()
        writing.join()
        ours.close()
        theirs.close()
    assert last > 0


def test_a_row_left_half_written_does_not_hang_the_reader() -> None:
    """Assert that a reader keeps to the last whole row when the writer died over the next."""
    plant = SharedPlant()
    plant.show(ServoMotion(1.0, 2, 3.0))
    assert plant.advance(Goals(), 0.0) == ServoMotion(1.0, 2, 3.0)
    with plant.path.open("r+b") as memory:
        memory.seek(128 + 9)
        memory.write(b"\x55")
    assert plant.advance(Goals(), 0.0) == ServoMotion(1.0, 2, 3.0)
    plant.close()
