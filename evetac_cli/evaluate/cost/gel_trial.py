"""One trial of the mechanics, simulated repeatedly to compare its numerical choices.

A cylinder of 100 g is held slightly tilted and off its centre of mass, while the grip falls from 2 to 0.2 N within
0.2 s. It bounces on the gel, slips in part, turns, and falls. Run times are per simulated millisecond on one core, as
thread time, so that other programs do not count.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.sim.gel import dots, gel
from evetac_cli.sim.gel.contact import gap_profile, pad_nodes, pressure

GRAVITY_M_S2 = 9.81
PAD_M = (20e-3, 15e-3)
SAMPLE_S = 0.01
BLOCK_S = 1e-3  # run time is measured per block, or per step if a step is longer


@dataclass(frozen=True)
class GelTrial:
    """A simulated trial: grid, material, object, contact, and a grip that falls evenly from `first_n` to `last_n`.

    The grip begins to fall at `begin_s`; the weight is handed over evenly until `hang_s`, or hangs from the start.
    """

    columns: int = 24
    rows: int = 18
    material: gel.GelMaterial = gel.GelMaterial()
    friction: gel.Friction = gel.Friction(0.8, 0.8)
    mass_kg: float = 0.1
    inertia_kg_m2: float = 4e-5
    centre_m: tuple[float, float] = (0.0, 0.0)
    radius_m: float = 0.06
    tilt_rad: float = 0.0
    indentation_m: float = 0.4e-3
    first_n: float = 2.0
    last_n: float = 0.2
    seconds: float = 0.2
    begin_s: float = 0.0
    hang_s: float = 0.0

    def start(self) -> gel.GelState:
        """Return the state of the pad and the object, at rest."""
        x, y = PAD_M
        nodes = pad_nodes(self.columns, self.rows, (-x / 2, x / 2), (-y / 2, y / 2))
        return gel.start(nodes, self.material, self.mass_kg, self.inertia_kg_m2, body_xy_m=self.centre_m)

    def shares(self, state: gel.GelState) -> Floats:
        """Return the share of the grip on each node, (rows, columns), with sum 1."""
        gap = gap_profile(state.node_xy_m, "cylinder", self.radius_m, self.tilt_rad)
        return np.asarray(pressure(self.indentation_m, gap, 1.0))

    def grip_n(self, time_s: float) -> float:
        """Return the normal force on one pad, in N, at a time in s."""
        fallen = (time_s - self.begin_s) / (self.seconds - self.begin_s)
        return self.first_n + (self.last_n - self.first_n) * min(max(fallen, 0.0), 1.0)

    def weight_n(self, time_s: float) -> tuple[float, float, float]:
        """Return the force and moment of gravity, along x through the centre of mass, as far as it is handed over."""
        share = min(time_s / self.hang_s, 1.0) if self.hang_s else 1.0
        return (share * self.mass_kg * GRAVITY_M_S2, 0.0, 0.0)


def draw_trial(seed: int) -> GelTrial:
    """Return the trial of a seed, which decides the tilt of the fingers and the distance from the object's centre."""
    rng = np.random.default_rng(seed)
    tilt_rad = rng.choice([-1, 1]) * rng.uniform(0.005, 0.015)
    centre_m = (rng.uniform(-2e-3, 2e-3), rng.choice([-1, 1]) * rng.uniform(1e-3, 2e-3))
    return GelTrial(tilt_rad=float(tilt_rad), centre_m=(float(centre_m[0]), float(centre_m[1])))


class GelMotion(NamedTuple):
    """The motion of a simulated trial, sampled every 10 ms, and its run time.

    - pose: (samples, 3);
    - gel_m: displacement, (samples, points, 2), of all nodes or of the requested points;
    - block_us: run time of each block, in microseconds per simulated millisecond;
    - blown_up_s: the time at which the integrator blew up, which leaves no samples; NaN if it did not.
    """

    pose: Floats
    gel_m: Floats
    block_us: Floats
    blown_up_s: float = math.nan


Advance = Callable[[int, int], tuple[int, bool]]  # (first step, number of steps) -> (steps made, blown up)


def follow(trial: GelTrial, dt_s: float, advance: Advance, sample: Callable[[], tuple[Floats, Floats]]) -> GelMotion:
    """Advance a trial to its end, measure run times, and sample the motion."""
    steps_a_sample = round(SAMPLE_S / dt_s)
    if abs(steps_a_sample * dt_s / SAMPLE_S - 1) > 1e-9:
        raise ValueError(f"dt_s must divide {SAMPLE_S} s, found {dt_s}")
    steps_a_block = max(1, round(BLOCK_S / dt_s))
    poses, fields, blocks, done = [], [], [], 0
    for _ in range(round(trial.seconds / SAMPLE_S)):
        for first in range(0, steps_a_sample, steps_a_block):
            steps = min(steps_a_block, steps_a_sample - first)
            started = time.thread_time()
            steps_done, blown_up = advance(done, steps)
            blocks.append((time.thread_time() - started) / (steps_done * dt_s) * 1e3)
            done += steps_done
            if blown_up:
                return GelMotion(np.empty((0, 3)), np.empty((0, 0, 2)), np.array(blocks), done * dt_s)
        pose, field = sample()
        poses.append(pose)
        fields.append(field)
    return GelMotion(np.array(poses), np.array(fields), np.array(blocks))


def simulate(
    trial: GelTrial, dt_s: float, theta: float, *, tolerance: float = 1e-6, points_xy_m: Floats | None = None
) -> GelMotion:
    """Simulate a trial with `gel.step`; raise ValueError if dt_s does not divide 10 ms."""
    state = trial.start()
    shares = trial.shares(state)
    weights = None if points_xy_m is None else dots.interpolation(state.node_xy_m, points_xy_m)

    def advance(first: int, steps: int) -> tuple[int, bool]:
        for k in range(first, first + steps):
            nodal_n = trial.grip_n((k + theta) * dt_s) * shares
            weight_n = trial.weight_n((k + theta) * dt_s)
            gel.step(state, nodal_n, weight_n, trial.friction, dt_s, theta=theta, tolerance=tolerance)
        return steps, False

    def sample() -> tuple[Floats, Floats]:
        field = state.displacement_m.reshape(-1, 2) if weights is None else dots.displacement_at(state, *weights)
        return state.pose.copy(), field.copy()

    return follow(trial, dt_s, advance, sample)
