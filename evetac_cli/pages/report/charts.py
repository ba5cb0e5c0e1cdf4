"""The charts of the report, drawn by Bokeh: onsets by object, detections as in the paper, shares, error against time.

The point of a trial has the number of the trial's row, so that a click on it shows that row.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.evaluate.paper import Beside
from evetac_cli.evaluate.picture import wilson
from evetac_cli.jobs import Rows
from evetac_cli.pages.report.study import Found, Study, StudyTrial, by_truth
from evetac_cli.pages.shared import (
    BLUE,
    GREEN,
    NEUTRAL,
    ORANGE,
    PINK,
    bare_figure,
)

EARLY, RIGHT, LATE = ORANGE, BLUE, "#8c8c8c"  # the same in all charts of timing
SHOWN_MS = 100  # farther onsets are drawn at the edge
CDF_MS = (-60, 40)  # as in the paper's figure of slip timing
MOST_BARS = 40
MOST_MODELS = 6  # with their own chart
OBJECT_COLOURS = (BLUE, ORANGE, GREEN, PINK, "#e6a23c", "#56b4e9", "#7a5195", "#8c8c8c")


class Chart(NamedTuple):
    """A chart with its title, the meaning of its colours (words -> colour), and a sentence."""

    title: str
    figure: Any
    keys: dict[str, str]
    says: str = ""


def onset_chart(
    study: Study, number: int, kind: str, window_ms: tuple[int, int], x_label: str, title: str
) -> Chart | None:
    """Return a point per trial's error (`label_error_ms` or `model_error_ms`), a line per object.

    None without errors.
    """
    errors = [(at, trial, getattr(trial, kind)) for at, trial in enumerate(study.trials)]
    points: list[tuple[int, tuple[str, float], float]] = []  # row, position on the axis of objects, error
    counts: Counter[str] = Counter()
    for at, name, ms in ((at, _object(trial), ms) for at, trial, ms in errors if ms is not None):
        points.append((at, (name, 0.2 * (counts[name] % 3 - 1)), ms))  # three sub-lines, so that fewer points overlap
        counts[name] += 1
    if not points:
        return None
    names = sorted(counts, key=lambda name: (len(name), name))
    chart = bare_figure(height=70 + 26 * len(names), y_range=names[::-1], x_axis_label=x_label, min_border_left=90)
    chart.ygrid.grid_line_color = None
    _window(chart, window_ms)
    low, high = window_ms
    for words, colour, least, most in (
        ("early", EARLY, -np.inf, low - 1e-9),
        ("right", RIGHT, low, high),
        ("late", LATE, high + 1e-9, np.inf),
    ):
        some = [one for one in points if least <= one[2] <= most]
        for marker, edge in (("circle", False), ("triangle", True)):
            shown = [one for one in some if (abs(one[2]) > SHOWN_MS) == edge]
            data = {
                "x": [float(np.clip(ms, -SHOWN_MS, SHOWN_MS)) for _, _, ms in shown],
                "y": [place for _, place, _ in shown],
                "row": [f"{number}-{at}" for at, _, _ in shown],
            }
            angle = np.pi / 2 if words == "early" else -np.pi / 2
            _points(
                chart, data, f"trials {kind} {words} {edge}", marker=marker, color=colour, angle=angle if edge else 0
            )
    beyond = sum(abs(ms) > SHOWN_MS for _, _, ms in points)
    remark = (
        f"{beyond} of {len(points)} are beyond {SHOWN_MS} ms or were never found: triangles at the edge."
        if beyond
        else ""
    )
    keys = {"early": EARLY, f"within {low:+d} to {high:+d} ms": RIGHT, "late or never": LATE}
    return Chart(title, chart, keys, remark)


def detection_charts(evaluation: Found, window_ms: tuple[int, int]) -> list[Chart]:
    """Return for each of the first models the share of trajectories detected by each time: all, and by object."""
    timed = [row for row in evaluation.rows if "t_c_ms" in row and "t_m_minus_t_c_ms" in row]
    rows = [row for row in timed if row["t_c_ms"] is not None]
    onset = "true onset" if by_truth(evaluation) else "labels' onset"
    charts = []
    for setting in list(dict.fromkeys(str(row["setting"]) for row in rows))[:MOST_MODELS]:
        members = [row for row in rows if str(row["setting"]) == setting]
        objects = sorted({str(row["object"]) for row in members}, key=lambda name: (len(name), name))
        chart = bare_figure(
            height=230,
            x_range=CDF_MS,
            y_range=(-0.09, 1.03),
            x_axis_label=f"first detection after the {onset} [ms]",
            y_axis_label="share detected",
        )
        _window(chart, window_ms)
        for at, name in enumerate(objects):
            some = [row for row in members if str(row["object"]) == name]
            if len(objects) > 1:
                _step(chart, some, line_color=OBJECT_COLOURS[at % len(OBJECT_COLOURS)], line_width=1, line_alpha=0.8)
        _step(chart, members, line_color=NEUTRAL, line_width=3)
        detected = [row["t_m_minus_t_c_ms"] for row in members if row["t_m_minus_t_c_ms"] is not None]
        chart.scatter(
            x=detected, y=[-0.05] * len(detected), marker="dash", angle=np.pi / 2, size=9, color=NEUTRAL, alpha=0.6
        )
        never = len(members) - len(detected)
        left_out = sum(str(row["setting"]) == setting for row in timed) - len(members)
        beside = f" of {len(members) + left_out}, without {left_out} that abstain or do not slip" if left_out else ""
        keys = {f"all {len(members)}{beside}": NEUTRAL}
        if 1 < len(objects) <= len(OBJECT_COLOURS):
            keys |= {f"object {name}": colour for name, colour in zip(objects, OBJECT_COLOURS, strict=False)}
        beyond = sum(not CDF_MS[0] <= ms <= CDF_MS[1] for ms in detected)
        remarks = [f"{never} are never detected."] * (never > 0) + [f"{beyond} are outside the drawn range."] * (
            beyond > 0
        )
        charts.append(Chart(setting, chart, keys, " ".join(remarks)))
    return charts


def share_chart(
    rows: Rows,
    name: str,
    parts: dict[str, tuple[str, str]],
    papers: Sequence[Beside | None],
    title: str,
    trials: Sequence[int],
) -> Chart | None:
    """Return stacked shares of each row (column -> words, colour), with the paper's first share as a diamond.

    trials: number of trials behind each row's shares. The first share has Wilson's 95 % interval for this number.
    """
    from bokeh.models.annotations.arrows import TeeHead
    from bokeh.models.annotations.geometry import Whisker
    from bokeh.models.sources import ColumnDataSource

    first = next(iter(parts))
    every = zip(rows, trials, papers, strict=True)
    bars = [(row, count, beside) for row, count, beside in every if row.get(first) is not None][:MOST_BARS]
    if not bars:
        return None
    rows = [row for row, *_ in bars]
    labels = _distinct([str(row[name]) for row in rows])
    longest = min(max(map(len, labels)), 48)
    chart = bare_figure(
        height=70 + 24 * len(labels),
        y_range=labels[::-1],
        x_range=(0, 1.02),
        x_axis_label="share of trials",
        min_border_left=20 + 6 * longest,
    )
    chart.ygrid.grid_line_color = None
    left = np.zeros(len(rows))
    for key, (_, colour) in parts.items():
        values = np.array([row.get(key) or 0.0 for row in rows])
        source = ColumnDataSource({"y": labels, "left": left, "right": left + values})
        chart.hbar(y="y", left="left", right="right", height=0.62, source=source, fill_color=colour, line_color=None)
        left = left + values
    ends = [
        (label, row[first], *wilson(row[first], count))
        for label, (row, count, _) in zip(labels, bars, strict=True)
        if count
    ]
    if ends:
        base, share, below, above = zip(*ends, strict=True)
        low = [at - down for at, (down,) in zip(share, below, strict=True)]
        high = [at + up for at, (up,) in zip(share, above, strict=True)]
        source = ColumnDataSource({"base": base, "low": low, "high": high})
        head = TeeHead(size=7, line_color=NEUTRAL)
        chart.add_layout(
            Whisker(
                base="base",
                lower="low",
                upper="high",
                source=source,
                dimension="width",
                level="overlay",
                line_color=NEUTRAL,
                name="interval",  # the page's script colours it to be visible on bars and page
                lower_head=head,
                upper_head=head,
            )
        )
    published = [(label, beside) for label, (*_, beside) in zip(labels, bars, strict=True) if beside is not None]
    keys = dict(parts.values())
    if published:
        chart.scatter(
            x=[beside.value for _, beside in published],
            y=[label for label, _ in published],
            marker="diamond",
            size=11,
            fill_color=PINK,
            line_color="#1f2730",
        )
        marks = ", ".join(dict.fromkeys(beside.mark for _, beside in published))
        keys[f"first share in the paper ({marks})"] = PINK
    remark = f"Whiskers: 95 % interval of '{parts[first][0]}', by the number of trials (Wilson)." if ends else ""
    return Chart(title, chart, keys, remark)


def cost_charts(evaluation: Found) -> list[Chart]:
    """Return charts of each error against run time, both logarithmic; points have the number of their setting's row."""
    from bokeh.models.annotations.labels import LabelSet
    from bokeh.models.sources import ColumnDataSource

    rows = list(enumerate((row for row in evaluation.rows if "setting" in row), start=1))
    time = next((key for _, row in rows for key in row if key.startswith("time_") and key.endswith("_median")), None)
    charts = []
    for error in dict.fromkeys(key for _, row in rows for key in row if key.startswith("error_")):
        points = [(at, row[time], row[error]) for at, row in rows if time and row.get(time) and row.get(error)]
        if len(points) < 2:
            continue
        unit = error.split("_")[1]
        chart = bare_figure(
            height=260,
            x_axis_type="log",
            y_axis_type="log",
            x_axis_label=f"run time, median [{(time or '').split('_')[1]}]",
            y_axis_label=f"{' '.join(error.split('_')[2:]) or 'error'} [{unit}]",
            min_border_top=16,
        )
        source = ColumnDataSource(
            {"x": [x for _, x, _ in points], "y": [y for _, _, y in points], "n": [str(at) for at, _, _ in points]}
        )
        chart.scatter("x", "y", source=source, size=8, fill_color=BLUE, line_color=None)
        chart.add_layout(
            LabelSet(
                x="x", y="y", text="n", source=source, x_offset=5, y_offset=3, text_color=NEUTRAL, text_font_size="11px"
            )
        )
        charts.append(
            Chart(
                f"Error in {unit} against run time",
                chart,
                {},
                "Numbers are rows of the table below; values of 0 are not drawn.",
            )
        )
    return charts


