"""Record a trial in a simulated scene, whose time passes as its slices are read.

Where the scene has a gripper, the object is held by motor current, which is lowered at random until the object slips
out (paper, "Experimental Setup and Data Collection Procedure"), or the servo opens the gripper (paper, "Data Rate
Experiments").
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from evetac_cli.devices import Gripper, Rig, gripper_row
from evetac_cli.events import SLICES_PER_S, Events
from evetac_cli.jobs import Outcome, Progress, outcome
from evetac_cli.sim.parts import Timer, untimed
from evetac_cli.sim.setup.held import GripperCurrent
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.store.files import up_to_date
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.segments import refuse_leftover
from evetac_cli.store.recordings.trial_writer import TrialWriter
from evetac_cli.trials import live_view
from evetac_cli.trials.live_view import LiveView, shown_in_real_time
from evetac_cli.trials.record.current_ramp import COMMAND_MS, RAMP_MA
from evetac_cli.trials.trial import OUTPUT, SimulatedTrial, SolverFigures

METHOD = 6
GONE_MS = 250  # from slip to the end of a trial
CLOSING_TICKS = 3  # how far ahead of the finger the goal is while it closes: one more than just moves it


def make_recipe(trial: SimulatedTrial) -> Recipe:
    """What determines the recording of a trial."""
    return Recipe(
        OUTPUT, METHOD, {**trial.plan.parameters(), "trial": trial.number}, seed=trial.seed, simulated_source=True
    )


def run(trial: SimulatedTrial, *, force: bool, progress: Progress) -> Outcome:
    """Simulate one trial and write it; nothing is left of one that is broken off."""
    recipe = make_recipe(trial)
    if up_to_date(trial.output, recipe, force=force):
        return outcome(trial, made=False, simulated=True)
    refuse_leftover(trial.output)
    with live_view.opened(trial, f"record {trial.output.name}", moves=False) as view:
        return _record(trial, recipe, view, progress)


def _record(trial: SimulatedTrial, recipe: Recipe, view: LiveView | None, progress: Progress) -> Outcome:
    devices, slices = play(trial)
    expected = _expected_slices(devices, GripperSchedule.of_scene(trial.plan.scene))
    known = {**devices.camera.sensor, "t_offset": np.int64(0), "truth/sampled_parameters": devices.sampled}
    if view is not None:
        view.begin(devices.camera.sensor)
    written = event_count = 0
    solver = SolverFigures()
    try:
        with TrialWriter(trial.output, known) as writer:
            append = shown_in_real_time(view, writer.append)
            for events, rows in slices:
                append(events, rows)
                written += 1
                event_count += events.size
                solver.add(rows)
                if written % 100 == 0:
                    progress(written, max(written, expected))
            progress(written, written)
            writer.finish(recipe)
    finally:
        devices.close()
    figures = solver.figures(trial.plan.scene.solver)
    return outcome(trial, made=True, simulated=True, slices=written, events=event_count, **figures)


def play(trial: SimulatedTrial, timer: Timer = untimed) -> tuple[Rig, Iterator[tuple[Events, dict[str, Any]]]]:
    """The devices of a trial, and its slices, each with the truth of the slice and every 2 ms a gripper row.

    A slice is simulated when it is asked for; whoever asks closes the devices. timer: measures the scene's parts.
    """
    from evetac_cli.devices.simulated import rig  # builds on numba: only when there is something to simulate

    seeds = trial.seeds()
    ramp = np.random.default_rng(seeds.spawn(1)[0])
    devices = rig(trial.plan, seeds, timer)
    return devices, _slices(devices, GripperSchedule.of_scene(trial.plan.scene), ramp)


def play_through(
    trial: SimulatedTrial, append: Callable[[Events, dict[str, Any]], None], timer: Timer = untimed
) -> None:
    """Hand over every slice of a trial and its rows, until the trial ends or `append` raises; `timer` as for `play`."""
    devices, slices = play(trial, timer)
    try:
        for events, rows in slices:
            append(events, rows)
    finally:
        devices.close()


@dataclass(frozen=True)
class GripperSchedule:
    """When the gripper does what, in slices: closes to touch, grips with the holding current, lowers it.

    opens: from ramp_ms on the servo opens it instead, to where it started. course: the current that it follows instead
    of all that, where the scene names one.
    """

    close_ms: int
    grip_ms: int
    ramp_ms: int
    opens: bool = False
    course: GripperCurrent | None = None

    @classmethod
    def of_scene(cls, scene: Scene) -> "GripperSchedule":
        """As the scene says; in a ramp scene the object is held from the start."""
        time, gripper = scene.time, scene.gripper
        if scene.kind == "ramp":
            return cls(0, 0, round(SLICES_PER_S * (time.rest_s + time.load_s + time.hold_s)))
        opens = gripper.open_s is not None
        lets_go_s = gripper.ramp_s if gripper.open_s is None else gripper.open_s
        starts_s = (gripper.close_s, gripper.grip_s, lets_go_s)
        close_ms, grip_ms, ramp_ms = (round(SLICES_PER_S * at_s) for at_s in starts_s)
        return cls(close_ms, grip_ms, ramp_ms, opens, gripper.current)


def _expected_slices(devices: Rig, schedule: GripperSchedule) -> int:
    """How many slices a trial will have, for the progress shown: where the object slips out, about so many."""
    if math.isnan(devices.slips_at_ma):
        return devices.slices
    a_command_ma = devices.fall_factor * np.mean(RAMP_MA)
    ramp_ms = COMMAND_MS * (devices.slips_at_ma - devices.holding_ma) / a_command_ma
    return min(devices.slices, round(schedule.ramp_ms + ramp_ms + GONE_MS))


def _slices(
    devices: Rig, schedule: GripperSchedule, rng: np.random.Generator
) -> Iterator[tuple[Events, dict[str, Any]]]:
    """Read every slice, and command the gripper, if there is one, every 2 ms, until the scene has ended."""
    target_ma = devices.holding_ma
    course = schedule.course
    open_ticks = 0 if devices.gripper is None else devices.gripper.read().position_ticks
    written_ma = 0
    number = 0
    while (events := devices.camera.read()) is not None:
        rows: dict[str, Any] = dict(devices.truth()) if devices.truth else {}
        due = number % COMMAND_MS == 0
        if course is not None:  # a new current is given at once, so that commands lie at all times between readings
            target_ma = course.at(number * 1e-3)
            due = due or round(target_ma) != written_ma
            written_ma = round(target_ma)
        if devices.gripper is not None and due:
            if course is None and number > schedule.ramp_ms and not schedule.opens:
                target_ma += devices.fall_factor * rng.uniform(*RAMP_MA)
            now_us = devices.camera.now_us()
            rows |= _command(devices.gripper, now_us, target_ma, number, schedule, open_ticks)
        yield events, rows
        number += 1


def _command(
    gripper: Gripper, now_us: int, target_ma: float, now_ms: int, schedule: GripperSchedule, open_ticks: int
) -> dict[str, Any]:
    """One command to the gripper, and its row: position mode until it grips, then current mode, or until it opens."""
    reading = gripper.read()
    if now_ms < schedule.grip_ms:
        gripper.write_position(reading.position_ticks + (CLOSING_TICKS if now_ms >= schedule.close_ms else 0))
        return gripper_row(now_us, reading)
    if schedule.opens and now_ms >= schedule.ramp_ms:
        gripper.write_position(open_ticks)
        return gripper_row(now_us, reading)
    gripper.write_current(round(target_ma))
    return gripper_row(now_us, reading, target_ma=target_ma, written_ma=round(target_ma))
