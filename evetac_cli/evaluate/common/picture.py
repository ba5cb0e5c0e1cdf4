"""Plots next to reports: one style for all of them, and functions that write them.

A plot is drawn from the rows of its report, and redrawn only if it is missing. Without matplotlib (the extra `plot`)
the report is still written and its summary says how to install matplotlib.

Legends are outside the panels, so that they cover nothing.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import Any

from evetac_cli.console import safe
from evetac_cli.errors import install_hint
from evetac_cli.evaluate.common.marks import MARKS
from evetac_cli.jobs import Outcome
from evetac_cli.store.hdf5.disk import taking_the_place_of

# Okabe and Ito's palette, safe for most kinds of colour blindness, without yellow, which is too pale for a line.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7", "#666666")
MARKERS = "os^vP*Xh"  # 8 markers and 7 colours: 56 different series
CORRECT, EARLY, LATE = COLOURS[0], COLOURS[1], "#A6A6A6"  # the same in all plots of slip timing
PAPER_MARKERS = dict(zip(MARKS, ("8", "D", "p", "H", "d"), strict=True))  # none of them is a marker of a series
PAPER = {
    "markersize": 7,
    "markerfacecolor": "white",
    "markeredgecolor": "black",
    "linestyle": "none",
    "zorder": 5,
}
INTERVAL = {"fmt": "none", "ecolor": "black", "elinewidth": 1.2, "capsize": 3, "zorder": 4}
DPI = 120
STYLE: dict[Any, Any] = {  # Any, because matplotlib's type stubs require literal keys
    "figure.dpi": DPI,
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same plot on every computer
    "font.size": 9,
    "figure.titlesize": 12,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "axes.prop_cycle": f"cycler('color', {list(COLOURS)})",
    "axes.edgecolor": "0.4",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": "0.9",
    "lines.linewidth": 1.3,
    "svg.fonttype": "none",
    "svg.hashsalt": "evetac",  # the same file each time
}
INCH_A_LETTER, INCH_A_LINE = 0.078, 0.19  # estimated size of legend text


def beside(outcome: Outcome, report: Path, draw: Callable[[Any], None], size_in: tuple[float, float]) -> Outcome:
    """Draw into an empty figure of (width, height) in inches and save it as PNG next to the report.

    The returned outcome has the path in its summary. Raises InputError if the file cannot be written.
    """
    path = report.with_suffix(".png")
    if not outcome.made and path.exists():
        return outcome
    try:
        write(path, draw, size_in)
    except ImportError:
        shown = f"none: matplotlib is not installed; {install_hint('plot')}"
    else:
        shown = str(path)
    return dataclasses.replace(outcome, summary={**outcome.summary, "plot": shown})


def write(path: Path, draw: Callable[[Any], None], size_in: tuple[float, float]) -> None:
    """Draw into an empty figure of (width, height) in inches and write a PNG; raise ImportError without matplotlib."""
    with _drawn(draw, size_in) as figure, taking_the_place_of(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI)


def svg(draw: Callable[[Any], None], size_in: tuple[float, float]) -> str:
    """Draw into an empty figure of (width, height) in inches and return an SVG element; its links stay on the page."""
    text = StringIO()
    with _drawn(draw, size_in) as figure:
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :].replace(' target="_blank"', "")


@contextmanager
def _drawn(draw: Callable[[Any], None], size_in: tuple[float, float]) -> Iterator[Any]:
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # ignore any matplotlibrc, such as one in the working folder
        matplotlib.rcParams.update(STYLE)
        figure = Figure(figsize=size_in, layout="constrained")
        draw(figure)
        yield figure


def series(number: int) -> dict[str, Any]:
    """Return colour, marker and line style of a series; once the colours repeat, lines are dashed."""
    return {
        "color": COLOURS[number % len(COLOURS)],
        "marker": MARKERS[number % len(MARKERS)],
        "markersize": 5.5,
        "linestyle": "-" if number < len(COLOURS) else "--",
    }


def of_paper(mark: str, measured_on: str = "real sensor") -> dict[str, Any]:
    """Return label and style of a figure of the paper; its mark states how it compares with evetac's figure."""
    return {**PAPER, "marker": PAPER_MARKERS[mark], "label": f"the paper, {measured_on} ({mark})"}


def panels(figure: Any, count: int, most_columns: int, **shared: Any) -> list[Any]:
    """Return `count` axes in rows of equal length; unused positions in the last row stay empty."""
    rows = math.ceil(count / most_columns)
    axes = figure.subplots(rows, math.ceil(count / rows), squeeze=False, **shared).ravel()
    for empty in axes[count:]:
        empty.set_axis_off()
    return list(axes[:count])


def label_x(panels: Sequence[Any], words: str) -> None:
    """Write the same label below the last panel of each column.

    Reason: matplotlib's own label of a whole figure is hidden by a legend outside the panels.
    """
    lowest = {axes.get_subplotspec().colspan.start: axes for axes in panels}
    for axes in lowest.values():
        axes.set_xlabel(words)
        axes.tick_params(labelbottom=True)


def legend(figure: Any, axes: Iterable[Any], **more: Any) -> None:
    """Draw one legend for several panels below them, each label once."""
    entries: dict[str, Any] = {}
    for panel in axes:
        handles, labels = panel.get_legend_handles_labels()
        entries |= {label: one for label, one in zip(labels, handles, strict=True) if label not in entries}
    if entries:
        columns = _legend_columns(list(entries), figure.bbox.width / figure.dpi)
        words = [plain(label) for label in entries]
        figure.legend(entries.values(), words, loc="outside lower center", ncols=columns, **more)


def plain(text: str) -> str:
    """Escape a text or file name for matplotlib: no formula, printable characters only."""
    return safe(text).replace("$", r"\$")


def legend_height_in(labels: Sequence[str], width_in: float) -> float:
    """Return the height in inches of a legend below panels of this width."""
    return 0.15 + INCH_A_LINE * math.ceil(len(labels) / _legend_columns(labels, width_in))


def _legend_columns(labels: Sequence[str], width_in: float) -> int:
    longest_in = INCH_A_LETTER * (max(map(len, labels), default=0) + 8)  # with its marker and the gap
    return max(1, min(len(labels), int(width_in / longest_in)))


def share_axis(axis: Any) -> None:
    """Set an axis from 0 to 1, with room for a marker at either end."""
    axis.set_view_interval(-0.03, 1.03, ignore=True)
    axis.set_ticks([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])


def log_axis(axis: Any) -> None:
    """Make an axis logarithmic, with numbers written out: at decades, in shorter ranges also at 2 and 5."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    low, high = sorted(axis.get_view_interval())
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 300.0 * low else (1.0,)))
    axis.set_major_formatter(StrMethodFormatter("{x:,.10g}"))
    axis.set_minor_formatter(NullFormatter())


def say_instead(axes: Any, text: str) -> None:
    """Write text into a panel without data of evetac's own; hide its axis numbers if the panel is entirely empty."""
    axes.text(0.5, 0.75, text, transform=axes.transAxes, ha="center", va="center", color="0.4")
    if not any(len(line.get_xdata()) for line in axes.lines):
        axes.tick_params(labelbottom=False, labelleft=False)
