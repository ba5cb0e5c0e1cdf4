"""Record a trial in a simulated scene, whose time passes as its slices are read.

If the scene has a gripper, motor current holds the object. The current is lowered at random until the object slips out
(paper, "Experimental Setup and Data Collection Procedure"), or the servo opens the gripper (paper, "Data Rate
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
from evetac_cli.sim.setup.held import GripperCurrent
from evetac_cli.sim.setup.parts import Timer, untimed
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.store.files import up_to_date
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.segments import refuse_leftover
from evetac_cli.store.recordings.trial_writer import TrialWriter
from evetac_cli.trials import live_view
from evetac_cli.trials.live_view import LiveView, shown_in_real_time
from evetac_cli.trials.record.current_ramp import COMMAND_MS, RAMP_MA
from evetac_cli.trials.trial import OUTPUT, SimulatedTrial, SolverFigures

METHOD = 7
GONE_MS = 250  # time from slip to the end of a trial
CLOSING_TICKS = 3  # how far the goal is ahead of the closing finger: one more than just moves it


def make_recipe(trial: SimulatedTrial) -> Recipe:
    """Return the recipe of a trial's recording."""
    return Recipe(
        OUTPUT, METHOD, {**trial.plan.parameters(), "trial": trial.number}, seed=trial.seed, simulated_source=True
    )


def run(trial: SimulatedTrial, *, force: bool, progress: Progress) -> Outcome:
    """Simulate one trial and write it; an aborted one leaves nothing."""
    recipe = make_recipe(trial)
    if up_to_date(trial.output, recipe, force=force):
        return outcome(trial, made=False, simulated=True)
    refuse_leftover(trial.output)
    with live_view.opened(trial, f"record {trial.output.name}", moves=False) as view:
        return _record(trial, recipe, view, progress, force=force)


def _record(
    trial: SimulatedTrial, recipe: Recipe, view: LiveView | None, progress: Progress, *, force: bool
) -> Outcome:
    devices, slices = play(trial)
    expected = _expected_slices(devices, GripperSchedule.of_scene(trial.plan.scene))
    datasets = {**devices.camera.sensor, "t_offset": np.int64(0), "truth/sampled_parameters": devices.sampled}
    if view is not None:
        view.begin(devices.camera.sensor)
    written = event_count = 0
    solver = SolverFigures()
    try:
        with TrialWriter(trial.output, datasets, force=force) as writer:
            append = shown_in_real_time(view, writer.append)
            for events, rows in slices:
                append(events, rows)
                written += 1
                event_count += events.size
                solver.add(rows)
                if written % 100 == 0:
                    progress(written, max(written, expected))
            progress(written, written)
            made = writer.finish(recipe)
    finally:
        devices.close()
    figures = solver.figures(trial.plan.scene.solver)
    return outcome(trial, made=made, simulated=True, slices=written, events=event_count, **figures)


def play(trial: SimulatedTrial, timer: Timer = untimed) -> tuple[Rig, Iterator[tuple[Events, dict[str, Any]]]]:
    """Return the devices of a trial, and its slices, each with its ground truth and every 2 ms a gripper row.

    A slice is simulated when it is requested; the caller closes the devices. timer: measures the scene's parts.
    """
    from evetac_cli.devices.simulated import rig  # imports numba, so only if there is something to simulate

    seeds = trial.seeds()
    ramp = np.random.default_rng(seeds.spawn(1)[0])
    devices = rig(trial.plan, seeds, timer)
    return devices, _slices(devices, GripperSchedule.of_scene(trial.plan.scene), ramp)


def play_through(
    trial: SimulatedTrial, append: Callable[[Events, dict[str, Any]], None], timer: Timer = untimed
) -> None:
    """Pass every slice of a trial and its rows to `append`, until the trial ends or `append` raises.

    `timer` as in `play`.
    """
    devices, slices = play(trial, timer)
    try:
        for events, rows in slices:
            append(events, rows)
    finally:
        devices.close()


@dataclass(frozen=True)
class GripperSchedule:
    """The gripper's schedule in slices: close to touch, grip with the holding current, lower the current.

    opens: starting at ramp_ms the servo opens it instead, to its start position. course: the current that it follows
    instead of all that, if the scene names one.
    """

    close_ms: int
    grip_ms: int
    ramp_ms: int
    opens: bool = False
    course: GripperCurrent | None = None

    @classmethod
    def of_scene(cls, scene: Scene) -> "GripperSchedule":
        """Return the schedule of a scene; in a ramp scene the object is held from the start."""
        time, gripper = scene.time, scene.gripper
        if scene.kind == "ramp":
            return cls(0, 0, round(SLICES_PER_S * (time.rest_s + time.load_s + time.hold_s)))
        opens = gripper.open_s is not None
        lets_go_s = gripper.ramp_s if gripper.open_s is None else gripper.open_s
        starts_s = (gripper.close_s, gripper.grip_s, lets_go_s)
        close_ms, grip_ms, ramp_ms = (round(SLICES_PER_S * at_s) for at_s in starts_s)
        return cls(close_ms, grip_ms, ramp_ms, opens, gripper.current)


def _expected_slices(devices: Rig, schedule: GripperSchedule) -> int:
    """Return the expected number of slices, for the progress display; an estimate if the object slips out."""
    if math.isnan(devices.slips_at_ma):
        return devices.slices
    a_command_ma = devices.fall_factor * np.mean(RAMP_MA)
    ramp_ms = COMMAND_MS * (devices.slips_at_ma - devices.holding_ma) / a_command_ma
    return min(devices.slices, round(schedule.ramp_ms + ramp_ms + GONE_MS))


def _slices(
    devices: Rig, schedule: GripperSchedule, rng: np.random.Generator
) -> Iterator[tuple[Events, dict[str, Any]]]:
    """Read every slice, and command the gripper, if any, every 2 ms, until the scene has ended."""
    target_ma = devices.holding_ma
    course = schedule.course
    open_ticks = 0 if devices.gripper is None else devices.gripper.read().position_ticks
    written_ma = 0
    number = 0
    while (events := devices.camera.read()) is not None:
        rows: dict[str, Any] = dict(devices.truth()) if devices.truth else {}
        due = number % COMMAND_MS == 0
        # a new current is commanded at once, so that commands occur at all times between readings
        if course is not None:
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
    """Send one command to the gripper and return its row.

    The gripper is in position mode until it grips, then in current mode, unless the schedule opens it.
    """
    reading = gripper.read()
    if now_ms < schedule.grip_ms:
        gripper.write_position(reading.position_ticks + (CLOSING_TICKS if now_ms >= schedule.close_ms else 0))
        return gripper_row(now_us, reading)
    if schedule.opens and now_ms >= schedule.ramp_ms:
        gripper.write_position(open_ticks)
        return gripper_row(now_us, reading)
    gripper.write_current(round(target_ma))
    return gripper_row(now_us, reading, target_ma=target_ma, written_ma=round(target_ma))
