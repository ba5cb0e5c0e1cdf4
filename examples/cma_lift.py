"""A small baseline for evetac/Lift-v0: a grip law with four parameters, found by CMA-ES, against fixed grips.

    python examples/cma_lift.py --runs 5 --jobs 2 --json lift.json

The law closes by a number of ticks beyond light contact:

    A + B * load + C * slip

load is the mean displacement of the dots in px since light contact. slip is the accumulated share of milliseconds with
slip, which decays at the rate D.

CMA-ES (from the library cma) searches A to D on objects 1 to 9 with seeds below 10,000. The mean of its last generation
is evaluated on the unseen objects 10 to 18, with seeds starting at 22,000. All results are simulated. Needs the extra
`robot`.
"""

import argparse
import json
from collections.abc import Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cma
import gymnasium
import numpy as np

from evetac_cli.gym import MOST_TICKS, LiftEnv

TRAINED_ON, JUDGED_ON = "1-9", "10-18"
JUDGED_FROM = 22_000
GRIPS = (5.0, 10.0, 15.0, 20.0, 30.0)


@dataclass
class GripLaw:
    """Computes the goal, in ticks beyond light contact, from observations; make a new one for each episode."""

    first: float
    per_px: float
    per_slip: float
    forget: float  # decay per step
    slip: float = 0.0
    rest_px: Any = None

    @classmethod
    def of(cls, theta: Sequence[float]) -> "GripLaw":
        """Return the law for four numbers near 1, which CMA-ES searches."""
        a, b, c, d = theta
        return cls(6.0 + 6.0 * a, 1.5 + 1.5 * b, 3.0 + 3.0 * c, min(max(0.02 + 0.02 * d, 0.0), 1.0))

    def goal(self, observation: dict[str, Any]) -> float:
        """Return the goal of one step."""
        mean_px = observation["displacement_px"].mean(axis=0)
        if self.rest_px is None:
            self.rest_px = mean_px
        self.slip = self.slip * (1.0 - self.forget) + float(observation["slip"][1])
        load_px = float(np.hypot(*(mean_px - self.rest_px)))
        return self.first + self.per_px * load_px + self.per_slip * self.slip


@cache
def environment(objects: str) -> LiftEnv:
    """Return the environment; each process has its own."""
    made = gymnasium.make("evetac/Lift-v0", objects=objects, disable_env_checker=True).unwrapped
    assert isinstance(made, LiftEnv)
    return made


def episode(task: tuple[str, int, tuple[float, ...]]) -> dict[str, float]:
    """Run an episode of (objects, seed, policy); a policy is (ticks,) for a fixed grip or a law's four numbers."""
    objects, seed, theta = task
    env = environment(objects)
    observation, _ = env.reset(seed=seed)
    law = GripLaw(theta[0], 0.0, 0.0, 0.0) if len(theta) == 1 else GripLaw.of(theta)
    total, force_n, over, info = 0.0, [], False, {}
    while not over:
        action = np.array([np.clip(law.goal(observation) / MOST_TICKS, 0.0, 1.0)], np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        total += reward
        force_n.append(info["normal_force_n"])
        over = terminated or truncated
    kept = {"lifted": float(info["lifted"]), "kept": float(info["balanced"])}
    return {"return": total, **kept, "grip_n": float(np.mean(force_n))}


def judge(pool: Executor, objects: str, seeds: Sequence[int], theta: tuple[float, ...]) -> dict[str, float]:
    """Return the mean results of a policy over episodes."""
    rows = list(pool.map(episode, [(objects, seed, theta) for seed in seeds]))
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def search(pool: Executor, run: int, generations: int, candidates: int, episodes: int) -> tuple[float, ...]:
    """Return the four numbers found by one run of CMA-ES; its seeds start at run * 1000."""
    options = {"seed": run + 1, "popsize": candidates, "verbose": -9, "maxiter": generations}
    strategy = cma.CMAEvolutionStrategy(4 * [0.0], 0.5, options)
    for generation in range(generations):
        asked = strategy.ask()
        thetas = [tuple(map(float, theta)) for theta in asked]
        seeds = [1000 * run + episodes * generation + number for number in range(episodes)]
        tasks = [(TRAINED_ON, seed, theta) for theta in thetas for seed in seeds]
        returns = np.array([row["return"] for row in pool.map(episode, tasks)]).reshape(len(thetas), episodes)
        strategy.tell(asked, (-returns.mean(axis=1)).tolist())
        print(f"run {run}, generation {generation}: mean return {returns.mean():.2f}", flush=True)
    return tuple(map(float, strategy.mean))


def main() -> None:
    """Search, evaluate, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--generations", type=int, default=4)
    parser.add_argument("--candidates", type=int, default=6)
    parser.add_argument("--episodes", type=int, default=2, help="episodes per candidate")
    parser.add_argument("--judged", type=int, default=20, help="episodes that evaluate each policy")
    parser.add_argument("--judged-from", type=int, default=JUDGED_FROM, help="seed of the first of these episodes")
    parser.add_argument("--grips", type=float, nargs="*", default=GRIPS, help="fixed grips, in ticks")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    seeds = range(chosen.judged_from, chosen.judged_from + chosen.judged)
    rows: list[dict[str, Any]] = []
    with ProcessPoolExecutor(chosen.jobs) as pool:
        for ticks in chosen.grips:
            rows.append(
                {"simulated": True, "policy": f"fixed, {ticks:g} ticks", **judge(pool, JUDGED_ON, seeds, (ticks,))}
            )
            print(rows[-1], flush=True)
        for run in range(chosen.runs):
            theta = search(pool, run, chosen.generations, chosen.candidates, chosen.episodes)
            row = {"simulated": True, "policy": f"CMA-ES, run {run}", **judge(pool, JUDGED_ON, seeds, theta)}
            law = GripLaw.of(theta)
            row |= {"A": law.first, "B": law.per_px, "C": law.per_slip, "D": law.forget}
            rows.append(row)
            print(row, flush=True)
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
