"""Pictures beside reports: intervals, axes and legends, and that they can be read with one trial and with a hundred."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.common.marks import Source
from evetac_cli.evaluate.grasp import measure as grasp
from evetac_cli.evaluate.slip import measure as slip
from evetac_cli.evaluate.slip import warnings as slip_warnings
from evetac_cli.jobs import Outcome

matplotlib = pytest.importorskip("matplotlib")
Figure = pytest.importorskip("matplotlib.figure").Figure
Legend = pytest.importorskip("matplotlib.legend").Legend


SOURCE = Source(simulated=True, scenes=("edge",))


def drawn(draw: Callable[[Any], None], size_in: tuple[float, float]) -> Any:
    """A figure as `beside` makes it, laid out."""
    with matplotlib.rc_context(picture.STYLE):
        figure = Figure(figsize=size_in, layout="constrained", dpi=50)
        draw(figure)
        figure.draw_without_rendering()
    return figure


def faults(figure: Any) -> list[str]:
    """What cannot be read: legends over panels or over each other, or over words, words beyond the edge."""
    legends = [one for one in figure.findobj(Legend) if one.get_visible()]
    boxes = [one.get_window_extent() for one in legends]
    panels = [axes for axes in figure.axes if axes.axison]
    wrong = [
        f"a legend over {axes.get_xlabel() or axes.get_title()}"
        for axes in panels
        for box in boxes
        if box.overlaps(axes.get_tightbbox())
    ]
    wrong += ["two legends overlap" for n, box in enumerate(boxes) if any(box.overlaps(other) for other in boxes[:n])]
    own = [text for part in (figure, *figure.subfigs) for text in part.texts]
    texts = own + [text for axes in panels for text in (axes.xaxis.label, axes.yaxis.label, axes.title)]
    for text in texts:
        box = text.get_window_extent()
        inside = box.x0 >= -1 and box.y0 >= -1 and box.x1 <= figure.bbox.x1 + 1 and box.y1 <= figure.bbox.y1 + 1
        wrong += [f"beyond the edge: {text.get_text()}"] if text.get_text() and not inside else []
        wrong += [f"under a legend: {text.get_text()}" for legend in boxes if text.get_text() and box.overlaps(legend)]
    return wrong


def slip_outcome(settings: int, objects: int, *, published: bool) -> Outcome:
    """Rows as evaluate slip has them: some slips detected in time, early and never."""
    late_by = [-300, -12, 3, None]
    rows: list[dict[str, Any]] = []
    for number in range(settings):
        name = f"fast-slow, {number} ms ahead, adamw, up to 10000 steps"
        shares = {"slip_early": 0.25, "slip_correct": 0.5, "slip_late": 0.25}
        what = {"model": "fast-slow", "horizon_ms": 0, "preset": "adamw", "trajectories": 4 * objects, "seeds": 1}
        what |= {"judged_by": "labels", "counted": 3 * objects, "abstained": objects}
        papers = dict.fromkeys(("paper_slip_correct", "paper_f1"), 0.9 if published else None)
        warned = {column: 0.9 - ahead_ms / 50 for ahead_ms, column in slip_warnings.WARNED.items()}
        intervals = {
            "slip_correct_low": 0.3,
            "slip_correct_high": 0.7,
            "warned_10_ms_low": 0.5,
            "warned_10_ms_high": 1.0,
        }
        price = {"false_alarms_per_min": 0.8 if number else None}
        rows.append({"setting": name, **what, **shares, "f1": 0.98, **papers, **warned, **intervals, **price})
    for number in range(settings):
        name = rows[number]["setting"]
        rows += [
            {"setting": name, "predicted_from": n / 10, "predicted": n / 10, "observed": n / 12} for n in range(1, 10)
        ]
        rows += [{"setting": name, "object": str(n), "trajectories": 4, "f1": 1.0 - n / 50} for n in range(objects)]
        rows += [
            {
                "setting": name,
                "file": "a",
                "object": str(n % objects),
                "t_c_ms": 500,
                "t_m_minus_t_c_ms": late_by[n % 4],
            }
            for n in range(4 * objects)
        ]
    return Outcome(rows, True)


@pytest.mark.parametrize(
    ("settings", "objects", "published"),
    [(1, 1, False), pytest.param(9, 17, True, marks=pytest.mark.slow)],
)
def test_the_picture_of_slip(settings: int, objects: int, *, published: bool) -> None:
    """Assert that nothing is covered, shares end at 1, and the paper is named only where it is drawn."""
    outcome = slip_outcome(settings, objects, published=published)
    figure = drawn(lambda figure: slip._draw(figure, outcome, SOURCE), slip._size_in(outcome.rows))
    assert faults(figure) == []
    ends = [bar.get_x() + bar.get_width() for bar in figure.axes[0].patches]
    assert max(ends) == pytest.approx(1.0)
    named = [text.get_text() for legend in figure.findobj(Legend) for text in legend.get_texts()]
    assert any(name.startswith("the paper") for name in named) == published
    onsets = [axes for axes in figure.axes[2:-2] if axes.axison]
    assert len(onsets) == settings
    steps = onsets[0].lines[-3 if objects == 1 else objects].get_ydata()
    assert steps[-1] == 0.75  # one of four was never detected
    warned = figure.axes[-2].lines[0]
    assert warned.get_xdata().tolist() == [0, 5, 10, 20, 40]
    assert warned.get_ydata()[2] == pytest.approx(0.7)


@pytest.mark.parametrize("laws", [1, 8])
def test_the_picture_of_grasps(laws: int) -> None:
    """Assert that nothing is covered, whether one grasp or many are drawn."""
    trials = [{"carried_g": 50.0 * n, "holding_end_n": 0.5 * n, "force_end_n": 0.9 * n} for n in range(1, laws + 1)]
    settings = [(number, f"fixed:{number}", trials) for number in range(laws)]
    assert faults(drawn(lambda figure: grasp.draw_forces(figure, settings), (7.5, 5.0))) == []


SETTINGS = {"text.usetex": True, "savefig.facecolor": "red", "axes.facecolor": "red", "savefig.bbox": "tight"}


def test_a_picture_is_the_same_whatever_the_settings_of_matplotlib(tmp_path: Path) -> None:
    """Assert that what a matplotlibrc says changes nothing: the one that lies in the working folder holds first.

    It may come with somebody else's data, and would run LaTeX.
    """
    pictures = []
    for settings in ({}, SETTINGS):
        report = tmp_path / f"{len(settings)}.report.h5"
        with matplotlib.rc_context(settings):
            picture.beside(Outcome([], True), report, lambda figure: figure.subplots().plot([0, 1]), (3, 2))
        pictures.append(report.with_suffix(".png").read_bytes())
    assert pictures[0] == pictures[1]
