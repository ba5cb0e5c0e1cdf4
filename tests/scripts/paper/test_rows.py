"""scripts/paper/rows.json: every row of the paper, what is computed of it, and the places that it names."""

import copy
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from evetac_cli.commands.grasp import Grasp
from evetac_cli.evaluate import PAPER
from evetac_cli.evaluate.common import marks
from evetac_cli.evaluate.common.marks import Source
from evetac_cli.evaluate.grasp import BALANCE_S, LIFT_S
from evetac_cli.evaluate.likeness.facts import facts
from evetac_cli.evaluate.slip import SEEDS, TRAINED_ON
from evetac_cli.kernels import estimates
from evetac_cli.kernels.estimates import Estimate
from scripts.paper import rows as paper_rows
from scripts.paper import verdicts
from scripts.paper.verdicts import AGREES, COMPATIBLE, DIFFERENT, UNDECIDED
from scripts.reproduce import steps
from scripts.reproduce.plan import EXPERIMENTS

ROOT = paper_rows.ROOT
CONTENT = paper_rows.read()
ROWS = CONTENT["rows"]
FIGURES = [one for one in ROWS if one["kind"] == "figure"]


def test_every_row_of_the_paper_occurs() -> None:
    """Assert that the numbers 1 to 100 occur, each with letters only where it is split, and each entry once."""
    numbers = [one["number"] for one in ROWS]
    assert len(numbers) == len(set(numbers))
    assert sorted({int(re.sub(r"[a-z]$", "", number)) for number in numbers}) == list(range(1, 101))
    assert {one["kind"] for one in ROWS} == {"figure", "method", paper_rows.NOT_APPLICABLE}


def test_what_is_written_is_what_is_computed() -> None:
    """Assert that figures, spreads, marks, verdicts and the list of what is awaited follow from the tables of today."""
    filled = paper_rows.filled(CONTENT)
    wrong = [old["number"] for old, new in zip(ROWS, filled["rows"], strict=True) if old != new]
    assert wrong == [], "run python scripts/paper/rows.py"
    assert filled["awaiting"] == CONTENT["awaiting"], "run python scripts/paper/rows.py"
    for line in CONTENT["awaiting"]:  # tables of before the freeze lack what intervals are made of
        table = json.loads((ROOT / "docs" / "results" / f"{line.split(': ')[1]}.json").read_text())
        assert "frozen" not in table, line


@pytest.mark.parametrize("key", ["ours", "mark", "verdict"])
def test_a_change_by_hand_is_noticed(key: str) -> None:
    """Assert that a digit, a mark or a verdict changed by hand differs from what is computed."""
    changed = copy.deepcopy(CONTENT)
    entry = next(one for one in changed["rows"] if one["computed"].get("mark") == marks.SIZE)
    entry["computed"][key] = {"ours": entry["computed"]["ours"] + 0.01, "mark": marks.SAME, "verdict": "reproduced"}[
        key
    ]
    assert paper_rows.filled(changed) != changed


def test_marks_are_those_of_the_tables() -> None:
    """Assert that the mark of a figure is the one that its table shows beside the paper's."""
    compared = 0
    for one in FIGURES:
        if "column" not in one or "mark" not in one["computed"]:
            continue
        result, row = paper_rows.row_of(paper_rows.RESULTS, one["table"], one["row"])
        source = Source.from_json(result.get("sources", {}).get(row.get("evaluation")) or result["source"])
        if beside := PAPER.beside(one["column"], row, source):
            assert (beside.value, beside.mark) == (one["computed"]["paper"], one["computed"]["mark"]), one["number"]
            compared += 1
    assert compared > 0


def test_figures_have_tables() -> None:
    """Assert that at least 95 % of the figures name a table of the experiments, row and field, or others of them."""
    names = {table.name for experiment in EXPERIMENTS for table in experiment.tables}
    numbers = {one["number"] for one in ROWS}
    with_table = [one for one in FIGURES if one.get("table") in names and one["row"] and one["field"]]
    derived = [one for one in FIGURES if set(*one.get("derived", {0: [""]}).values()) <= numbers]
    assert len(with_table) + len(derived) >= 0.95 * len(FIGURES)
    for one in FIGURES:
        assert one.get("column", "paper_success") in PAPER.columns, one["number"]
        assert {claim["row"] for claim in one.get("direction", []) if "row" in claim} <= numbers, one["number"]


