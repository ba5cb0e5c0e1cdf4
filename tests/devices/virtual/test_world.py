"""The virtual world: what its camera sends is what the simulation sees, its gripper follows the servo's registers."""

import os
import select
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evetac_cli.devices.dvxplorer import event_words
from evetac_cli.devices.dvxplorer.camera import DvxplorerCamera
from evetac_cli.devices.simulated import rig
from evetac_cli.devices.virtual import world as virtual
from evetac_cli.devices.virtual.dvxplorer import VirtualDvxplorer
from evetac_cli.devices.virtual.servo_plant import Goals, ServoMotion
from evetac_cli.devices.virtual.world import FIRST_MS, VirtualWorld
from evetac_cli.errors import DeviceError, SceneError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.realtime.shared_time import CREEP
from evetac_cli.sim.setup.plan import Plan, first_plan
from tests.conftest import Made

SLICES = 250
LONGEST_S = 20.0
SHORT_MS = 3000


def short_plan(made: Made) -> Plan:
    """One trial of the short slip scene."""
    return first_plan(str(made.scene))


def seeds() -> np.random.SeedSequence:
    return np.random.SeedSequence([5, 8, 0])


@pytest.fixture
def world(made: Made) -> Iterator[VirtualWorld]:
    """A world that stands still."""
    world = VirtualWorld(short_plan(made), seeds())
    yield world
    world.close()