# --- parts ------------------------------------------------------------------------------------------------------------


def _object(trial: StudyTrial) -> str:
    return "unknown" if trial.row.object is None else f"object {trial.row.object}"


def _distinct(labels: Sequence[str]) -> list[str]:
    """Return unique labels for an axis."""
    seen: dict[str, int] = {}
    for label in labels:
        seen[label] = seen.get(label, 0) + 1
    numbers = dict.fromkeys(labels, 0)
    distinct = []
    for label in labels:
        numbers[label] += 1
        distinct.append(label if seen[label] == 1 else f"{label} ({numbers[label]})")
    return distinct


def _window(chart: Any, window_ms: tuple[int, int]) -> None:
    from bokeh.models.annotations.geometry import BoxAnnotation, Span

    low, high = window_ms
    chart.add_layout(BoxAnnotation(left=low, right=high, fill_color=RIGHT, fill_alpha=0.1, line_color=None))
    chart.add_layout(Span(location=0, dimension="height", line_color=NEUTRAL, line_width=1))


def _points(chart: Any, data: dict[str, Any], name: str, **style: Any) -> None:
    from bokeh.models.sources import ColumnDataSource
    from bokeh.models.tools import TapTool

    if not data["x"]:
        return
    if not chart.select_one(TapTool):
        chart.add_tools(TapTool())
    chart.scatter("x", "y", source=ColumnDataSource(data, name=name), size=8, fill_alpha=0.75, line_color=None, **style)


def _step(chart: Any, rows: Rows, **style: Any) -> None:
    """Draw the share of trajectories detected by each ms, relative to all, including never detected ones."""
    steps: NDArray[np.int64] = np.arange(CDF_MS[0], CDF_MS[1] + 1)
    late_by = np.array([row["t_m_minus_t_c_ms"] for row in rows if row["t_m_minus_t_c_ms"] is not None], float)
    share = (late_by[:, None] <= steps).sum(axis=0) / len(rows)
    chart.step(steps, share, mode="after", **style)
