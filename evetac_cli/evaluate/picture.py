"""Pictures beside reports: one style for all of them, and how they are written.

A picture is drawn from the rows of its report, and again only where it is missing. Without matplotlib (the extra
`plot`) a report is made all the same and says how to get the picture.

Legends stand outside the panels, so that they cover nothing.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from evetac_cli.console import safe
from evetac_cli.errors import install_hint
from evetac_cli.evaluate.paper import MARKS
from evetac_cli.jobs import Outcome
from evetac_cli.store.hdf5.disk import taking_the_place_of

# Okabe and Ito's colours, which most kinds of colour blindness tell apart, but for yellow, too pale for a line.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7", "#666666")
MARKERS = "os^vP*Xh"  # another number than of colours: 56 series differ
CORRECT, EARLY, LATE = COLOURS[0], COLOURS[1], "#A6A6A6"  # the same three wherever slip timing is shown
PAPER_MARKERS = dict(zip(MARKS, ("8", "D", "p", "H", "d"), strict=True))  # none of them is a series'
PAPER = {
    "markersize": 7,
    "markerfacecolor": "white",
    "markeredgecolor": "black",
    "linestyle": "none",
    "zorder": 5,
}
INTERVAL = {"fmt": "none", "ecolor": "black", "elinewidth": 1.2, "capsize": 3, "zorder": 4}
DPI = 120
STYLE: dict[Any, Any] = {  # matplotlib names the keys that it knows
    "figure.dpi": DPI,
    "font.family": "DejaVu Sans",  # matplotlib brings it: the same picture on every computer
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
}
INCH_A_LETTER, INCH_A_LINE = 0.078, 0.19  # of a legend
MOST_TICKS = 9  # of a logarithmic axis


def beside(outcome: Outcome, report: Path, draw: Callable[[Any], None], size_in: tuple[float, float]) -> Outcome:
    """Draw into an empty figure of (width, height) in inches and keep it as PNG beside the report; say where it is.

    InputError if it cannot be written.
    """
    path = report.with_suffix(".png")
    if not outcome.made and path.exists():
        return outcome
    try:
        write(path, draw, size_in)
    except ImportError:
        shown = f"none, for want of matplotlib; {install_hint('plot')}"
    else:
        shown = str(path)
    return dataclasses.replace(outcome, summary={**outcome.summary, "plot": shown})


def write(path: Path, draw: Callable[[Any], None], size_in: tuple[float, float]) -> None:
    """Draw into an empty figure of (width, height) in inches and write it as PNG; ImportError without matplotlib."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # not what a matplotlibrc says: one may lie in the working folder
        matplotlib.rcParams.update(STYLE)
        figure = Figure(figsize=size_in, layout="constrained")
        draw(figure)
        with taking_the_place_of(path) as temporary:
            figure.savefig(temporary, format="png", dpi=DPI)


def series(number: int) -> dict[str, Any]:
    """Colour, marker and line of a series; where colours come again, the line is dashed."""
    return {
        "color": COLOURS[number % len(COLOURS)],
        "marker": MARKERS[number % len(MARKERS)],
        "markersize": 5.5,
        "linestyle": "-" if number < len(COLOURS) else "--",
    }


def of_paper(mark: str, measured_on: str = "real sensor") -> dict[str, Any]:
    """Label and style of a figure of the paper that compares with ours as its mark says."""
    return {**PAPER, "marker": PAPER_MARKERS[mark], "label": f"the paper, {measured_on} ({mark})"}


def panels(figure: Any, count: int, most_columns: int, **shared: Any) -> list[Any]:
    """So many axes in rows of equal length, what is left of the last row empty."""
    rows = math.ceil(count / most_columns)
    axes = figure.subplots(rows, math.ceil(count / rows), squeeze=False, **shared).ravel()
    for empty in axes[count:]:
        empty.set_axis_off()
    return list(axes[:count])


