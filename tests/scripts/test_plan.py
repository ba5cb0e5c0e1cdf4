"""scripts/plan.py: what the reproduction costs, from counts and the cost of a task."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import plan
from plan import Costs, Step


@pytest.fixture
def costs() -> Costs:
    """One second, one byte and one second of recording for whatever is asked for."""

    class Ones(dict[str, dict[str, float]]):
        def __missing__(self, name: str) -> dict[str, float]:
            return {"cpu_s": 1.0, "size_bytes": 1.0, "seconds": 1.0}

    return Ones()


def test_every_command_is_counted(costs: Costs) -> None:
    """Assert that files are as many as the sizes say, and that each stage works on those made before it."""
    planned = list(plan.steps(costs))
    slips = [step for step in planned if step.experiment == "paper-recipe" and step.command == "record slip"]
    assert [step.tasks for step in slips] == 2 * [9 * 35, 9 * 5, 9 * 10, 8 * 10]  # the second time without noise
    trained = [step for step in planned if step.command == "train no-hist"]
    assert [step.tasks for step in trained] == [2, 3]
    # steps, files read, files judged by three checkpoints
    assert {step.cpu_s for step in trained} == {150_000 + (9 * 35 + 9 * 5) + 9 * 5 * 3}
    tracked = [step for step in planned if step.experiment == "tracking" and step.command.startswith("track ")]
    assert sum(step.tasks for step in tracked) == 4 * (50 + 5 + 2 * (5 + 1))
    (labels,) = [step for step in planned if step.command == "evaluate labels" and step.experiment == "demo"]
    assert (labels.tasks, labels.cpu_s) == (1, 9.0)  # of nine recordings
    force = [step for step in planned if step.experiment == "force" and step.command.startswith("track")]
    assert [step.tasks for step in force] == [4, 4, 4, 3, 3, 3, *(9 * [1])]


def test_no_cost_is_missing() -> None:
    """Assert that the costs that come with the script are those of today's experiments."""
    assert all(step.cpu_s > 0 for step in plan.steps(json.loads(plan.COSTS.read_text())))


def test_cores_without_tasks_are_of_no_use() -> None:
    """Assert that commands wait for each other, and that no order goes below the longest chain."""
    planned = [Step("a", "record slip", 100, 36.0, 1e9), Step("a", "train x", 5, 360.0, 0.0)]
    one, all_ = plan.table(planned, [1, 16, 256])
    assert one | {"experiment": "all"} == all_
    assert (all_["tasks"], all_["size_gb"]) == (105, 100.0)
    assert [all_[f"hours_on_{cores}"] for cores in (1, 16, 256)] == pytest.approx([1.5, 0.17, 0.11])
    least = plan.least(planned, [1, 16, 256])
    assert list(least.values()) == pytest.approx([1.5, 0.11, 0.11])


def test_a_star_stays_within_a_folder() -> None:
    """Assert that patterns find what a shell would."""
    made = [plan.Files(name, 1, 1.0) for name in ("a.recording.h5", "b/a.recording.h5", "b/c/a.recording.h5")]
    assert plan.matching(["*.recording.h5"], made) == made[:1]
    assert plan.matching(["*/*.recording.h5"], made) == made[1:2]


def test_many_trajectories(costs: Costs) -> None:
    """Assert that trajectories do not wait for each other."""
    (row,) = plan.many(costs, [1000], [1, 256])
    assert row["core_hours"] == row["hours_on_1"] == pytest.approx(1000 * 4 / 3600)
    assert row["hours_on_256"] == pytest.approx(4 * 4 / 3600)
