"""Trials of the report: charts of their onsets, the table with its filters, the trials of both studies."""

import html
import math
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.common.picture import CORRECT, EARLY, LATE
from evetac_cli.events import SLICES_PER_S
from evetac_cli.pages import shared
from evetac_cli.pages.report import figures
from evetac_cli.pages.report.study import LABELS_MS, TIMING_MS, Study, StudyTrial, remark
from evetac_cli.pages.shared import cell, table

MOST_TRIALS = 2000  # in the table: outliers first
FILTERED = ("study", "object", "scene", "sensor", "outcome")  # columns by which trials are filtered
EMPTY = ("<td></td>", cell(None))
HINT = (
    "An outlier has lost its object, or a labelled onset or first detection is missing or outside of its limits. These"
    f" are {LABELS_MS[0]} to {LABELS_MS[1]:+d} ms from the true onset t_s to the onset in the labels t_c, and"
    f" {TIMING_MS[0]} to {TIMING_MS[1]:+d} ms from there to a model's first detection t_m. Click a point above to show"
    " its trial. Thumbnails: white is brighter, black is darker. <code class='command'>evetac view RECORDING</code>"
    " makes a page of its own for a trial, to which its name then links."
)
SHOWN_MS = 100  # farther onsets are drawn at the edge
WIDTH_IN = 7.0  # of a chart of onsets
LABEL_AXIS = "labels' onset after the true onset [ms]"
MODEL_AXIS = "first detection after the labels' onset [ms]"


def trials_of_both(studies: Sequence[Study]) -> str:
    """Return the table of trials of both studies, largest differences first."""
    pairs, words = figures.matched(studies)
    hint = f"<p class='hint'>{html.escape(words)}"
    if not pairs:
        return f"{hint}</p>"
    errors = {"t_c - t_s": "label_error_ms", "t_m - t_c": "model_error_ms", "t_m - t_s": "model_truth_error_ms"}
    both = [trial for pair in pairs for trial in pair]
    errors = {name: kind for name, kind in errors.items() if any(getattr(trial, kind) is not None for trial in both)}
    rows = []
    for one, other in pairs:
        cells, differences = [cell(one.name)], []
        for kind in errors.values():
            values = getattr(one, kind), getattr(other, kind)
            both_known = None not in values and all(map(math.isfinite, values))
            difference = values[1] - values[0] if both_known else None
            differences.append(abs(difference or 0))
            cells += [cell(values[0]), cell(values[1]), cell(difference)]
        cells += [cell(one.row.outcome), cell(other.row.outcome)]
        changed = one.row.outcome != other.row.outcome
        rows.append((changed, max(differences, default=0), f"<tr>{''.join(cells)}</tr>"))
    rows.sort(key=lambda row: row[:2], reverse=True)
    names = [html.escape(study.name) for study in studies]
    heads = ["trial"]
    for error in errors:
        heads += [f"{error} [ms], {names[0]}", f"{names[1]}", "difference [ms]"]
    heads += [f"outcome, {names[0]}", names[1]]
    abstained = sum(bool(trial.doubt) for trial in both)
    dashes = f" A dash: not known; the labels of {abstained} of these trials abstain." if abstained else ""
    hint += f"{dashes} Those whose outcomes or onsets differ most come first.</p>"
    return hint + table(heads, (row for _, _, row in rows[:MOST_TRIALS]))


def onset_charts(studies: Sequence[Study]) -> Iterator[tuple[str, str]]:
    """Yield title and chart of labelled onsets against the truth, and of models against the labels, for each study."""
    for number, study in enumerate(studies):
        of_models = f"median of {study.models} models" if study.models > 1 else "one model"
        for title, kind, window_ms, axis in (
            ("Labels against the truth", "label_error_ms", LABELS_MS, LABEL_AXIS),
            (f"Models against the labels, {of_models}", "model_error_ms", TIMING_MS, MODEL_AXIS),
        ):
            if chart := _onset_chart(study, number, kind, window_ms, axis):
                yield f"{study.name}: {title}" if len(studies) > 1 else title, chart