def test_roles_agree_with_the_constants() -> None:
    """Assert that no constant was chosen by a prediction, and that figures which constants saw have that role."""
    groups = json.loads((ROOT / "scripts" / "reproduce" / "seeds.json").read_text())["groups"]
    near = {tuple(key) for group in groups for key in group.get("near", [])}
    for one in FIGURES:
        figure = paper_rows.published(one)
        keys = [key for key, value in PAPER.figures.items() if value is figure]
        if one["computed"].get("mark") == marks.FITTED:
            assert one["role"] == "fit", one["number"]
        if near.intersection(keys):
            assert one["role"] in ("near", "fit"), one["number"]


def test_about_half_of_the_figures_are_predictions() -> None:
    """Assert that tracking, force, slip, its timing and grasps have predictions, and that each unit has a margin."""
    predicted = [one for one in FIGURES if one["role"] == "prediction"]
    assert {one["role"] for one in FIGURES} == {"fit", "near", "prediction"}
    assert len(FIGURES) / 2 <= len(predicted) <= 0.75 * len(FIGURES)
    for first in (19, 41, 69, 82, 91):
        assert any(int(one["number"][:2]) == first for one in predicted), first
    assert {one["computed"]["unit"] for one in FIGURES if "unit" in one["computed"]} <= CONTENT["margins"].keys()
    assert {fact.name for fact in facts()} >= set(CONTENT["may_fit_likeness"])


def test_methods_name_modules_and_tests() -> None:
    """Assert that the module and the test of each method exist."""
    for one in (one for one in ROWS if one["kind"] == "method"):
        path, _, name = one["test"].partition("::")
        assert (ROOT / one["module"]).is_file(), one["number"]
        assert re.search(rf"^(?:async )?def {name}\(", (ROOT / path).read_text(), re.MULTILINE), one["number"]


def test_what_differs_has_a_reason() -> None:
    """Assert that each figure that differs, each row that is not applicable and each other method has a reason."""
    for one in ROWS:
        if one["computed"]["verdict"] in (DIFFERENT, paper_rows.NOT_APPLICABLE):
            assert one["why"], one["number"]
        if one["computed"]["verdict"] == paper_rows.OTHER:
            assert one["differs"], one["number"]
        assert one["computed"]["verdict"] in (*paper_rows.VERDICTS, paper_rows.NOT_YET)


# The rules -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def tables(tmp_path: Path) -> Path:
    """Tables of two settings: shares of 100 trials and their intervals."""
    rows = [
        {"name": "good", "share": 0.9, "low": 0.8, "high": 0.95, "trials": 100, "still": 2.0},
        {"name": "near", "share": 0.86, "low": 0.76, "high": 0.92, "trials": 100, "still": 0.5},
        {"name": "bad", "share": 0.5, "low": 0.4, "high": 0.6, "trials": 100, "still": 0.5},
    ]
    (tmp_path / "a.json").write_text(json.dumps({"rows": rows, "source": {}}))
    return tmp_path


def entry(name: str, **more: Any) -> dict[str, Any]:
    """An entry about a row of the table."""
    about = {"number": name, "kind": "figure", "table": "a", "row": {"name": name}, "field": "share"}
    return {**about, "interval": ["low", "high"], **more}


def verdict(one: dict[str, Any], tables: Path, *others: dict[str, Any]) -> str:
    """The verdict of an entry among others."""
    found: str = paper_rows.computed(one, paper_rows.by_number([one, *others]), tables)["verdict"]
    return found


@pytest.mark.parametrize(
    ("hits", "low", "high"),
    [((56, 70, 48, 80), 0.0524, 0.3339), ((9, 10, 3, 10), 0.1705, 0.8090), ((6, 7, 2, 7), 0.0582, 0.8062)],
)
def test_intervals_of_differences(hits: tuple[int, int, int, int], low: float, high: float) -> None:
    """Assert the intervals that Newcombe (1998, table II, method 10) prints."""
    found = verdicts.difference(estimates.share(*hits[:2]), estimates.share(*hits[2:]))
    assert found[1:] == pytest.approx((low, high), abs=5e-5)


