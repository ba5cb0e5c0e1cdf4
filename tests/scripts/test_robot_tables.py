"""scripts/robot_tables.py: what examples wrote becomes rows of a table."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import robot_tables


def test_trials_become_a_row_a_controller() -> None:
    """Assert counts, and medians over what was lifted alone."""
    trials = [
        {"controller": name, "lifted": lifted, "grip_n": grip_n, "steps_per_cpu_s": 1000.0}
        for name, lifted, grip_n in (("a", True, 2.0), ("a", True, 4.0), ("a", False, 0.0), ("b", False, 0.1))
    ]
    common = {"steps_of_1_ms_a_CPU_second_median": 1000.0}
    assert list(robot_tables.mujoco_rows(trials)) == [
        {"controller": "a", "trials": 3, "lifted": 2, "grip_at_the_end_N_median": 3.0, **common},
        {"controller": "b", "trials": 1, "lifted": 0, "grip_at_the_end_N_median": None, **common},
    ]


def test_runs_are_averaged() -> None:
    """Assert a row a policy, and the mean of the runs of CMA-ES alone."""
    figures = [("fixed, 5 ticks", 0.5), ("CMA-ES, run 0", 1.0), ("CMA-ES, run 1", 2.0)]
    policies = [{"policy": name, "return": value, "lifted": 1.0, "kept": 0.5, "grip_n": 3.0} for name, value in figures]
    rows = list(robot_tables.lift_rows(policies))
    assert [row["policy"] for row in rows] == [*(name for name, _ in figures), "CMA-ES, mean of 2 runs"]
    assert rows[-1]["return"] == 1.5
