"""evaluate grasp, and its cost and stability: tables from trials made by hand, and the short grasps behind them."""

import importlib.util
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evetac_cli import params
from evetac_cli.inspect import validate
from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.numerics import cost, grasp_cost, grasp_stability, stability
from evetac_cli.numerics.grasp_trials import GraspResult, Says, Short, grasp, truthful
from evetac_cli.resources import table
from evetac_cli.stages.evaluate import grasp as evaluate_grasp
from evetac_cli.stages.evaluate.grasp import describe_setting, tables, without_gain

needs_matplotlib = pytest.mark.skipif(not importlib.util.find_spec("matplotlib"), reason="needs matplotlib")
PLANNED = {
    "controller": "paper",
    "gain": 1.0,
    "latency_ms": 0,
    "control_hz": 500.0,
    "sensor": "evetac",
    "scene": {"name": "lift", "gel": {"cut": True}},
}


def trial(setting: str = "paper", number: int = 11, *, lifted: bool = True, held: bool = True, **more: Any) -> dict:
    """What became of one grasp."""
    figures = {
        "lifted": lifted,
        "balanced": lifted and held,
        "moved_lift_mm": 0.1,
        "moved_mm": 0.4,
        "opening_after_lift_ticks": -8,
        "opening_after_balance_ticks": -6,
        "opening_after_lift_mm": -1.3,
        "opening_after_balance_mm": -1.0,
        "reopened_share": 0.25,
        "force_touch_n": 0.1,
        "force_lift_n": 1.4,
        "force_end_n": 1.0,
        "slip_events": 3,
    }
    return {"setting": setting, "object": number, "file": "x.recording.h5", **figures, **more}


def split(rows: list[dict]) -> tuple[list[dict], list[dict], list[dict]]:
    """The three tables."""
    whole = [row for row in rows if "columns" in row]
    trials = [row for row in rows if "file" in row]
    return whole, [row for row in rows if "columns" not in row and "file" not in row], trials


def test_balance_counts_trials_that_lifted() -> None:
    """Assert success of both phases, of lifting, and of balance among those that lifted, as the paper counts."""
    trials = [trial(), trial(held=False), trial(lifted=False), trial()]
    ((whole,), (row,), _) = split(tables(trials)[0])
    for result in (whole, row):
        assert (result["trials"], result["success"], result["lifted"]) == (4, 0.5, 0.75)
        assert result["balanced"] == pytest.approx(2 / 3)
    nothing = [trial("none", lifted=False)] * 5
    assert split(tables(nothing)[0])[1][0]["balanced"] is None


def test_figures_are_over_what_was_held() -> None:
    """Assert that an object that fell counts for no distance, force or opening; medians and means by hand."""
    trials = [
        trial(moved_mm=moved, opening_after_balance_ticks=end) for moved, end in ((1.0, -5), (2.0, -6), (12.0, -10))
    ]
    trials.append(trial(held=False, moved_mm=300.0, opening_after_balance_ticks=-99))
    ((whole,), _, _) = split(tables(trials)[0])
    assert whole["moved_mm_median"] == 2.0
    assert whole["moved_mm_mean"] == 5.0
    assert whole["moved_below_10_mm_share"] == pytest.approx(2 / 3)
    assert whole["opening_after_balance_ticks"] == -7.0
    assert whole["force_end_n"] == 1.0


def test_every_column_counts_the_same() -> None:
    """Assert that reduction over objects is the mean of their means, and that a gain is a column of its own."""
    trials = [trial(number=10, reopened_share=0.8), *[trial(number=11, reopened_share=0.2)] * 3]
    trials.append(trial("paper, gain 2", 14, reopened_share=0.2))
    ((whole,), objects, _) = split(tables(trials)[0])
    assert whole["setting"] == "paper"
    assert whole["columns"] == 3
    assert whole["reopened_share"] == pytest.approx(0.4)
    assert [(row["setting"], row["object"]) for row in objects] == [("paper", 10), ("paper", 11), ("paper, gain 2", 14)]


def test_the_paper_s_figures_stand_beside_their_own() -> None:
    """Assert that the paper's law stands beside its figures, object by object, and other controllers beside none."""
    trials = [trial(number=number) for number in (12, 14, 17, 18)]
    trials += [
        trial("paper, gain 2", 20),
        trial("load-proportional", 18),
        trial("load-proportional", 17),
        trial("none", 17, lifted=False),
    ]
    trials += [trial("paper, gain 2, drop-100g", 16), trial("paper, drop-20g", 16), trial("paper, second", 16)]
    whole, objects, _ = split(tables(trials)[0])
    published = {
        (row["setting"], row["object"]): (row["paper_success"], row["paper_opening_after_balance_ticks"])
        for row in objects
    }
    assert published["paper", 12] == (0.9, None)
    assert published["paper", 14] == (0.6, None)
    assert published["paper", 17] == (1.0, -7.6)
    assert published["paper", 18] == (1.0, -13.4)
    assert published["paper, gain 2", 20] == (1.0, None)
    assert published["load-proportional", 18] == (None, None)
    over = {row["setting"]: (row["paper_success"], row["paper_reopened_share"]) for row in whole}
    assert over["paper"] == (0.93, 0.43)
    assert over["load-proportional"] == (None, None)
    assert over["none"] == (0.0, None)
    assert over["paper, drop-100g"] == (1.0, None)
    assert over["paper, drop-20g"] == (0.9, None)
    assert over["paper, second"] == (0.95, None)


