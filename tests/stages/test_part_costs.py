"""What the parts of a scene cost, against a clock that the test moves, and once for real."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evetac_cli.params.grasp import Grasp
from evetac_cli.params.recording import Record
from evetac_cli.stages import grasp, part_costs, record
from evetac_cli.stages.part_costs import BLOCK, Append, measure
from evetac_cli.stages.trials import SimulatedTrial

WINDOW_US, NOISE_US, CUT_US, GEL_US, DOTS_US, OTHER_US = 20.0, 3.0, 5.0, 40.0, 12.0, 7.0


class SlowedClock:
    """A clock, and a simulation that moves it by what each part costs; every second run is slowed down at random."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.runs = 0
        self.slowed_us = 50.0
        self.rng = np.random.default_rng(0)
        self.gel = SimpleNamespace(step=lambda: self.take(GEL_US))
        self.camera = SimpleNamespace(render=self._render)

    def take(self, us: float) -> None:
        self.now_s += us * 1e-6

    def _render(self, plan: dict[str, Any]) -> None:
        shown = plan["scene"]["texture"].get("show", True)
        self.take(DOTS_US + WINDOW_US * shown)
        self.take(NOISE_US * (plan["sensor_row"]["noise_hz"] > 0) + CUT_US * (plan["sensor_row"]["cut_contrast"] > 0))

    def play(self, trial: SimulatedTrial, append: Append) -> None:
        self.runs += 1
        for _ in range(100_000):
            self.gel.step()
            self.camera.render(trial.plan)
            self.take(OTHER_US + self.rng.uniform(0.0, self.slowed_us) * (self.runs // 4 % 2))
            append(None, {})  # type: ignore[arg-type]


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[SlowedClock]:
    made = SlowedClock()
    monkeypatch.setattr(part_costs, "thread_time", lambda: made.now_s)
    timers = (("gel and friction", made.gel, "step"), ("camera", made.camera, "render"))
    monkeypatch.setattr(part_costs, "_scene_timers", lambda: timers)
    yield made


@pytest.mark.parametrize("texture", ["on", "off"])
def test_costs_are_those_of_the_clock(texture: str, machine: SlowedClock) -> None:
    """Assert what each part costs or saves, whatever else the machine does in every second run."""
    (trial,) = record.jobs([], Record(texture=texture), None)
    costs = measure(trial, machine.play, 4)
    shown = texture == "on"
    in_camera = DOTS_US + WINDOW_US * shown + NOISE_US + CUT_US
    assert costs.slices % BLOCK == 0
    assert costs.whole.mean() == pytest.approx(GEL_US + in_camera + OTHER_US)
    rows = {row["part"]: row for row in costs.rows()}
    expected = {"gel and friction": GEL_US, "camera": in_camera, "dots": DOTS_US, "noise": NOISE_US, "cut edge": CUT_US}
    for part, us in {**expected, "everything else": OTHER_US}.items():
        assert rows[part]["time_us"] == pytest.approx(us), part
    assert rows["window"]["time_us"] == (pytest.approx(WINDOW_US) if shown else None)
    assert rows["window"]["saves_us"] == (None if shown else pytest.approx(WINDOW_US))
    assert rows["pushes"]["time_us"] is rows["pushes"]["saves_us"] is None


@pytest.mark.parametrize("budget_s", [0.5, 0.1, 1e-6])
def test_a_budget_is_kept(budget_s: float, machine: SlowedClock) -> None:
    """Assert fewer slices, then fewer repeats within a budget of time, and the same costs."""
    (trial,) = record.jobs([], Record(), None)
    machine.slowed_us = 0.0
    costs = measure(trial, machine.play, 50, budget_s=budget_s)
    block_s = BLOCK * (GEL_US + DOTS_US + WINDOW_US + NOISE_US + CUT_US + OTHER_US) * 1e-6
    share_s = budget_s / 5  # of one run to try, and four to measure
    assert costs.slices == BLOCK * max(1, 1 + int(share_s / block_s))
    assert costs.whole.sum() * BLOCK * 1e-6 == pytest.approx(block_s * costs.slices / BLOCK)
    assert machine.now_s < 4 * 2 * block_s + 2 * (share_s + block_s) + max(budget_s, 4 * block_s)


def test_timers_are_taken_off_again(machine: SlowedClock) -> None:
    """Assert that the calls which were timed are afterwards what they were, also where a trial fails."""
    before = machine.gel.step, machine.camera.render
    (trial,) = record.jobs([], Record(), None)

    def fails(trial: SimulatedTrial, append: Append) -> None:
        machine.play(trial, append if machine.runs < 5 else lambda events, rows: 1 / 0)  # type: ignore[arg-type, return-value]

    with pytest.raises(ZeroDivisionError):
        measure(trial, fails, 2)
    assert (machine.gel.step, machine.camera.render) == before


@pytest.mark.parametrize(("stage", "params"), [(record, Record(scene="slip")), (grasp, Grasp())])
@pytest.mark.slow
def test_a_dry_run_of_a_scene(stage: Any, params: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that calls and the rest make up the whole of a dry run, and that it says what its scene saves."""
    monkeypatch.setattr(part_costs, "_moving_slices", lambda *_: 2 * BLOCK)
    shown = stage.dry_run(stage.jobs([], params, None), params, force=True)
    rows = {row["part"]: row for row in shown.rows}
    calls = ("gel and friction", "gripper", "camera", "everything else", *(["slip detector"] if stage is grasp else []))
    assert all(rows[part]["time_us"] > 0.0 for part in calls if part != "everything else")
    assert sum(rows[part]["time_us"] for part in calls) == pytest.approx(shown.summary["time_us_a_slice"])
    assert (rows["window"]["saves_us"] is not None) == (stage is grasp)
    assert shown.summary["slices_measured"] in (BLOCK, BLOCK * 2)  # fewer where the machine is very slow
    assert shown.summary["left_out_saves_us"] == pytest.approx(rows["window"]["saves_us"] or 0.0)