def test_a_difference_of_means_is_close_to_welch() -> None:
    """Assert that means of samples with other sds have the interval of Welch's test, within 5 %."""
    rng = np.random.default_rng(1)
    samples = [rng.normal(mean, sd, n) for mean, sd, n in ((3.0, 1.0, 12), (2.0, 2.0, 9))]
    of_each = [Estimate(float(one.mean()), *stats.ttest_1samp(one, 0).confidence_interval()) for one in samples]
    welch = stats.ttest_ind(*samples, equal_var=False).confidence_interval()
    assert verdicts.difference(*of_each)[1:] == pytest.approx(tuple(welch), rel=0.05)


@pytest.mark.parametrize(
    ("value", "about", "expected"),
    [
        (0.9, {"trials": 2000}, AGREES),
        (0.95, {"trials": 100}, COMPATIBLE),
        (0.9, {"trials": 10}, UNDECIDED),
        (1.0, {"trials": 10}, UNDECIDED),  # 10 of 10 against 90 of 100
        (0.5, {"trials": 10}, DIFFERENT),
        (0.9, {}, AGREES),
        (0.7, {}, DIFFERENT),
        (0.9, {"trials": 4, "sd": 0.3}, UNDECIDED),
        (0.9, {"trials": 400, "sd": 0.3}, AGREES),
        (0.9, {"limits": (0.8, 1.0)}, COMPATIBLE),
        (0.9, {"limits": (0.85, 1.0)}, UNDECIDED),
        (0.9, {"limits": (0.96, 1.0)}, DIFFERENT),
    ],
)
def test_verdicts_on_figures(
    value: float, about: dict[str, Any], expected: str, tables: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert the verdict on 0.9 (90 of 100) by the paper's figure, its trials and the margin of 0.1, by hand."""
    figure = marks.PaperFigure(value, "share", "a table", marks.Conditions("", "", ()), **about)
    monkeypatch.setitem(PAPER.figures, ("test",), figure)
    of_trials = {"interval": ["low", "high"] if "limits" in about else {"share_of": "trials"}}
    assert verdict(entry("good", figure=["test"], **of_trials), tables) == expected
    assert verdict(entry("good", figure=["test"], interval=None), tables) == UNDECIDED


@pytest.mark.parametrize(
    ("claim", "expected"),
    [
        ({"is": "above", "row": "bad"}, COMPATIBLE),
        ({"is": "below", "row": "bad"}, DIFFERENT),
        ({"is": "above", "row": "near"}, UNDECIDED),  # not beyond the interval of the difference
        ({"is": "above", "row": "bad", "times": 1.7}, UNDECIDED),
        ({"is": "above", "select": {"name": "bad"}}, COMPATIBLE),
        ({"is": "below", "field": "still"}, UNDECIDED),  # which has no interval
        ({"is": "above", "than": 0.75}, COMPATIBLE),
        ({"is": "above", "than": 0.85}, UNDECIDED),
        ({"is": "above", "than": 0.96}, DIFFERENT),
    ],
)
def test_verdicts_on_comparisons(claim: dict[str, Any], expected: str, tables: Path) -> None:
    """Assert when a comparison that the paper draws shows in evetac's figures; of two the worse one counts."""
    others = entry("near"), entry("bad")
    assert verdict(entry("good", direction=[claim]), tables, *others) == expected
    worst = max(expected, UNDECIDED, key=verdicts.VERDICTS.index)
    assert verdict(entry("good", direction=[{"is": "above", "row": "near"}, claim]), tables, *others) == worst


@pytest.mark.parametrize(
    ("less", "expected"),
    [([0.04] * 5, COMPATIBLE), ([-0.04] * 5, DIFFERENT), ([0.2, 0.1, 0.0, -0.1, 0.0], UNDECIDED), ([0.04], UNDECIDED)],
)
def test_figures_of_the_same_objects_are_compared_in_pairs(less: list[float], expected: str, tables: Path) -> None:
    """Assert that a small difference that every object has shows; with another set of objects it would not."""
    content = json.loads((tables / "a.json").read_text())
    good, near = content["rows"][:2]
    good["by_unit"] = {str(k): {"share": 0.9 - 0.1 * k} for k in range(5)}
    near["by_unit"] = {str(k): {"share": 0.9 - 0.1 * k - off} for k, off in enumerate(less)}
    (tables / "a.json").write_text(json.dumps(content))
    assert verdict(entry("good", direction=[{"is": "above", "row": "near"}]), tables, entry("near")) == expected
    assert verdict(entry("near", direction=[{"is": "below", "row": "good"}]), tables, entry("good")) == expected


@pytest.mark.parametrize(("error_px", "expected"), [(1.9, COMPATIBLE), (2.0, UNDECIDED)])
def test_dots_that_never_move_reproduce_nothing(error_px: float, expected: str, tables: Path) -> None:
    """Assert that a tracker has to be nearer to the true dots than dots that stand still."""
    row = {"preset": "paper", paper_rows.ERROR: error_px, paper_rows.STILL: 2.0}
    (tables / f"{paper_rows.DISTANCE}.json").write_text(json.dumps({"rows": [row]}))
    claim = entry("good", direction=[{"is": "above", "than": 0.75}], tracks={"preset": "paper"})
    assert verdict(claim, tables) == expected


def test_what_is_informative() -> None:
    """Assert that a figure that constants saw, and a share of 0 or 1 in the paper or here, could not show anything."""
    for role, unit, paper, ours, expected in (
        ("prediction", "share", 0.9, 0.8, True),
        ("fit", "share", 0.9, 0.8, False),
        ("near", "share", 0.9, 0.8, False),
        ("prediction", "share", 1.0, 0.8, False),
        ("prediction", "share", 0.9, 0.0, False),
        ("prediction", "N", 0.4, 1.0, True),
    ):
        one = {"role": role, "computed": {"unit": unit, "paper": paper, "ours": ours}}
        assert paper_rows.is_informative(one) == expected


def test_what_is_missing_is_awaited(tables: Path) -> None:
    """Assert that a missing table, row, field or interval is named, and that several rows are an error."""
    missing = [
        entry("good", table="b"), entry("none"), entry("good", field="f1"), entry("good", interval=["low", "f1_high"])
    ]  # fmt: skip
    for number, one in enumerate(missing):
        one["number"] = str(number)
    assert paper_rows.awaiting([*missing, entry("bad")], tables) == [
        "0: b: no such table", '1: a: no row {"name": "none"}', "2: a: no field f1", "3: a: no field f1_high",
    ]  # fmt: skip
    assert [paper_rows.computed(one, {}, tables)["verdict"] for one in missing[:3]] == [paper_rows.NOT_YET] * 3
    with pytest.raises(ValueError, match="2 rows"):
        paper_rows.row_of(tables, "a", {"still": 0.5})


# What methods name ---------------------------------------------------------------------------------------------------


def test_the_recipe_has_the_papers_sizes() -> None:
    """Assert trajectories for training, for choosing and for evaluation, and the number of trainings."""
    sizes = steps.RECIPE
    known, unseen = (len(range(*map(int, sizes[name].split("-")))) + 1 for name in ("known", "unseen"))
    assert (known * sizes["train"], known * sizes["choose"]) == (315, 45)
    assert (known * sizes["test"], unseen * sizes["test"]) == (90, 80)
    assert sizes["headline_seeds"] == SEEDS and known * (sizes["train"] + sizes["choose"]) == TRAINED_ON


def test_the_recipe_has_the_papers_method() -> None:
    """Assert that tracker, labels and training are the paper's where nothing is changed."""
    every = [list(step) for step in steps.recipe_steps(steps.RECIPE)]
    chosen = {name: [step for step in every if step[1] == name] for name in ("label", "track", "train")}
    assert all(step[step.index("--method") + 1] == "farneback" for step in chosen["label"])
    assert all(step[step.index("--preset") + 1] == "paper" for step in (*chosen["track"], *chosen["train"]))
    assert all(chosen.values())


def test_the_papers_labels_have_figures() -> None:
    """Assert that the table of labels judges Farneback's too."""
    rows = json.loads((ROOT / "docs" / "results" / "labels.json").read_text())["rows"]
    assert "farneback" in {row["method"] for row in rows}


def test_grasps_have_the_papers_sizes() -> None:
    """Assert durations, trials, objects and detector of the table of grasps."""
    assert (Grasp().lift_s, Grasp().balance_s) == (LIFT_S, BALANCE_S)
    (experiment,) = (one for one in EXPERIMENTS if one.name == "grasp-table")
    assert (experiment.full["trials"], experiment.full["alone"], experiment.full["objects"]) == (10, 5, "10-18")
    assert "fast-slow-10ms" in " ".join(steps.GRASP_SETTINGS["paper"])