def test_the_paper_s_failures_make_its_93_percent() -> None:
    """Assert that the failures of the text are those of 120 trials with 93 %: it does not say 14's with higher gain."""
    grasps = table("paper")["grasp"]
    columns = [*grasps["objects"].values(), *grasps["objects_higher_gain"].values()]
    failures = sum(10 * (1 - row["lifted"] * row["balanced"]) for row in columns)
    assert failures == pytest.approx(6)
    assert 0.925 <= 1 - (failures + 2) / 120 < 0.935


@pytest.mark.parametrize(
    ("changes", "setting"),
    [
        ({}, "paper"),
        ({"controller": "load-proportional"}, "load-proportional"),
        ({"gain": 2.0}, "paper, gain 2"),
        ({"scene": {"name": "drop-20g", "gel": {"cut": True}}}, "paper, drop-20g"),
        ({"sensor": "second", "scene": {"name": "lift", "gel": {"cut": False}}}, "paper, second, closed gel"),
        ({"latency_ms": 20, "control_hz": 100.0}, "paper, 20 ms late, 100 Hz"),
    ],
)
def test_a_setting_says_what_is_unusual(changes: dict, setting: str) -> None:
    """Assert the name of each setting, and that a recording of before these flags is a usual one."""
    assert describe_setting({**PLANNED, **changes}) == setting
    older = {key: value for key, value in PLANNED.items() if key not in ("gain", "latency_ms", "control_hz")}
    assert describe_setting(older) == "paper"
    assert "gain" not in without_gain(setting)


@needs_matplotlib
def test_the_picture() -> None:
    """Assert that it draws with one object and with many, failures and more settings than colours included."""
    from matplotlib.figure import Figure

    for trials in (
        [trial()],
        [trial(f"fixed:{n}", number) for n in range(12) for number in (18, 10, 2)],
        [trial(lifted=False)],
    ):
        figure = Figure()
        evaluate_grasp._draw(figure, tables(trials)[0])
        assert len(figure.axes) == len(evaluate_grasp.PANELS)


# --- short grasps, cost and stability ---


@pytest.fixture(scope="module")
def short() -> GraspResult:
    """A short grasp with the package's detector."""
    return grasp(Short(11, "load-proportional", lift_s=1.0, balance_s=0.1), 3)


def test_a_short_grasp(short: GraspResult) -> None:
    """Assert that it lifts, that the rows are those of a recording, and that every slice was timed."""
    assert short.rows["truth/table_gap_mm"][-1] > 5.0
    assert len(short.feel_us) == len(short.rows["truth/table_gap_mm"]) == 1500 + 1000 + 100
    assert (short.feel_us > 0).all()
    assert "events/t" not in short.rows


def test_a_lost_object_ends_it() -> None:
    """Assert that a grasp ends soon after the hand has left its object behind."""
    held = grasp(Short(11, "none", balance_s=30.0), 3)
    moved_mm = np.hypot(*held.rows["truth/object_xy_px"].T) * 0.0329
    assert 20.0 < moved_mm[-1] < 30.0
    assert len(moved_mm) < 5000
    assert not held.figures["lifted"]


def test_what_is_not_ok(short: GraspResult) -> None:
    """Assert that numbers that are not finite, a goal out of range, too much current and swinging fingers are not."""
    assert grasp_stability.judged("as it is", short)["ok"]
    swings = short.rows["gripper/position_ticks"].copy()
    swings[::2] += 9
    for path, value in (
        ("truth/normal_force_n", np.full(2600, np.nan)),
        ("control/goal_ticks", np.full(1300, 741)),
        ("gripper/current_ma", np.full(1300, 700.0)),
        ("gripper/position_ticks", swings),
    ):
        figures = {**short.figures, "balanced": True}  # fingers that lost their object may close
        wrong = replace(short, figures=figures, rows={**short.rows, path: value})
        assert not grasp_stability.judged("wrong", wrong)["ok"]


class Counts:
    """A detector that counts the slices it is given."""

    def __init__(self) -> None:
        self.slices, self.signal = 0, SlipSignal(mean_displacement_x_px=1.5)

    def step(self, events) -> float:
        self.slices += 1
        return 0.25


def test_detectors_that_are_lied_to() -> None:
    """Assert that slices are lost and doubled in their shares, and that one that always fires does, with its drag."""
    for lost, twice, times in ((0.2, 0.0, 0.8), (0.0, 0.2, 1.2)):
        counts = Counts()
        uneven = grasp_stability.Uneven(counts, np.random.default_rng(0), lost, twice)
        reported = [uneven.step(None) for _ in range(5000)]
        assert counts.slices == pytest.approx(5000 * times, rel=0.03)
        assert np.isnan(reported).mean() == pytest.approx(lost, abs=0.02)
    for says in (True, False):
        sense = Says(Counts(), lambda says=says: says)
        assert [sense.step(None) for _ in range(3)] == [float(says)] * 3
        assert sense.signal == SlipSignal(3 * says, mean_displacement_x_px=1.5)