def watch(world: VirtualWorld, slices: int) -> Events:
    """Let it run, and decode what it sends until so many slices are surely over."""
    decoder = event_words.start()
    parts: list[Events] = []
    world.run(True)
    quiet = 0
    while quiet < 20 and (decoder.now_us or 0) < (slices + FIRST_MS + 1) * SLICE_US:
        data = world.take(65536, 0.01)
        quiet = 0 if data else quiet + 1
        parts.append(event_words.step(decoder, data))
    world.run(False)
    assert not any(decoder.counted.values())
    parts.append(event_words.flush(decoder))
    joined = Events(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    joined = joined._replace(t=joined.t - FIRST_MS * SLICE_US)
    return joined.part(0, int(np.searchsorted(joined.t, slices * SLICE_US)))


def by_slice(events: Events) -> list[tuple[int, int, int, int]]:
    """Events with their slice instead of their time, in an order of their own."""
    return sorted(zip((events.t // SLICE_US).tolist(), *(column.tolist() for column in events[1:]), strict=True))


def test_camera_sends_what_the_simulation_sees(world: VirtualWorld, made: Made) -> None:
    """Assert that slice for slice the words hold the events of the same trial in lockstep, none lost, none moved."""
    simulated = rig(short_plan(made), seeds())
    expected = [simulated.camera.read() for _ in range(SLICES)]
    joined = Events(*(np.concatenate(column) for column in zip(*expected, strict=True)))
    sent = watch(world, SLICES)
    assert joined.size > 1000
    assert by_slice(sent) == by_slice(joined)
    assert (np.diff(sent.t) >= 0).all()
    assert world.counted["slices_dropped"] == 0
    assert world.holding_ma == simulated.holding_ma
    assert world.sampled == simulated.sampled
    np.testing.assert_array_equal(world.sensor["sensor/dot_xy_px"], simulated.camera.sensor["sensor/dot_xy_px"])


@pytest.mark.slow
def test_time_stands_still_until_it_runs(world: VirtualWorld) -> None:
    """Assert that nothing comes before RUN, and that it goes on where it was after a stop."""
    assert world.take(4096, 0.05) == b""
    first = watch(world, 20)
    assert first.size
    while world.take(65536, 0.05):
        pass
    assert world.take(65536, 0.1) == b""


@pytest.mark.slow
def test_looking_comes_to_an_end(made: Made, request: pytest.FixtureRequest) -> None:
    """Assert that who looks for words until there are none gets to an end though a late world still makes some."""
    world = VirtualWorld(short_plan(made), seeds(), waits=False)
    request.addfinalizer(world.close)
    world.run(True)
    time.sleep(0.3)
    made = 0
    while world.take(65536, 0.0):
        made = max(made, world._counters[virtual._MADE])
    assert made >= 250  # all that was due when it was first looked
    assert made < SHORT_MS


@pytest.mark.slow
def test_truth_waits_for_its_reader(made: Made) -> None:
    """Assert that all of it comes, and its end, though nobody read it before the world was over."""
    world = VirtualWorld(short_plan(made), seeds(), sends_truth=True)
    assert world.truths is not None
    try:
        world.run(True)
        quiet = 0
        while quiet < 20:
            quiet = 0 if world.take(1 << 16, 0.05) else quiet + 1
        messages: list[Any] = []
        while not messages or messages[-1] is not None:
            assert select.select([world.truths], [], [], LONGEST_S)[0]
            messages += world.truths.take()
        made_ms = rig(short_plan(made), seeds()).slices
        assert sum(len(next(iter(rows.values()))) for rows in messages[:-1]) == made_ms > 0
    finally:
        world.close()


def test_time_waits_for_a_world_that_is_late(world: VirtualWorld) -> None:
    """Assert that time stands still while the world's process does, and then goes on from there, nothing left out."""
    world.run(True)
    world.time.sleep(0.05)
    assert world.pid is not None
    os.kill(world.pid, signal.SIGSTOP)
    stopped_s = world.time.now_s()
    time.sleep(0.5)
    assert world.time.now_s() - stopped_s < virtual.LATE_S + 2 * virtual.SLICE_S + CREEP * 5.0
    os.kill(world.pid, signal.SIGCONT)
    world.time.sleep(0.1)
    assert world.counted["slices_dropped"] == 0


@pytest.mark.slow
def test_time_waits_for_the_reader(world: VirtualWorld) -> None:
    """Assert that a driver whose slices nobody reads holds up the world, and that it goes on once they are read."""
    with closing(DvxplorerCamera(backend=VirtualDvxplorer(world))) as camera:
        for _ in range(50):
            camera.read()
        time.sleep(0.5)
        assert world._counters[virtual._MADE] < 50 + 1e3 * (virtual.READER_S + 2 * virtual.LATE_S)
        for _ in range(100):
            camera.read()
        until_s = time.monotonic() + LONGEST_S  # it counts a slice after it has sent it
        while world._counters[virtual._MADE] < 150 and time.monotonic() < until_s:
            time.sleep(0.01)
        assert world._counters[virtual._MADE] >= 150
        assert camera.counted["late_events"] == 0


def goals(**registers: int) -> Goals:
    """Registers of a servo with torque."""
    usual = {"mode": 0, "goal_current_ma": 0, "current_limit_ma": 661, "goal_ticks": 0, "p_gain": 50}
    return Goals(True, **(usual | registers))


def until(world: VirtualWorld, wanted: Goals, holds: Callable[[ServoMotion], bool]) -> ServoMotion:
    """Pass these registers to the world until what the servo measures is as expected, or the world has had its time."""
    began = time.monotonic()
    while not holds(motion := world.plant.advance(wanted, 0.0)) and time.monotonic() < began + LONGEST_S:
        world.take(65536, 0.01)
    return motion


@pytest.mark.slow
def test_finger_follows_the_servo(world: VirtualWorld) -> None:
    """Assert that the finger starts where the scene has it, closes under current, and opens towards a goal position."""
    started = world.plant.advance(Goals(), 0.0).position_ticks
    assert started > 0
    world.run(True)
    pressed = until(world, goals(goal_current_ma=200), lambda motion: motion.position_ticks > started)
    assert pressed.position_ticks > started
    opening = goals(mode=5, goal_current_ma=661, goal_ticks=started - 30)
    opened = until(world, opening, lambda motion: motion.position_ticks < started)
    assert opened.position_ticks < started


@pytest.mark.slow
def test_servo_without_torque_has_no_force(world: VirtualWorld) -> None:
    """Assert that once there was torque, its end is the end of the current."""
    world.run(True)
    assert until(world, goals(goal_current_ma=60), lambda motion: motion.current_ma == 60).current_ma == 60
    assert until(world, Goals(False), lambda motion: motion.current_ma == 0).current_ma == 0


@pytest.mark.slow
def test_scenes_that_cannot_be_built(made: Made) -> None:
    """Assert that what the world's process refuses is raised here in its own words."""
    with pytest.raises(DeviceError, match="needs a scene with a gripper"):
        VirtualWorld(first_plan("press"), seeds())
    whole = short_plan(made)
    broken = replace(whole, sensor=replace(whole.sensor, shear_modulus_pa=-1.0))
    with pytest.raises((DeviceError, SceneError)):
        VirtualWorld(broken, seeds())


@pytest.mark.slow
def test_close_ends_the_process(made: Made) -> None:
    """Assert that close ends the process and removes the shared memory, running or not, and a second does nothing."""
    world = VirtualWorld(short_plan(made), seeds())
    world.run(True)
    world.close()
    world.close()
    assert not world._process.is_alive()
    assert not world.plant.path.exists()


class Bomb:
    """What nobody can be given: it fails where it is taken."""

    def __reduce__(self) -> Any:
        return int, ("gel",)


DEATHS: dict[str, tuple[Callable[[VirtualWorld], None], str]] = {
    "killed": (lambda world: world._process.kill(), r"\(SIGKILL\)"),
    "a defect": (lambda world: world._orders.send(Bomb()), r"\(exit code 1: ValueError: .*'gel', in .*, line \d+\)"),
}


@pytest.mark.slow
@pytest.mark.parametrize("how", DEATHS)
def test_death_of_the_world_is_an_error(how: str, made: Made) -> None:
    """Assert that a world that died is an error with its reason, and not waited for; a copy knows its last words."""
    world = VirtualWorld(short_plan(made), seeds())
    assert not world.has_died
    die, why = DEATHS[how]
    die(world)
    world._process.join()
    assert world.has_died
    with pytest.raises(DeviceError, match=f"the process of the virtual world died {why}"):
        world.take(4096, 0.1)
    with pytest.raises(DeviceError, match=f"died {why}"):
        for _ in range(2):
            world.run(True)
            time.sleep(0.05)
    world._process, process = None, world._process
    assert ("ValueError" in str(world.died())) == (how == "a defect")
    assert not world.has_died
    world._process = process
    world.close()
