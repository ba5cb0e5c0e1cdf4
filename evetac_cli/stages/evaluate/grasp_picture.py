"""The picture beside a report on grasps: rows of the paper's figure, objects side by side, a colour a setting."""

from typing import Any

from evetac_cli.resources import table
from evetac_cli.stages.evaluate import Rows, picture

SIZE_IN = (13.0, 10.0)
PAPER_ORDER = (18, 17, 10, 11, 12, 13, 15, 16, 14, 19, 20)
MOST_SETTINGS = 8  # colours that can be told apart
PANELS = (
    ("success", "share of trials lifted and balanced"),
    ("opening_after_balance_ticks", "change of opening at the end [ticks]"),
    ("force_end_n", "grip force at the end [N]"),
    ("moved_mm_median", "object moved, median [mm]"),
)


def draw(figure: Any, rows: Rows) -> None:
    """Draw the rows by object into an empty figure."""
    by_object = [row for row in rows if "moved_mm_median" in row and "object" in row]
    settings = list(dict.fromkeys(row["setting"] for row in by_object))
    shown = settings[:MOST_SETTINGS]
    numbers = sorted({row["object"] for row in by_object}, key=_place)
    figure.suptitle("grasps (simulated)" + ("" if shown == settings else f"; {MOST_SETTINGS} of {len(settings)}"))
    width = 0.8 / max(len(shown), 1)
    for axes, (name, title) in zip(figure.subplots(len(PANELS), 1, sharex=True), PANELS, strict=True):
        for place, setting in enumerate(shown):
            values = {row["object"]: row[name] for row in by_object if row["setting"] == setting}
            at = [index + (place + 0.5) * width - 0.4 for index, number in enumerate(numbers) if number in values]
            heights = [values[number] or 0.0 for number in numbers if number in values]
            axes.bar(at, heights, width=0.9 * width, color=f"C{place}", label=setting)
        for label, at_x, value in _paper(name, numbers):
            axes.plot(at_x, value, label=label, **picture.PAPER)
        axes.set_ylabel(title, fontsize=8)
        picture.quiet_grid(axes)
    axes.set_xticks(range(len(numbers)), [f"object {number}" for number in numbers], fontsize=8)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False)


def _paper(name: str, numbers: list[int]) -> list[tuple[str, list[float], list[float]]]:
    """The paper's points of a panel, if it says any: label, x, y."""
    grasp = table("paper")["grasp"]
    said = {**grasp["objects_higher_gain"], **grasp["objects"]}
    points = []
    for index, number in enumerate(numbers):
        row = said.get(str(number), {})
        if name == "success" and row:
            points.append((float(index), row["lifted"] * row["balanced"]))
        elif name in row:
            points.append((float(index), row[name]))
    if not points:
        return []
    at_x, values = (list(column) for column in zip(*points, strict=True))
    return [("printed in the paper", at_x, values)]


def _place(number: int) -> int:
    """Objects in the order of the paper's figure, the others behind them."""
    return PAPER_ORDER.index(number) if number in PAPER_ORDER else 100 + number
