"""Plot of error against run time: a row of panels per kind of workload, a panel per error."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from evetac_cli.evaluate import picture
from evetac_cli.jobs import Rows

STILL = "standing still"
REAL_TIME_US = 1000.0  # run time per simulated millisecond at real-time speed
UNITS = ("um", "us", "px", "ms", "share")
UM_PER_PX = 32.9  # of the sensor `evetac`


def size_in(rows: Rows) -> tuple[float, float]:
    """Return width and height in inches; the height grows with the number of different values in the column `part`."""
    return 14.0, 4.2 * len({row.get("part") for row in rows})


def draw(figure: Any, rows: Rows, errors: Sequence[str]) -> None:
    """Plot log error over log run time, a line per integrator or mode.

    A setting is `line, knob`; a setting without a knob (`layer order 1`) belongs to no line and is not drawn.
    `reference` and `standing still` are horizontal lines across the panel.
    """
    parts = list(dict.fromkeys(row["part"] for row in rows))
    for subfigure, part in zip(figure.subfigures(len(parts), 1, squeeze=False)[:, 0], parts, strict=True):
        part_rows = [row for row in rows if row["part"] == part]
        names = [name for name in errors if name in part_rows[0]]
        if len(parts) > 1:
            subfigure.suptitle(part)
        panels = picture.panels(subfigure, len(names), len(names))
        for axes, name in zip(panels, names, strict=True):
            draw_panel(axes, part_rows, name)
        picture.label_x(panels, "run time per millisecond\n(one slice), median [us]")
        picture.legend(subfigure, panels)


def draw_panel(axes: Any, rows: Rows, error: str) -> None:
    """Draw one kind of error; an error of 0 has no position on a logarithmic axis and is left out."""
    lines: dict[str, Rows] = {}
    for row in rows:
        line, comma, _ = row["setting"].rpartition(", ")
        if row["setting"].startswith("reference"):
            axes.axhline(
                row[error], color="0.5", linewidth=1, linestyle=":", label="bound of the reference's own error"
            )
        elif row["setting"] == STILL:
            axes.axhline(row[error], color="0.3", linewidth=1.2, linestyle="-.", label=STILL)
        elif comma:
            lines.setdefault(line, []).append(row)
    for number, (line, members) in enumerate(lines.items()):
        points = [row for row in members if row[error] and np.isfinite(row[error])]
        unstable = [row for row in members if str(row.get("outcome")).startswith("blew up")]
        if points:
            times, errors = np.array([(row["time_us_median"], row[error]) for row in points]).T
            knobs = [row["setting"].rpartition(", ")[2] for row in members]
            label = f"{line}, {_knob_range(knobs[len(unstable)], knobs[-1])}"
            label += f"; unstable from {knobs[len(unstable) - 1]}" if unstable else ""
            axes.plot(times, errors, label=label, **picture.series(number))
    axes.axvline(REAL_TIME_US, color="0.3", linewidth=1, linestyle="--", label="real time")
    first, *rest = error.removeprefix("error_").split("_")
    title, unit = (" ".join(rest), f" [{first}]") if first in UNITS else (" ".join((first, *rest)), "")
    axes.set(title=title, ylabel=f"error{unit}" + (f", 1 px is {UM_PER_PX:g} um" if first == "um" else ""))
    if any(len(line.get_xdata()) and line.get_marker() != "None" for line in axes.lines):
        for axis in (axes.xaxis, axes.yaxis):
            picture.log_axis(axis)
    else:
        picture.say_instead(axes, "errors are 0 or unknown")


def _knob_range(first: str, last: str) -> str:
    """Shorten two knob values to a range: `dt 10 ms`, `dt 0.1 ms` become `dt 10 to 0.1 ms`, without repeated words."""
    if first == last:
        return first
    begin, end = first.split(" "), last.split(" ")
    same = [one == other for one, other in zip(begin, end, strict=False)]
    kept = end[same.index(False) :] if False in same else end
    while begin[-1:] == end[-1:] and len(begin) > 1 and len(end) > 1:
        begin.pop()
        end.pop()
    return f"{' '.join(begin)} to {' '.join(kept)}"
