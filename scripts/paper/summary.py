"""The rows of README's table: for each claim of the paper a cell of a table in docs/results, with n and mark."""

from typing import NamedTuple

from evetac_cli.evaluate.data_rate import COLUMNS
from evetac_cli.jobs import Row


class Figure(NamedTuple):
    """A row of the summary: one cell, identified by its table, values of its row and the heading of its column.

    what, n: format strings over the row of the table.
    """

    what: str
    table: str
    row: Row
    heading: str
    n: str


RETURNED, KEPT, TIMELY = "all dots end where they began (paper)", "lifted and kept (paper)", "timing correct (paper)"
SLIPS, GRASPS = "{trajectories} slips; trained networks: {seeds}", "{trials} grasps"
PAPER_GRASPS = {"setting": "paper", "detector": "`fast-slow` 10 ms, the paper's tracker and threshold"}


SUMMARY = (
    Figure(
        "all dots return after a finger rubbed: the paper's tracker without its grid", "tracking-edge",
        {"preset": "unregularised"}, RETURNED, "{trajectories} trials",
    ),
    Figure("... with its grid", "tracking-edge", {"preset": "paper"}, RETURNED, "{trajectories} trials"),
    Figure("... evetac's tracker", "tracking-edge", {"preset": "stable"}, RETURNED, "{trajectories} trials"),
    Figure(
        "tone identified within 1 s, five tones: the paper's method", "vibration",
        {"method": "paper", "tone": "all", "window_s": 1.0}, "{window_s:g} s", "{windows} windows",
    ),
    Figure(
        f"bytes per second over an RGB sensor's, {{columns}} columns (paper: {COLUMNS})", "data-rate",
        {"object": 1, "interval": "whole"}, "share (paper)", "{trajectories} trials",
    ),
    Figure(
        "mean absolute error of shear force Fx, Fy in N: the paper's tracker and network", "force",
        {"tracker": "paper", "model": "network", "sensor_name": "evetac"}, "{sensor_name}", "{trajectories} trials",
    ),
    Figure(
        "... evetac's tracker, the paper's network", "force",
        {"tracker": "stable", "model": "network", "sensor_name": "evetac"}, "{sensor_name}", "{trajectories} trials",
    ),
    Figure(
        "slip detected in time, known objects: `fast-slow`, trained by the paper's recipe", "paper-recipe",
        {"model": "fast-slow", "horizon_ms": 0, "objects_words": "trained on"}, TIMELY, SLIPS,
    ),
    Figure(
        "... 10 ms ahead, unseen objects", "paper-recipe",
        {"model": "fast-slow", "horizon_ms": 10, "objects_words": "unseen"}, TIMELY, SLIPS,
    ),
    Figure(
        "... of these, first detection in the last 10 ms before slip", "paper-recipe",
        {"model": "fast-slow", "horizon_ms": 10, "objects_words": "unseen"}, "first in -10..0 ms (paper)", SLIPS,
    ),
    Figure("object lifted and kept: the paper's controller and detector", "grasps", PAPER_GRASPS, KEPT, GRASPS),
    Figure(
        "... evetac's controller and detector", "grasps",
        {"setting": "load-proportional", "detector": "pretrained"}, KEPT, GRASPS,
    ),
    Figure(
        "... the paper's controller and detector, when 100 g fall on the object", "grasp-robustness",
        {"setting": "paper, drop-100g", "detector": PAPER_GRASPS["detector"]}, KEPT, GRASPS,
    ),
)  # fmt: skip
