"""The picture beside a report on slip: bars of timing and F1, and when each setting first felt slip."""

import textwrap
from typing import Any

import numpy as np

from evetac_cli.jobs import Outcome
from evetac_cli.kernels.slip import metrics
from evetac_cli.stages.evaluate import Rows, picture

SHOWN_MS = (-60, 40)  # of the paper's figure of slip timing
PANELS = 4  # distributions side by side
TITLE_WIDTH = 38  # characters above one


def size_in(rows: Rows) -> tuple[float, float]:
    """Width and height in inches: room for every setting's bars and panel."""
    settings = len(_settings(rows))
    return 13.0, 1.5 + 0.42 * settings + 3.1 * -(-settings // PANELS)


def draw(figure: Any, outcome: Outcome) -> None:
    """Bars of timing and F1 with the paper's figures, and below, for each setting, the CDF of t_m - t_c."""
    settings = _settings(outcome.rows)
    rows = -(-len(settings) // PANELS)
    above, below = figure.subfigures(2, 1, height_ratios=[1.2 + 0.42 * len(settings), 3.1 * rows])
    timing, f1 = above.subplots(1, 2, sharey=True, width_ratios=[3, 2])
    above.suptitle("Slip timing and F1, mean and sd over objects and seeds" + _simulated(outcome), fontsize=12)
    at = np.arange(len(settings), dtype=float)
    looks = (
        ("slip_early", "too early", picture.EARLY),
        ("slip_correct", "correct", picture.CORRECT),
        ("slip_late", "too late", picture.LATE),
    )
    for place, (key, label, colour) in enumerate(looks):
        lengths = [row[key] or 0.0 for row in settings]
        errors = [row["slip_correct_sd"] or 0.0 for row in settings] if key == "slip_correct" else None
        timing.barh(at + 0.27 * (place - 1), lengths, 0.25, xerr=errors, color=colour, label=label)
    errors = [row["f1_sd"] or 0.0 for row in settings]
    f1.barh(at, [row["f1"] or 0.0 for row in settings], 0.5, xerr=errors, color=picture.CORRECT)
    for axes, key, title in ((timing, "slip_correct", "share of trajectories"), (f1, "f1", "F1")):
        told = [(row[f"paper_{key}"], y) for row, y in zip(settings, at, strict=True)]
        told = [pair for pair in told if pair[0] is not None]
        axes.plot([x for x, _ in told], [y for _, y in told], label="the paper", **picture.PAPER)
        axes.set(xlim=(0, 1.05), xlabel=title)
        picture.quiet_grid(axes)
    timing.set_yticks(at, [row["setting"] for row in settings])
    timing.invert_yaxis()
    timing.legend(loc="upper left", bbox_to_anchor=(0, -0.12), ncols=4, fontsize=8, frameon=False)
    panels = below.subplots(rows, PANELS, sharey=True, squeeze=False).ravel()
    below.suptitle("First detection against the labels' onset: share detected by then", fontsize=12)
    trajectories = [row for row in outcome.rows if "t_c_ms" in row]
    for axes, row in zip(panels, settings, strict=False):
        _draw_cdf(axes, [one for one in trajectories if one["setting"] == row["setting"]], row["setting"])
    for axes in panels[len(settings) :]:
        axes.set_axis_off()
    handles, labels = panels[0].get_legend_handles_labels()
    below.legend(handles, labels, loc="outside lower center", ncols=10, fontsize=8, frameon=False)


def _draw_cdf(axes: Any, trajectories: Rows, title: str) -> None:
    """A thin line for every object, a thick one for all, a mark for every detection.

    Why so: the plain share of trajectories, where the paper smooths with a Gaussian kernel. A detection that is far
    too early, which all models know, would make its width as large as what is to be seen.
    """
    slips = [row for row in trajectories if row["t_c_ms"] is not None]
    steps = np.arange(SHOWN_MS[0], SHOWN_MS[1] + 1)
    groups = {row["object"]: [one for one in slips if one["object"] == row["object"]] for row in slips}
    for number, (name, rows) in enumerate([*groups.items(), ("all", slips)]):
        late_by = np.array([row["t_m_minus_t_c_ms"] for row in rows if row["t_m_minus_t_c_ms"] is not None])
        share = (late_by[:, None] <= steps).sum(axis=0) / max(len(rows), 1)
        if name == "all":
            axes.step(steps, share, where="post", color="black", linewidth=2, label=name)
            axes.plot(late_by, np.full(len(late_by), -0.04), "|", color="black", markersize=5, alpha=0.4)
        else:
            axes.step(steps, share, where="post", color=f"C{number % 10}", linewidth=0.8, label=f"object {name}")
    axes.axvspan(metrics.EARLIEST_MS, metrics.LATEST_MS, color=picture.CORRECT, alpha=0.08)
    axes.axvline(0, color="0.5", linewidth=0.8)
    axes.set(xlim=SHOWN_MS, ylim=(-0.08, 1.02), xlabel="t_m - t_c [ms]")
    axes.set_title(textwrap.fill(title, TITLE_WIDTH, break_on_hyphens=False), fontsize=8)


def _settings(rows: Rows) -> Rows:
    return [row for row in rows if "seeds" in row]


def _simulated(outcome: Outcome) -> str:
    return " (simulated)" if outcome.simulated else ""
