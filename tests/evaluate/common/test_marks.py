"""The paper's figures: one place that tables and report ask, and the rule for marks."""

import ast
import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.evaluate import PAPER, SUBJECTS
from evetac_cli.evaluate.common import marks
from evetac_cli.evaluate.common.marks import (
    MARKS,
    METHOD,
    SAME,
    SCENE,
    SIZE,
    Conditions,
    Source,
)
from evetac_cli.evaluate.data_rate import COLUMNS
from evetac_cli.evaluate.tracking import SUBJECT as tracking_subject
from evetac_cli.pages.report import page
from evetac_cli.pages.report.study import Found
from evetac_cli.resources import PACKAGE
from evetac_cli.store.layout.ancestry import without_training_files
from scripts.reproduce import made_tables, table_text
from scripts.reproduce import tables as experiment_tables

ROW = {
    "preset": "paper", "trajectories": 10, "decided": 10, "consistent": 7, "consistent_share": 0.7,
    "dots_lost_mean": 2.0, "paper_consistent_share": 0.8, "paper_dots_lost_mean": 1.5,
}  # fmt: skip


def header(scene: str, *, simulated: bool = True) -> dict[str, Any]:
    """Of a report on tracks of ten recordings of a scene."""
    of = {"simulated": simulated, "method": 1, "seed": 0, "parents": []}
    recordings = {f"r{n}": {**of, "kind": "recording", "parameters": {"scene": {"name": scene}}} for n in range(10)}
    tracks = {
        f"t{n}": {**of, "kind": "tracks", "parents": [f"r{n}"], "parameters": {"preset": "paper"}} for n in range(10)
    }
    return {
        **of,
        "id": "x",
        "kind": "report",
        "parameters": {},
        "parents": list(tracks),
        "history": recordings | tracks,
    }


def in_table(evaluated: dict[str, Any]) -> str:
    """The paper's figure and mark in the table of the documentation."""
    evaluation = experiment_tables.Evaluation([ROW], {}, True, evaluated)
    result = made_tables.result(experiment_tables.TRACKING_EDGE, {"tracking-edge-cut": evaluation}, [])
    share, mark = table_text.published(result["columns"][1], result["rows"][0], result)
    return f"{float(share.rstrip('%')) / 100:g}, {mark}"


def in_report(evaluated: dict[str, Any]) -> str:
    """The same in the page of a folder."""
    report = Found("a.report.h5", "evaluate tracking", evaluated, [ROW], {})
    (beside,) = re.findall(r"\((.*)\)", page._with_paper("consistent_share", ROW, report))
    return beside


