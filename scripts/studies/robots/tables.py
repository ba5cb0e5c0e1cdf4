"""The tables of touch in robot simulators: the cost of a step of the touch sensor, and the results of the examples."""

import json
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import evetac_cli as evetac
from evetac_cli.jobs import Row
from scripts.reproduce.experiment import Experiment, Study, measured
from scripts.reproduce.steps import Command, Sizes
from scripts.reproduce.tables import Evaluation, Evaluations

BOX = {"shape": "flat", "static_friction": 0.8}
BALL = {"shape": "sphere", "width_mm": 40, "static_friction": 0.8}

Drive = Callable[[int], dict[str, Any]]  # returns the contact required at the end of a given millisecond

# Contacts by name: the object that touches the sensor, and the contact over time.
CASES: dict[str, tuple[Any, Drive]] = {
    "nothing touches": (BOX, lambda _: {"normal_n": 0.0}),
    "held still, 3 N": (BOX, lambda _: {"normal_n": 3.0}),
    "sheared there and back, sticks": (BOX, lambda ms: {"normal_n": 3.0, "shear_n": (np.sin(ms / 50), 0.0)}),
    "slides at 20 mm/s": (BOX, lambda ms: {"normal_n": 3.0, "place_m": (2e-5 * ms, 0.0)}),
    "a ball rubs at 20 mm/s": (BALL, lambda ms: {"normal_n": 3.0, "place_m": (2e-5 * ms - 5e-3, 0.0)}),
}


def cost_rows(rounds: int, duration_ms: int) -> Iterator[Row]:
    """Yield a row per contact with the CPU time in us per simulated ms, as the median over rounds.

    Each row has the sensor alone, and the sensor with the slip detector.
    """
    for case, (touching, drive) in CASES.items():
        row: Row = {"contact": case}
        for heading, detects in (("CPU_us_a_ms", False), ("with_slip_detector_CPU_us_a_ms", True)):
            took = []
            for number in range(rounds):
                begin_m = drive(0).get("place_m", (0.0, 0.0))
                sensor = evetac.TouchSensor(object=touching, rng=np.random.default_rng(number), at_m=begin_m)
                detector = evetac.SlipDetector(sensor) if detects else None
                sensor.step(0.05, normal_n=drive(0)["normal_n"])
                began = time.process_time()
                for ms in range(1, duration_ms + 1):
                    touch = sensor.step(1e-3, **drive(ms))
                    if detector is not None:
                        detector.step(touch.slices[0])
                took.append((time.process_time() - began) / duration_ms * 1e6)
            row[heading] = statistics.median(took[1:])  # the first round may compile
        yield row


def mujoco_rows(trials: list[Row]) -> Iterator[Row]:
    """Yield one row per controller."""
    for controller in dict.fromkeys(row["controller"] for row in trials):
        of_one = [row for row in trials if row["controller"] == controller]
        grips = [row["grip_n"] for row in of_one if row["lifted"]]
        yield {
            "controller": controller,
            "trials": len(of_one),
            "lifted": sum(row["lifted"] for row in of_one),
            "grip_at_the_end_N_median": statistics.median(grips) if grips else None,
            "steps_of_1_ms_a_CPU_second_median": statistics.median(row["steps_per_cpu_s"] for row in of_one),
        }


def lift_rows(policies: list[Row]) -> Iterator[Row]:
    """Yield one row per policy, then one with the mean over all CMA-ES runs."""
    names = {"return": "return", "lifted": "lifted", "kept": "kept", "grip_n": "mean_grip_N"}
    for row in policies:
        yield {"policy": row["policy"], **{heading: row[name] for name, heading in names.items()}}
    runs = [row for row in policies if row["policy"].startswith("CMA")]
    means = {heading: statistics.mean(row[name] for row in runs) for name, heading in names.items()}
    yield {"policy": f"CMA-ES, mean of {len(runs)} runs", **means}


def simulated(name: str, rows: Iterable[Row], trials: int) -> Evaluations:
    """Return the rows of one table as simulated evaluations, with the number of trials behind them."""
    return {name: Evaluation(list(rows), {}, simulated=True, about={"sizes": {"trials": trials}})}


