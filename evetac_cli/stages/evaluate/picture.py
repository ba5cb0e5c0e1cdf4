"""Pictures beside reports: what they have in common, and how they are written.

A picture is drawn from the rows of its report, and again only where it is missing. Without matplotlib (the extra
`plot`) a report is made all the same and says how to get the picture.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from evetac_cli.jobs import Outcome
from evetac_cli.store.disk import taking_the_place_of

EARLY, CORRECT, LATE = "#e6a23c", "#3b7dd8", "#8c8c8c"  # the same three everywhere slip timing is shown
PAPER = {"marker": "D", "color": "black", "markersize": 5, "linestyle": "none"}
DPI = 120


def beside(outcome: Outcome, report: Path, draw: Callable[[Any], None], size_in: tuple[float, float]) -> Outcome:
    """Draw into an empty figure of (width, height) in inches and keep it as PNG beside the report; say where it is.

    InputError if it cannot be written.
    """
    path = report.with_suffix(".png")
    if not outcome.made and path.exists():
        return outcome
    try:
        from matplotlib.figure import Figure
    except ImportError:
        shown = "none: needs matplotlib, pip install '.[plot]'"
    else:
        figure = Figure(figsize=size_in, layout="constrained")
        draw(figure)
        save(figure, path)
        shown = str(path)
    return dataclasses.replace(outcome, summary={**outcome.summary, "plot": shown})


def save(figure: Any, path: Path) -> None:
    """Write a matplotlib figure as PNG, all or nothing; InputError if it cannot be written."""
    with taking_the_place_of(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI)


def quiet_grid(axes: Any) -> None:
    """A light grid behind what is drawn."""
    axes.grid(which="major", color="0.9")
    axes.set_axisbelow(True)