@pytest.mark.parametrize(("scene", "mark"), [("edge", "fitted"), ("slip", SCENE)])
def test_one_place_is_asked_by_all(scene: str, mark: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that table and report say the same, and that a figure changed in the table changes both."""
    asked = (in_table, in_report)
    evaluated = header(scene)
    assert {one(evaluated) for one in asked} == {f"0.8, {mark}"}
    figures, key = tracking_subject.paper.figures, ("consistent", "paper")
    monkeypatch.setitem(figures, key, dataclasses.replace(figures[key], value=0.66))
    assert {one(evaluated) for one in asked} == {f"0.66, {mark}"}


OURS = Conditions("network by paper", "slip", (90, 5), "dots by paper")
FIGURE = marks.PaperFigure(0.9, "share", "a table", OURS, fitted_in="slip")


@pytest.mark.parametrize(
    ("changes", "mark"),
    [
        ({}, SAME),
        ({"size": (80, 5)}, SIZE),
        ({"size": (80, 5), "scene": "lift"}, SCENE),
        ({"scene": ""}, SCENE),
        ({"size": (80, 5), "scene": "lift", "inputs": "dots by stable"}, METHOD),
        ({"method": "network by adamw"}, METHOD),
    ],
)
def test_marks_have_one_order(changes: dict[str, Any], mark: str) -> None:
    """Assert the mark of what is the paper's, of what differs in one thing, and which comes first where several do."""
    assert marks.mark(FIGURE, dataclasses.replace(OURS, **changes), simulated=False) == mark


def test_what_was_fitted_comes_first() -> None:
    """Assert that in the scene that was adjusted to a figure its mark is `fitted`, whatever else differs but method."""
    other = dataclasses.replace(OURS, size=(1, 1), inputs="dots by stable")
    assert marks.mark(FIGURE, other, simulated=True) == "fitted"
    assert marks.mark(FIGURE, dataclasses.replace(other, scene="lift"), simulated=True) == METHOD
    assert marks.mark(FIGURE, dataclasses.replace(OURS, method="other"), simulated=True) == METHOD
    assert marks.mark(dataclasses.replace(FIGURE, fitted_in=""), OURS, simulated=True) == SAME
    assert len(set(MARKS)) == 5


SLIP_ROW = {
    "model": "fast-slow", "horizon_ms": 0, "preset": "paper", "seeds": 5, "trajectories": 90, "folds": 0,
    "paper_slip_correct": 0.926, "paper_f1": 0.816,
}  # fmt: skip
SLIP = Source(scenes=("slip",), trackers=("paper",), labels=("farneback",), training_recordings=360)
GRASP_ROW = {"setting": "paper", "columns": 12, "trials": 120, "paper_success": 0.93, "paper_reopened_share": 0.43}
GRASPS = Source(True, ("lift",), ("paper",), (), ("fast-slow 10 ms ahead by paper",), (10.0, 20.0), 360)
ALONE = {"setting": "none", "columns": 11, "trials": 55, "paper_success": 0.0}
OBJECT_17 = {"setting": "paper", "object": 17, "trials": 10, "paper_opening_after_balance_ticks": -7.6}
SIDEWAYS = {
    "setting": "paper, sideways",
    "scene": "sideways",
    "sensor": "evetac",
    "columns": 1,
    "trials": 10,
    "paper_success": 1.0,
}
FORCE_ROW = {"sensor": "frames", "model": "network", "trajectories": 1, "paper_mae_n_x": 0.35}
FORCE = Source(True, ("shear",), ("stable",), training_recordings=4)
TONE = {"method": "paper", "expected_hz": 200.0, "window_s": 1.0, "windows": 100, "paper_share": 0.69}
INTERVAL = {"interval": "whole", "trajectories": 5, "columns": 540, "paper_share_mean": 0.017}


@pytest.mark.parametrize(
    ("column", "row", "source", "changes", "expected"),
    [
        ("paper_slip_correct", SLIP_ROW, SLIP, {}, (0.926, SAME)),
        ("paper_slip_correct", SLIP_ROW, SLIP, {"preset": "adamw"}, (0.926, METHOD)),
        ("paper_slip_correct", SLIP_ROW, SLIP, {"seeds": 1}, (0.926, SIZE)),
        ("paper_slip_correct", SLIP_ROW, SLIP, {"paper_f1": None, "trajectories": 80}, (0.84, SAME)),
        ("paper_10_to_0_ms_ahead", {**SLIP_ROW, "paper_10_to_0_ms_ahead": 0.57}, SLIP,
         {"paper_f1": None, "horizon_ms": 10, "trajectories": 80}, (0.57, SAME)),
        ("paper_dots_lost_mean", ROW, Source(True, ("edge",)), {}, (1.5, SAME)),
        ("paper_consistent_share", ROW, Source(), {}, (0.8, SCENE)),
        ("paper_success", GRASP_ROW, GRASPS, {}, (0.93, SAME)),
        ("paper_success", GRASP_ROW, GRASPS, {"setting": "paper, 20 ms late"}, None),
        ("paper_reopened_share", GRASP_ROW, GRASPS, {"trials": 110}, (0.43, SIZE)),
        ("paper_success", ALONE, GRASPS, {}, (0.0, "fitted")),
        ("paper_opening_after_balance_ticks", OBJECT_17, GRASPS, {}, (-7.6, "fitted")),
        ("paper_success", SIDEWAYS, GRASPS, {}, (1.0, SAME)),
        ("paper_success", SIDEWAYS, GRASPS, {"setting": "paper, second", "scene": "lift", "sensor": "second",
         "columns": 4}, (0.95, SIZE)),
        ("paper_success", SIDEWAYS, GRASPS, {"setting": "paper, closed gel", "scene": "lift", "gel": "closed",
         "columns": 4}, (0.95, SIZE)),
        ("paper_success", SIDEWAYS, GRASPS, {"setting": "paper, mine", "scene": "lift", "sensor": "mine", "columns": 4},
         (0.95, SIZE)),
        ("paper_success", SIDEWAYS, GRASPS, {"setting": "paper, mine", "scene": "mine", "sensor": "evetac"}, None),
        ("paper_success", SIDEWAYS, GRASPS, {"setting": "paper, sideways, mine", "scene": "sideways", "sensor": "mine"},
         None),
        ("paper_success", SIDEWAYS, GRASPS, {"slip_detector": "fast-slow by paper"}, (1.0, METHOD)),
        ("paper_mae_n_x", {**FORCE_ROW, "sensor": "events"}, FORCE, {"tracker": "paper"}, (0.33, SAME)),
        ("paper_mae_n_x", FORCE_ROW, FORCE, {"sensor": "events"}, (0.33, METHOD)),
        ("paper_share", TONE, Source(True, ("vibration",)), {}, (0.69, "fitted")),
        ("paper_share", TONE, Source(True, ("vibration-randomized",)), {}, (0.69, SCENE)),
        ("paper_share_mean", INTERVAL, Source(True, ("data-rate",)), {}, (0.017, SAME)),
        ("paper_share_mean", INTERVAL, Source(True, ("data-rate",)), {"columns": 640}, (0.017, METHOD)),
        ("paper_slip_correct", SLIP_ROW, SLIP, {"true_slip_share": True}, (0.926, METHOD)),
    ],
)  # fmt: skip
def test_each_row_has_its_figure_and_mark(
    column: str, row: dict[str, Any], source: Source, changes: dict[str, Any], expected: tuple[float, str] | None
) -> None:
    """Assert value and mark for a row of every evaluation, and nothing beside a row that is not comparable."""
    assert PAPER.beside(column, {**row, **changes}, source) == expected
    assert PAPER.beside(column, {**row, **changes, column: None}, source) is None


def test_a_row_that_does_not_tell_what_it_is_has_nothing_beside_it() -> None:
    """Assert that a row of an older evaluation, which lacks what the mark depends on, is left without."""
    for column, row in (("paper_slip_correct", SLIP_ROW), ("paper_success", GRASP_ROW), ("paper_share", TONE)):
        named = PAPER.columns[column]
        for name in named.needs:
            assert PAPER.beside(column, {key: one for key, one in row.items() if key != name}, Source()) is None


def test_the_source_is_what_headers_tell() -> None:
    """Assert scenes, trackers, labels, detector, durations and training recordings of a report on grasps."""
    of = {"simulated": True, "method": 1, "seed": 0}
    history = {
        "m": {**of, "kind": "model", "parents": [],
              "parameters": {"model": "fast-slow", "horizon_ms": 10, "preset": "paper"},
              "trajectories": [{"recording": "r", "scene": "slip", "labels": "event-flow", "tracker": "stable"}]},
        "g": {**of, "kind": "recording", "parents": ["m"],
              "parameters": {"scene": {"name": "lift"}, "tracker": {"preset": "paper"}, "lift_s": 7, "balance_s": 5}},
        "alone": {**of, "kind": "recording", "parents": [],
                  "parameters": {"scene": {"name": "lift"}, "lift_s": 10, "balance_s": 0}},
    }  # fmt: skip
    history = {id_: {**one, "id": id_, "history": {}} for id_, one in history.items()}
    report = {**of, "id": "x", "kind": "report", "parents": ["g", "alone"], "parameters": {}, "history": history}
    source = Source.of([without_training_files(report)])
    detectors = ("fast-slow 10 ms ahead by paper",)
    assert source == Source(True, ("lift", "slip"), ("paper", "stable"), ("event-flow",), detectors, (7.0, 5.0), 1)
    parts = [{**history[name], "id": name, "history": history} for name in ("g", "alone")]
    assert Source.of(map(without_training_files, parts)) == source
    assert Source.from_json({**dataclasses.asdict(source), "scenes": ["lift", "slip"], "networks": 4}) == source


# Nowhere else ---------------------------------------------------------------------------------------------------------

MODULES = [
    path
    for path in (*PACKAGE.rglob("*.py"), *(PACKAGE.parent / "scripts").rglob("*.py"))
    if path.parent.parent != PACKAGE / "evaluate" or path.name not in ("__init__.py", "marks.py")
]


def texts(path: Path) -> Iterator[str]:
    """The texts of a module but its docstrings; of f-strings the fixed parts."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.value


def written(figure: marks.PaperFigure) -> set[str]:
    """How a figure may be written in a text."""
    share = {f"{100 * figure.value:g}", f"{100 * figure.value:.0f}"} if figure.unit.startswith("share") else set()
    return {f"{figure.value:g}", f"{abs(figure.value):g}", *share}


def numbers_of_the_paper(text: str) -> set[str]:
    """The numbers that stand behind the word, as in "the paper's 80 %"."""
    return set(re.findall(r"\bpaper(?:'s|:| has| counts)? (-?\d+(?:\.\d+)?)", text))


def test_columns_name_figures_and_hold_none() -> None:
    """Assert that the columns of tables and report name what stands in `PAPER`, and nothing but names."""
    experiments = [one for one in vars(experiment_tables).values() if isinstance(one, experiment_tables.Table)]
    tables = experiments
    columns = [column for table in tables for column in (*table.columns, *([table.across] if table.across else []))]
    named = [key for column in columns for key in table_text.keys(column.paper)]
    shown = [name for subject in SUBJECTS for table in subject.tables for name in table.columns]
    named += [f"paper_{name}" for name in shown if f"paper_{name}" in PAPER.columns]
    assert len(named) > 20 and set(named) <= PAPER.columns.keys()
    assert not [column for column in columns if re.search(r"\d", re.sub(r"{[^}]*}", "", column.paper))]


def test_no_other_module_has_marks_or_figures_of_the_paper() -> None:
    """Assert that no other module spells a mark, gives a number to a column of the paper, or writes one in a text."""
    figures = {form for figure in PAPER.figures.values() for form in written(figure)} | {str(COLUMNS)}
    assert numbers_of_the_paper("the paper's 80 %, (paper: 540), the paper's -7.6 ticks") <= figures
    in_brackets = re.compile(rf"(?:\(|, )(?:{'|'.join(map(re.escape, MARKS))})\)")
    wrong = []
    for path in MODULES:
        for text in texts(path):
            is_mark = (text in MARKS and " " in text) or bool(in_brackets.search(text))
            wrong += [f"{path.name}: {text}"] if is_mark or numbers_of_the_paper(text) & figures else []
        text = path.read_text()
        for node in ast.walk(ast.parse(text)) if '"paper_' in text else ():
            pairs = zip(node.keys, node.values, strict=True) if isinstance(node, ast.Dict) else ()
            for key, value in pairs:
                of_paper = isinstance(key, ast.Constant) and str(key.value).startswith("paper_")
                is_number = isinstance(value, ast.Constant) and isinstance(value.value, int | float)
                wrong += [f"{path.name}: {ast.unparse(node)}"] if of_paper and is_number else []
    assert wrong == []