def touch_cost(sizes: Sizes, folder: Path, jobs: int) -> Evaluations:
    """Measure the cost of a step."""
    return simulated("touch-cost", cost_rows(sizes["rounds"], sizes["ms"]), sizes["rounds"] * len(CASES))


def mujoco_grasps(sizes: Sizes, folder: Path, jobs: int) -> Evaluations:
    """Summarise the trials of examples/mujoco_grasp.py."""
    trials = json.loads((folder / trials_file(sizes)).read_text())
    return simulated("mujoco-grasps", mujoco_rows(trials), len(trials))


def lift_baseline(sizes: Sizes, folder: Path, jobs: int) -> Evaluations:
    """Summarise the policies of examples/cma_lift.py."""
    policies = json.loads((folder / trials_file(sizes)).read_text())
    return simulated("lift-baseline", lift_rows(policies), len(policies) * sizes["judged"])


def mujoco_steps(sizes: Sizes) -> Iterator[Command]:
    yield ["python", "examples/mujoco_grasp.py", "--trials", str(sizes["trials"]), "--seed", str(sizes["seed"]),
           "--json", trials_file(sizes)]  # fmt: skip


def lift_steps(sizes: Sizes) -> Iterator[Command]:
    flags = (word for name, value in sizes.items() for word in (f"--{name.replace('_', '-')}", str(value)))
    yield ["python", "examples/cma_lift.py", *flags, "--json", trials_file(sizes)]


def trials_file(sizes: Sizes) -> str:
    """Return an example's output file, named by its sizes, because it has no recipe that distinguishes runs."""
    return "-".join(str(value) for value in sizes.values()) + ".json"


TOUCH_COST = measured(
    "touch-cost",
    "Run time of a simulated millisecond of the touch sensor",
    ("contact", "{contact}"),
    ("CPU us per ms", "{CPU_us_a_ms:,.1f}"),
    ("with slip detector CPU us per ms", "{with_slip_detector_CPU_us_a_ms:,.1f}"),
)
MUJOCO_GRASPS = measured(
    "mujoco-grasps",
    "Grasps in MuJoCo",
    ("controller", "{controller}"),
    ("trials", "{trials}"),
    ("lifted", "{lifted}"),
    ("grip at the end N median", "{grip_at_the_end_N_median:.2f}"),
    ("steps of 1 ms a CPU second median", "{steps_of_1_ms_a_CPU_second_median:,.0f}"),
)
LIFT_BASELINE = measured(
    "lift-baseline",
    "Policies for evetac/Lift-v0, means over the evaluated episodes",
    ("policy", "{policy}"),
    ("return", "{return:.3g}"),
    ("lifted", "{lifted:.3g}"),
    ("kept", "{kept:.3g}"),
    ("mean grip N", "{mean_grip_N:.3g}"),
)
STUDY = Study(
    experiments=(
        Experiment(
            "touch-cost", "cost of a step of the touch sensor", "data/touch-cost", 0.1,
            full={"rounds": 4, "ms": 500}, small={"rounds": 2, "ms": 50},
            measure=touch_cost,
            tables=(TOUCH_COST,),
        ),
        Experiment(
            "mujoco-grasps", "grasps in MuJoCo with evetac's touch sensor, detector and laws", "data/mujoco-grasps",
            0.1, full={"trials": 20, "seed": 22_000}, small={"trials": 1},
            steps=mujoco_steps, measure=mujoco_grasps,
            tables=(MUJOCO_GRASPS,),
        ),
        Experiment(
            "lift-baseline", "a grip law found by CMA-ES compared with fixed grips", "data/lift-baseline", 0.5,
            full={"runs": 5, "generations": 4, "candidates": 6, "episodes": 2, "judged": 20, "judged_from": 22_000},
            small={"runs": 1, "generations": 1, "candidates": 4, "episodes": 1, "judged": 1},
            steps=lift_steps, measure=lift_baseline,
            tables=(LIFT_BASELINE,),
        ),
    ),
    checks={
        "touch-cost": "run times alone, which no run repeats",
        "mujoco-grasps": "an example's results, which need MuJoCo",
        "lift-baseline": "an example's results",
    },
)  # fmt: skip
