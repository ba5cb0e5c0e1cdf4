"""The charts of onset errors, drawn like the plots of `evaluate`; a point is a link to the row of its trial."""

from collections import Counter
from typing import Any

import numpy as np

from evetac_cli.evaluate import picture
from evetac_cli.evaluate.picture import CORRECT, EARLY, LATE
from evetac_cli.pages.report.study import Study, StudyTrial

SHOWN_MS = 100  # farther onsets are drawn at the edge
WIDTH_IN = 7.0


def row_id(study: int, trial: int) -> str:
    """Return the HTML id of a trial's row, by the numbers of study and trial."""
    return f"trial-{study}-{trial}"


def onset_chart(study: Study, number: int, kind: str, window_ms: tuple[int, int], x_label: str) -> str:
    """Return an SVG with a point per trial's error (`label_error_ms` or `model_error_ms`), a line per object.

    number: of the study on the page. Empty without errors.
    """
    errors = [(row_id(number, at), _object(trial), getattr(trial, kind)) for at, trial in enumerate(study.trials)]
    points = [point for point in errors if point[2] is not None]
    names = sorted({name for _, name, _ in points}, key=lambda name: (len(name), name))
    if not points:
        return ""

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        axes.axvspan(*window_ms, color=CORRECT, alpha=0.1, linewidth=0)
        axes.axvline(0, color="0.4", linewidth=1)
        low, high = window_ms
        counts: Counter[str] = Counter()
        groups: dict[tuple[str, str, str], list[tuple[float, float, str]]] = {}
        for row, name, ms in sorted(points, key=lambda point: point[2]):
            line = names.index(name) + 0.2 * (counts[name] % 3 - 1)  # three sub-lines, so that fewer points overlap
            counts[name] += 1
            looks = (EARLY, "early", "<") if ms < low else (LATE, "late or never", ">") if ms > high else None
            colour, words, edge = looks or (CORRECT, f"within {low:+d} to {high:+d} ms", "o")
            shown_ms = float(np.clip(ms, -SHOWN_MS, SHOWN_MS))
            groups.setdefault((words, colour, "o" if shown_ms == ms else edge), []).append((shown_ms, line, f"#{row}"))
        for (words, colour, marker), some in groups.items():
            x, y, links = zip(*some, strict=True)
            label = words if marker == "o" else f"{words}, beyond {SHOWN_MS} ms"
            style: dict[str, Any] = {"color": colour, "marker": marker, "alpha": 0.75, "linewidths": 0, "zorder": 3}
            axes.scatter(x, y, s=32, label=label, **style).set_urls(links)
        axes.set(xlabel=x_label, ylim=(len(names) - 0.5, -0.5))
        axes.set_yticks(range(len(names)), [picture.plain(name) for name in names])
        axes.grid(visible=False, axis="y")
        picture.legend(figure, [axes])

    return picture.svg(draw, (WIDTH_IN, 1.2 + 0.26 * len(names)))


def _object(trial: StudyTrial) -> str:
    return "unknown" if trial.row.object is None else f"object {trial.row.object}"
