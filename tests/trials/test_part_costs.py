"""What the parts of a scene cost, against a clock that the test moves, and once for real."""

import itertools
import json
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.record import Record
from evetac_cli.jobs import Outcome
from evetac_cli.sim.setup.parts import Timer, rows_of, untimed
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.trials import grasp, part_costs, record
from evetac_cli.trials.part_costs import BLOCK, Append, CallTimer, PartCosts, for_people, measure
from evetac_cli.trials.record import simulated
from evetac_cli.trials.trial import SimulatedTrial

WINDOW_US, NOISE_US, HOT_US, CUT_US, GEL_US, DOTS_US, OTHER_US = 20.0, 3.0, 4.0, 5.0, 40.0, 12.0, 7.0
LAW_US, ROUGH_US = 6.0, 9.0  # of friction over pressure and of roughness, as parts of the gel's
RUNS = 7  # of a measurement: the trial, and six parts switched


class SlowedClock:
    """A clock, and a simulation that moves it by what each part costs; every second run is slowed down at random."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.runs = 0
        self.slowed_us = 50.0
        self.rng = np.random.default_rng(0)

    def take(self, us: float) -> None:
        self.now_s += us * 1e-6

    def _render(self, plan: Plan) -> None:
        texture, sensor = plan.scene.texture, plan.sensor
        self.take(DOTS_US + WINDOW_US * (texture is not None and texture.show))
        self.take(NOISE_US * (sensor.noise_hz > 0) + HOT_US * (sensor.hot_pixels > 0))
        self.take(CUT_US * (sensor.cut_contrast > 0))

    def _advance(self, plan: Plan) -> None:
        self.take(GEL_US + LAW_US * (plan.sensor.friction.pressure_exponent != 0.0))
        self.take(ROUGH_US * (plan.scene.roughness is not None))

    def play(self, trial: SimulatedTrial, append: Append, timer: Timer) -> None:
        self.runs += 1
        advance, render = timer("gel and friction", self._advance), timer("camera", self._render)
        for _ in range(100_000):
            advance(trial.plan)
            render(trial.plan)
            self.take(OTHER_US + self.rng.uniform(0.0, self.slowed_us) * (self.runs // RUNS % 2))
            append(None, {})  # type: ignore[arg-type]


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[SlowedClock]:
    made = SlowedClock()
    monkeypatch.setattr(part_costs, "thread_time", lambda: made.now_s)
    yield made


@pytest.mark.parametrize("texture", ["on", "off"])
def test_costs_are_those_of_the_clock(texture: str, machine: SlowedClock) -> None:
    """Assert what each part costs or saves, whatever else the machine does in every second run."""
    (trial,) = record.jobs([], Record(texture=texture), None)
    costs = measure(trial, machine.play)
    assert costs is not None
    shown = texture == "on"
    in_camera = DOTS_US + WINDOW_US * shown + NOISE_US + HOT_US + CUT_US
    assert costs.whole_us.mean() == pytest.approx(GEL_US + LAW_US + ROUGH_US + in_camera + OTHER_US)
    rows = {row["part"]: row for row in costs.rows()}
    expected = {"gel and friction": GEL_US + LAW_US + ROUGH_US, "friction over pressure": LAW_US, "camera": in_camera}
    expected |= {"roughness of the object": ROUGH_US}
    expected |= {"dots": DOTS_US, "noise": NOISE_US, "hot pixels": HOT_US, "cut edge": CUT_US}
    for part, us in {**expected, "everything else": OTHER_US}.items():
        assert rows[part]["time_us"] == pytest.approx(us), part
    assert rows["window"]["time_us"] == (pytest.approx(WINDOW_US) if shown else None)
    assert rows["window"]["saves_us"] == (None if shown else pytest.approx(WINDOW_US))
    assert all(row["noise_us"] < 1e-6 for row in rows.values() if row["noise_us"] is not None)
    assert rows["pushes"]["time_us"] is rows["pushes"]["saves_us"] is None


def test_a_difference_within_the_noise_is_not_a_figure() -> None:
    """Assert that a cost is shown as a figure only if it exceeds its standard error, and is not below zero."""
    (trial,) = record.jobs([], Record(), None)
    whole_us = np.full(4, 100.0)
    others = {"window": whole_us - 20.0, "noise": whole_us + [9.0, -9.0, 9.0, -9.0], "cut edge": whole_us + 3.0}
    rows = PartCosts(rows_of(trial.plan), whole_us, {"camera": 50.0}, others).rows()
    shown = for_people(Outcome(rows, True, {"files": 1, "first_file": "a.recording.h5"}))[0]
    expected = {"window": "20", "noise": "< 10", "cut edge": "< 3", "dots": "33", "camera": "50"}
    assert {row["part"]: row["time_us"] for row in shown if row["part"] in expected} == expected


@pytest.mark.parametrize("budget_s", [0.5, 0.1, 1e-6])
def test_a_budget_is_kept(budget_s: float, machine: SlowedClock, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert fewer slices within a budget of time, and the same costs."""
    monkeypatch.setattr(part_costs, "BUDGET_S", budget_s)
    (trial,) = record.jobs([], Record(), None)
    machine.slowed_us = 0.0
    costs = measure(trial, machine.play)
    slice_us = GEL_US + LAW_US + ROUGH_US + DOTS_US + WINDOW_US + NOISE_US + HOT_US + CUT_US + OTHER_US
    share_s = budget_s / (1 + RUNS)  # of one run to try, and those to measure
    assert costs is not None and costs.whole_us.mean() == pytest.approx(slice_us)
    block_s = BLOCK * slice_us * 1e-6
    assert len(costs.whole_us) == (1 + int(share_s / block_s))
    assert machine.now_s < 2 * RUNS * block_s + 3 * (share_s + block_s) + max(budget_s, RUNS * block_s)