def trial_table(studies: Sequence[Study], page: Path) -> str:
    """Return the table of all trials, outliers first; page: where the report is written, for relative links."""
    rows = [(remark(trial), study, at, trial) for study in studies for at, trial in enumerate(study.trials)]
    rows.sort(key=lambda row: -row[0][0])  # stable: other trials stay sorted by name
    if not rows:
        return "<p class='hint'>There are no trials here.</p>" + table([], [], "all-trials") + _unreadable(studies)
    shown = [
        (_cells(study, trial, remarked, page), study, at, trial, remarked) for (_, remarked), study, at, trial in rows
    ]
    shown = shown[:MOST_TRIALS]
    heads = [head for head in shown[0][0] if any(cells[head] not in EMPTY for cells, *_ in shown)]
    heads = [head for head in heads if head != "study" or len(studies) > 1]
    outliers = sum(score > 0 for (score, _), *_ in rows)
    first = f" The first {MOST_TRIALS:,} are shown." if len(rows) > MOST_TRIALS else ""
    text = f"<p class='hint'>{outliers} of {len(rows)} trials are outliers, at the top of the table.{first} {HINT}</p>"
    body = []
    for cells, study, at, trial, remarked in shown:
        values = {name: getattr(trial.row, name, None) for name in FILTERED} | {"study": study.name}
        attributes = "".join(f" data-{name}='{shared.short(_text(value))}'" for name, value in values.items())
        outlier = " data-outlier" if remarked else ""
        row = f"id='{_row_id(studies.index(study), at)}'{attributes}{outlier}"
        body.append(f"<tr {row}>{''.join(cells[head] for head in heads)}</tr>")
    filters = _filters([row[1:] for row in rows], len(studies) > 1)
    return text + filters + table(heads, body, "all-trials") + _unreadable(studies)


def _cells(study: Study, trial: StudyTrial, remarked: str, page: Path) -> dict[str, str]:
    """Return the cells of a trial by the headings of their columns."""
    row, grasp = trial.row, trial.grasp or {}
    image = ""
    if trial.thumbnail is not None:
        image = shared.image(trial.thumbnail, "loading='lazy' width='96' alt='events'")
    name = shared.short(trial.name)
    if trial.page is not None:
        link = quote(os.path.relpath(trial.page.resolve(), page.resolve().parent))
        image, name = (f"<a href='{link}'>{part}</a>" if part else "" for part in (image, name))
    return {
        "trial": f"<td class='name'>{name}</td>",
        "study": cell(study.name),
        "onset, else busiest": f"<td>{image}</td>",
        "stands out": f"<td class='remark'>{shared.short(remarked)}</td>" if remarked else cell(None),
        "object": cell(row.object),
        "scene": cell(row.scene),
        "sensor": cell(row.sensor),
        "outcome": cell(row.outcome),
        "t_s [ms]": cell(trial.t_s),
        "t_c [ms]": cell("abstained") if trial.doubt else cell(trial.t_c),
        "t_c - t_s [ms]": cell(trial.label_error_ms),
        "t_m - t_c [ms]": cell(trial.model_error_ms),
        "t_m - t_s [ms]": cell(trial.model_truth_error_ms),
        "dots from truth [px]": cell(trial.tracking_px),
        "moved [mm]": cell(grasp.get("moved_mm")),
        "grip at the end [N]": cell(grasp.get("force_end_n")),
        "duration [s]": cell(row.slices / SLICES_PER_S if row.slices is not None else None),
        "events": cell(trial.events),
    }


def _text(value: Any) -> str:
    return "" if value is None else str(value)


def _filters(rows: Sequence[tuple[Study, int, StudyTrial]], several: bool) -> str:
    """Return a search field, and a selection for each column with more than one value."""
    parts = [
        "<label>find <input type='search' id='find' placeholder='any words' title='press / to search'></label>",
        "<label><input type='checkbox' id='outliers'> only outliers</label>",
    ]
    for name in FILTERED:
        if name == "study":
            values = {study.name for study, _, _ in rows} if several else set()
        else:
            values = {_text(getattr(trial.row, name)) for _, _, trial in rows}
        if len(values) > 1:
            ordered = sorted(values, key=lambda value: (len(value), value) if value.isdigit() else (99, value))
            options = "".join(
                f"<option value='{shared.short(value)}'>{shared.short(value) or 'none'}</option>" for value in ordered
            )
            parts.append(
                f"<label>{name} <select data-by='{name}'><option value='*'>all</option>{options}</select></label>"
            )
    return f"<div class='filters'>{''.join(parts)}<output id='shown' class='quiet'></output></div>"


def _unreadable(studies: Sequence[Study]) -> str:
    rows = [
        f"<tr>{cell(str(study.folder / path))}{cell(reason)}</tr>"
        for study in studies
        for path, reason in study.unreadable
    ]
    if not rows:
        return ""
    return f"<h3>{len(rows)} files cannot be read</h3>" + table(["file", "reason"], rows[:MOST_TRIALS])


def _row_id(study: int, trial: int) -> str:
    """Return the HTML id of a trial's row, by the numbers of study and trial."""
    return f"trial-{study}-{trial}"


def _onset_chart(study: Study, number: int, kind: str, window_ms: tuple[int, int], x_label: str) -> str:
    """Return an SVG with a point per trial's error (`label_error_ms` or `model_error_ms`), a line per object.

    number: of the study on the page. Empty without errors.
    """
    errors = [(_row_id(number, at), _object(trial), getattr(trial, kind)) for at, trial in enumerate(study.trials)]
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
