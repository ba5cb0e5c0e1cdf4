"""Trials of the report: charts of their onsets, the table with its filters, the trials of both studies."""

import html
import math
import os
from base64 import b64encode
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from evetac_cli.events import SLICES_PER_S
from evetac_cli.pages import shared
from evetac_cli.pages.report import charts, figures
from evetac_cli.pages.report.figures import LABELS_MS, TIMING_MS
from evetac_cli.pages.report.missing import command_for
from evetac_cli.pages.report.study import Study, StudyTrial, remark
from evetac_cli.pages.report.tables import cell, table

MOST_TRIALS = 2000  # in the table: outliers first
FILTERED = ("study", "object", "scene", "sensor", "outcome")  # columns by which trials are filtered
EMPTY = ("<td></td>", cell(None))
TIMES = {
    "t_s": "t_s is the true onset of gross slip",
    "t_c": "t_c is the onset in the labels",
    "t_m": "t_m is the first detection by a model",
}
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
        models = f"Models against the labels, {_median_of(study)}"
        for title, kind, window_ms, axis in (
            ("Labels against the truth", "label_error_ms", LABELS_MS, LABEL_AXIS),
            (models, "model_error_ms", TIMING_MS, MODEL_AXIS),
        ):
            if chart := charts.onset_chart(study, number, kind, window_ms, axis):
                yield f"{study.name}: {title}" if len(studies) > 1 else title, chart


def trial_table(studies: Sequence[Study], page: Path) -> str:
    """Return the table of all trials, outliers first; page: where the report is written, for relative links."""
    rows = [(remark(trial, TIMING_MS), study, at, trial) for study in studies for at, trial in enumerate(study.trials)]
    rows.sort(key=lambda row: -row[0][0])  # stable: other trials stay sorted by name
    if not rows:
        return "<p class='hint'>There are no trials here.</p>" + table([], [], "all-trials") + _unreadable(studies)
    shown = [
        (_cells(study, trial, remarked, page), study, at, trial, remarked) for (_, remarked), study, at, trial in rows
    ]
    shown = shown[:MOST_TRIALS]
    heads = [head for head in shown[0][0] if any(cells[head] not in EMPTY for cells, *_ in shown)]
    heads = [head for head in heads if head != "study" or len(studies) > 1]
    trials = [trial for *_, trial in rows]
    sentences = [_outliers(trials), *_meanings(heads), _own_pages(studies), _first_of(len(rows))]
    text = f"<p class='hint'>{' '.join(sentence for sentence in sentences if sentence)}</p>"
    body = []
    for cells, study, at, trial, remarked in shown:
        values = {name: getattr(trial.row, name, None) for name in FILTERED} | {"study": study.name}
        attributes = "".join(f" data-{name}='{shared.short(_text(value))}'" for name, value in values.items())
        outlier = " data-outlier" if remarked else ""
        row = f"id='{charts.row_id(studies.index(study), at)}'{attributes}{outlier}"
        body.append(f"<tr {row}>{''.join(cells[head] for head in heads)}</tr>")
    filters = _filters([row[1:] for row in rows], len(studies) > 1)
    return text + filters + table(heads, body, "all-trials") + _unreadable(studies)


def _outliers(trials: Sequence[StudyTrial]) -> str:
    """Return the number of outliers, and the criteria for them, as far as any trial has the data."""
    reasons = []
    if any(trial.grasp is not None for trial in trials):
        reasons.append("a lost object")
    if any(trial.has_truth and trial.labelled_by is not None for trial in trials):
        reasons.append(f"a labelled onset that is missing, or not within {_within(LABELS_MS)} of the true onset")
    if any(trial.late_by for trial in trials):
        reasons.append(f"a first detection that is missing, or not within {_within(TIMING_MS)} of the labels' onset")
    outside = sum(remark(trial, TIMING_MS)[0] > 0 for trial in trials)
    if outside:
        verb = "is an outlier" if outside == 1 else "are outliers"
        by = f", worst first. Criteria: {'; '.join(reasons)}" if reasons else ""
        return f"{outside} of {len(trials)} trials {verb}, at the top of the table{by}."
    if not reasons:
        return ""
    none = "The trial is not an outlier" if len(trials) == 1 else f"None of the {len(trials)} trials is an outlier"
    return f"{none}. Criteria: {'; '.join(reasons)}."


def _within(window_ms: tuple[int, int]) -> str:
    return f"{window_ms[0]} to {window_ms[1]:+d} ms"


def _meanings(heads: Sequence[str]) -> list[str]:
    """Return the meanings of those columns and thumbnails that are shown."""
    meanings = [meaning for name, meaning in TIMES.items() if any(name in head for head in heads)]
    sentences = [f"{', '.join(meanings)}."] if meanings else []
    if any(head.startswith(("t_c - ", "t_m - ")) for head in heads):
        sentences.append("Click a point above to show its trial.")
    if "onset, else busiest" in heads:
        sentences.append("Thumbnails: white is brighter, black is darker.")
    return sentences


def _own_pages(studies: Sequence[Study]) -> str:
    """Return how many trials have a page of `view`, and the command that creates one more."""
    without = [study.folder / trial.row.path for study in studies for trial in study.trials if trial.page is None]
    trials = sum(len(study.trials) for study in studies)
    if not without:
        return "Each trial has its own page: click its name."
    command = f"<code class='command'>{html.escape(command_for('view', without[:1]))}</code>"
    if len(without) == trials:
        return f"No trial has its own page yet: {command} creates one."
    having = trials - len(without)
    verb = "has its own page" if having == 1 else "have their own page"
    return f"{having} of {trials} {verb}; {command} creates another."


def _first_of(rows: int) -> str:
    return f"The first {MOST_TRIALS:,} of {rows:,} are shown." if rows > MOST_TRIALS else ""


def _median_of(study: Study) -> str:
    return f"median of {study.models} models" if study.models > 1 else "one model"


def _cells(study: Study, trial: StudyTrial, remarked: str, page: Path) -> dict[str, str]:
    """Return the cells of a trial by the headings of their columns."""
    row, grasp = trial.row, trial.grasp or {}
    image = ""
    if trial.thumbnail is not None:
        data = b64encode(trial.thumbnail).decode()
        image = f"<img loading='lazy' width='96' alt='events' src='data:image/png;base64,{data}'>"
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