@pytest.mark.parametrize("scene", ["slip", "edge", "vibration"])
def test_a_timer_changes_nothing(scene: str) -> None:
    """Assert that a trial makes the same events and rows with a timer and without, which leaves calls as they are."""
    trial = record.jobs([], Record(scene=scene), None)[0]
    assert isinstance(trial, SimulatedTrial)
    timer = CallTimer()
    both = (simulated.play(trial)[1], simulated.play(trial, timer)[1])
    for (events, rows), (timed_events, timed_rows) in itertools.islice(zip(*both, strict=True), 60):
        assert all(map(np.array_equal, events, timed_events))
        assert all(np.array_equal(rows[name], timed_rows[name], equal_nan=True) for name in rows | timed_rows)
    parts = {"slip": {"camera", "gripper", "gel and friction"}, "vibration": {"camera"}}
    assert set(timer.seconds) == parts.get(scene, {"camera", "gel and friction"})
    assert all(seconds > 0.0 for seconds in timer.seconds.values())
    assert untimed("camera", simulated.play) is simulated.play


@pytest.mark.parametrize(("stage", "params"), [(record, Record(scene="slip")), (grasp, Grasp())])
@pytest.mark.slow
def test_a_dry_run_of_a_scene(stage: Any, params: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that calls and the rest make up the whole of a dry run, and that it says what its scene saves."""
    monkeypatch.setattr(part_costs, "_moving_slices", lambda _: 2 * BLOCK)
    shown = stage.dry_run(stage.jobs([], params, None), params, force=True)
    rows = {row["part"]: row for row in shown.rows}
    calls = ("gel and friction", "gripper", "camera", "everything else", *(["slip detector"] if stage is grasp else []))
    assert all(rows[part]["time_us"] > 0.0 for part in calls if part != "everything else")
    assert sum(rows[part]["time_us"] for part in calls) == pytest.approx(shown.summary["time_us_a_slice"])
    assert (rows["window"]["saves_us"] is not None) == (stage is grasp)
    assert shown.summary["slices_measured"] <= 2 * BLOCK  # fewer where the machine is very slow
    assert shown.summary["left_out_saves_us"] == pytest.approx(rows["window"]["saves_us"] or 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [["--scene", "slip"], ["--scene", "edge"], ["--scene", "vibration"], ["--count", "9"]]
)
def test_a_dry_run_fits_a_screen(words: list[str], machine: SlowedClock, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that it fills at most 40 lines of 80 signs, that -v says all parts, and --json too."""
    monkeypatch.setattr(simulated, "play_through", machine.play)
    run = [CliRunner().invoke(app, ["record", "--dry-run", *words, *more]) for more in ([], ["-v"], ["--json"])]
    assert [each.exit_code for each in run] == [0, 0, 0], run[0].stderr
    lines = [wrapped for line in run[0].stdout.splitlines() for wrapped in textwrap.wrap(line, 80)]
    assert len(lines) <= 40
    assert max(len(line) for line in run[0].stdout.splitlines() if line.startswith("│")) <= 80
    rows = json.loads(run[2].stdout)["rows"]
    assert {"part", "built", "time_us", "saves_us", "noise_us"} == set(rows[0])
    for row in rows:
        assert (row["part"] in run[0].stdout) or row["built"] is None
        assert row["part"] in run[1].stdout
    assert f"{sum(row['built'] is None for row in rows)} parts " in run[0].stdout


def test_a_dry_run_of_many_trials_with_devices_names_the_first(tmp_path: Path) -> None:
    """Assert that of a series of 40 trials the first five files are named, and all with -v."""
    words = ["record", "--camera", "virtual", "--gripper", "virtual", "--count", "40", "--dry-run", "-o", str(tmp_path)]
    short, whole = (CliRunner().invoke(app, [*words, *more]).stdout for more in ([], ["-v"]))
    assert "trial 4" in short and "trial 5" not in short
    assert "40 in all" in short
    assert "trial 39" in whole