def test_every_case_is_another() -> None:
    """Assert that the suite has all that was asked for, each once, and more when it is full."""
    usual, full = grasp_stability.cases(full=False), grasp_stability.cases(full=True)
    names = [case.name for case in usual]
    assert len(set(names)) == len(names)
    assert {"detector never fires", "detector always fires", "mass 5 g", "mass 2000 g", "friction 0.1", "friction 2",
            "gel stiffness x0.1", "gel stiffness x10", "one slice in five lost", "one slice in five twice",
            "law's gain x0.1", "law's gain x10"} <= set(names)  # fmt: skip
    assert len(full) > len(usual)
    assert len(grasp_stability.suite(0)) == 2 * len(usual) - sum(case.paper_only for case in usual)


def test_refusals_are_said(monkeypatch) -> None:
    """Assert that a case that cannot be simulated is ok, and says why."""

    def refuse(*_: Any, **__: Any) -> GraspResult:
        raise ValueError("mass_kg must be > 0")

    monkeypatch.setattr(grasp_stability, "grasp", refuse)
    row = grasp_stability.case_row(grasp_stability.Case("nothing"), "paper", 0)
    assert row["ok"]
    assert row["outcome"].startswith("refused: mass_kg")


def fake(short: Short, seed: int, *_: Any, **__: Any) -> GraspResult:
    """A grasp that is lost the later the detector is."""
    lost = short.latency_ms > 10
    return GraspResult(trial(held=not lost, moved_mm=0.1 * short.latency_ms, force_end_n=1.0), {}, np.full(100, 90.0))


def test_cost_of_a_late_detector(tmp_path, monkeypatch) -> None:
    """Assert a row for every setting and controller, with errors and run times, in a report with a picture."""
    monkeypatch.setattr(grasp_cost, "grasp", fake)
    chosen = params.EvaluateCost(part="grasp")
    (job,) = cost.jobs([], chosen, tmp_path)
    made = cost.run(job, chosen)
    assert job.output.name == "grasp.cost.report.h5"
    assert len(made.rows) == 2 * (1 + 4 + 3 + 1) == made.summary["settings"]
    rows = {row["setting"]: row for row in made.rows}
    assert rows["paper, latency 5 ms"]["error_mm_moved"] == pytest.approx(0.5)
    assert rows["load-proportional, latency 50 ms"]["error_share_lost"] == 1.0
    assert rows["load-proportional, latency 50 ms"]["error_mm_moved"] is None
    assert rows["load-proportional, detector truth"]["time_us_median"] == 90.0
    assert [row["faults"] for row in validate.run([job.output]).rows] == [None]
    assert made.simulated


def test_the_truth_as_a_detector() -> None:
    """Assert that it counts slices in which the simulation says slip, whatever the network says."""

    class Devices:
        now = 0

        def truth(self) -> dict:
            self.now += 1
            return {"truth/slip": self.now in (2, 3, 7)}

    sense = truthful(Counts(), Devices())
    assert [sense.step(None) for _ in range(8)] == [0, 1, 1, 0, 0, 0, 1, 0]
    assert sense.signal == SlipSignal(3, mean_displacement_x_px=1.5)


def test_stability_is_a_report(tmp_path, monkeypatch) -> None:
    """Assert rows of cases with the largest current over all in the summary."""
    case = grasp_stability.Case("as usual")
    monkeypatch.setattr(grasp_stability, "cases", lambda full: [case])

    def row(case: grasp_stability.Case, controller: str, seed: int) -> dict:
        name, current_ma = f"{controller}: {case.name}", 25.0 if controller == "paper" else 50.0
        return grasp_stability.ROWS.row(name, True, "held", current_most_ma=current_ma)

    monkeypatch.setattr(grasp_stability, "case_row", row)
    chosen = params.EvaluateStability(part="grasp")
    (job,) = stability.jobs([], chosen, tmp_path)
    made = stability.run(job, chosen)
    assert [row["case"] for row in made.rows] == ["paper: as usual", "load-proportional: as usual"]
    assert made.summary["current_most_ma"] == 50.0
    assert made.summary["ok"] == 2


def test_a_table_of_a_real_grasp(made, tmp_path) -> None:
    """Assert that a recording of grasp becomes a row in each of the three tables, alike in all."""
    chosen = params.EvaluateGrasp()
    (job,) = evaluate_grasp.jobs([made.grasp], chosen, tmp_path)
    whole, objects, trials = split(evaluate_grasp.run(job, chosen).rows)
    assert len(whole) == len(objects) == len(trials) == 1
    assert whole[0]["setting"] == objects[0]["setting"] == trials[0]["setting"] == "paper"
    assert trials[0]["object"] == objects[0]["object"] == 11
    assert whole[0]["success"] == float(trials[0]["balanced"])