def label_x(panels: Sequence[Any], words: str) -> None:
    """The same words below the last panel of each column.

    Why so: matplotlib's own label of a whole figure lies under a legend that stands outside.
    """
    lowest = {axes.get_subplotspec().colspan.start: axes for axes in panels}
    for axes in lowest.values():
        axes.set_xlabel(words)
        axes.tick_params(labelbottom=True)


def legend(figure: Any, axes: Iterable[Any], **more: Any) -> None:
    """One legend for several panels, below them: each label once."""
    entries: dict[str, Any] = {}
    for panel in axes:
        handles, labels = panel.get_legend_handles_labels()
        entries |= {label: one for label, one in zip(labels, handles, strict=True) if label not in entries}
    if entries:
        columns = _legend_columns(list(entries), figure.bbox.width / figure.dpi)
        words = [plain(label) for label in entries]
        figure.legend(entries.values(), words, loc="outside lower center", ncols=columns, **more)


def plain(text: str) -> str:
    """A text from a file, or the name of one, as matplotlib draws it: no formula, and only signs that can be seen."""
    return safe(text).replace("$", r"\$")


def legend_height_in(labels: Sequence[str], width_in: float) -> float:
    """How many inches a legend takes below panels of this width."""
    return 0.15 + INCH_A_LINE * math.ceil(len(labels) / _legend_columns(labels, width_in))


def _legend_columns(labels: Sequence[str], width_in: float) -> int:
    longest_in = INCH_A_LETTER * (max(map(len, labels), default=0) + 8)  # with its mark and the gap beside it
    return max(1, min(len(labels), int(width_in / longest_in)))


def wilson(share: float, count: int) -> list[list[float]]:
    """How far Wilson's 95 % interval of a share of `count` trials reaches below and above it, as matplotlib wants it.

    It stays within 0 and 1, also where all or none of the trials succeed.
    """
    from evetac_cli.kernels import estimates

    _, low, high = estimates.share(round(share * count), count)
    return [[max(share - low, 0.0)], [max(high - share, 0.0)]]


def share_axis(axis: Any) -> None:
    """From 0 to 1, with room for a mark at either end."""
    axis.set_view_interval(-0.03, 1.03, ignore=True)
    axis.set_ticks([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])


def log_axis(axis: Any) -> None:
    """Make an axis logarithmic, with numbers that are written out.

    Ticks stand at whole decades, where the axis spans no more than two and a half also at 2 and 5. An axis on which
    fewer than three of them fall is made longer, to the next tick at both ends.
    """
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator

    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    low, high = sorted(axis.get_view_interval())
    finer = (1, 2, 5) if math.log10(high / low) < 2.5 else (1,)
    decades = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 1)
    ticks = [digit * 10.0**decade for decade in decades for digit in finer]
    shown = [tick for tick in ticks if low <= tick <= high]
    if len(shown) < 3:
        first = max(index for index, tick in enumerate(ticks) if tick <= low)
        last = min(index for index, tick in enumerate(ticks) if tick >= high)
        shown = ticks[first : last + 1]
        low, high = shown[0], shown[-1]
    axis.set_major_locator(FixedLocator(shown[:: 1 + (len(shown) - 1) // MOST_TICKS]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: written_out(value)))
    axis.set_minor_formatter(NullFormatter())
    axis.set_view_interval(low, high, ignore=True)


def written_out(value: float) -> str:
    """A tick of a logarithmic axis: 0.001 to 100,000 in figures, others as a power of ten."""
    if 0.99e-3 < value < 1.01e5:
        return f"{value:,.10g}"
    exponent = math.floor(math.log10(value) + 1e-9)
    digit = round(value / 10.0**exponent)
    return f"$10^{{{exponent}}}$" if digit == 1 else f"${digit}\\cdot10^{{{exponent}}}$"


def say_instead(axes: Any, text: str) -> None:
    """Words in a panel that has nothing of ours to show; without numbers at its axes where it shows nothing at all."""
    axes.text(0.5, 0.75, text, transform=axes.transAxes, ha="center", va="center", color="0.4")
    if not any(len(line.get_xdata()) for line in axes.lines):
        axes.tick_params(labelbottom=False, labelleft=False)
