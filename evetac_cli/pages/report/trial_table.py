"""The trials of the report: charts of their onsets, the table with its filters, those of both studies."""

import html
import math
import os
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from evetac_cli.events import SLICES_PER_S
from evetac_cli.pages import shared
from evetac_cli.pages.report import charts, figures
from evetac_cli.pages.report.charts import Chart
from evetac_cli.pages.report.figures import LABELS_MS, TIMING_MS
from evetac_cli.pages.report.missing import command_for
from evetac_cli.pages.report.study import Study, StudyTrial, remark
from evetac_cli.pages.report.tables import cell, table

MOST_TRIALS = 2000  # in the table: those that stand out most
FILTERED = ("study", "object", "scene", "sensor", "outcome")  # columns by which trials are chosen
EMPTY = ("<td></td>", cell(None))
TIMES = {
    "t_s": "t_s is the true onset of gross slip",
    "t_c": "t_c the onset in the labels",
    "t_m": "t_m the first detection by a model",
}
LABEL_AXIS = "labels' onset after the true onset [ms]"
MODEL_AXIS = "first detection after the labels' onset [ms]"


def trials_of_both(studies: Sequence[Study]) -> str:
    """Trials of both studies, those that differ most first."""
    pairs = figures.matched(studies)
    if not pairs:
        return (
            "<p class='hint'>None: no recipe, and no scene, object, sensor, seed and number of a trial, is in both.</p>"
        )
    rows = []
    for one, other in pairs:
        cells, differences = [cell(one.name)], []
        for kind in ("label_error_ms", "model_error_ms"):
            values = getattr(one, kind), getattr(other, kind)
            known = None not in values and all(map(math.isfinite, values))
            difference = values[1] - values[0] if known else None
            differences.append(abs(difference or 0))
            cells += [cell(values[0]), cell(values[1]), cell(difference)]
        cells += [cell(one.row.outcome), cell(other.row.outcome)]
        changed = one.row.outcome != other.row.outcome
        rows.append((changed, max(differences), f"<tr>{''.join(cells)}</tr>"))
    rows.sort(key=lambda row: row[:2], reverse=True)
    names = [html.escape(study.name) for study in studies]
    heads = ["trial"]
    for error in ("t_c - t_s", "t_m - t_c"):
        heads += [f"{error} [ms], {names[0]}", f"{names[1]}", "difference [ms]"]
    heads += [f"outcome, {names[0]}", names[1]]
    said = f"{len(pairs)} trials; those whose outcome or onsets differ most come first."
    return f"<p class='hint'>{said}</p>" + table(heads, (row for _, _, row in rows[:MOST_TRIALS]))


def onset_charts(studies: Sequence[Study]) -> list[tuple[str, list[Chart | None]]]:
    """Onsets by labels against the truth, and by models against the labels, of each study."""
    shown = []
    for number, study in enumerate(studies):
        models = f"Models against the labels, {_median_of(study)}"
        shown.append(
            (
                study.name if len(studies) > 1 else "",
                [
                    charts.onset_chart(
                        study, number, "label_error_ms", LABELS_MS, LABEL_AXIS, "Labels against the truth"
                    ),
                    charts.onset_chart(study, number, "model_error_ms", TIMING_MS, MODEL_AXIS, models),
                ],
            )
        )
    return shown


def trial_table(studies: Sequence[Study], page: Path) -> str:
    """All trials, outliers first; page: where the report goes, from which its links lead."""
    rows = [(remark(trial, TIMING_MS), study, at, trial) for study in studies for at, trial in enumerate(study.trials)]
    rows.sort(key=lambda row: -row[0][0])  # stable: by name where nothing stands out
    if not rows:
        return "<p class='hint'>There are no trials here.</p>" + table([], [], "all-trials") + _unreadable(studies)
    shown = [
        (_cells(study, trial, remarked, page), study, at, trial, remarked) for (_, remarked), study, at, trial in rows
    ]
    shown = shown[:MOST_TRIALS]
    heads = [head for head in shown[0][0] if any(cells[head] not in EMPTY for cells, *_ in shown)]
    heads = [head for head in heads if head != "study" or len(studies) > 1]
    trials = [trial for *_, trial in rows]
    said = [_outliers(trials), *_meanings(heads), _own_pages(studies), _first_of(len(rows))]
    text = f"<p class='hint'>{' '.join(sentence for sentence in said if sentence)}</p>"
    body = []
    for cells, study, at, trial, remarked in shown:
        values = {name: getattr(trial.row, name, None) for name in FILTERED} | {"study": study.name}
        chosen = "".join(f" data-{name}='{shared.short(_text(value))}'" for name, value in values.items())
        outlier = " data-outlier" if remarked else ""
        row = f"data-row='{studies.index(study)}-{at}'{chosen}{outlier}"
        body.append(f"<tr {row}>{''.join(cells[head] for head in heads)}</tr>")
    filters = _filters([row[1:] for row in rows], len(studies) > 1)
    return text + filters + table(heads, body, "all-trials") + _unreadable(studies)


def _outliers(trials: Sequence[StudyTrial]) -> str:
    """How many stand out, and by what a trial would, of what is known of any."""
    reasons = []
    if any(trial.grasp is not None for trial in trials):
        reasons.append("a lost object")
    if any(trial.has_truth and trial.labelled_by is not None for trial in trials):
        reasons.append(f"an onset in the labels that is missing, or not {_within(LABELS_MS)} from the true one")
    if any(trial.late_by for trial in trials):
        reasons.append(f"a first detection that is missing, or not {_within(TIMING_MS)} from the labels' onset")
    outside = sum(remark(trial, TIMING_MS)[0] > 0 for trial in trials)
    if outside:
        verb = "stands" if outside == 1 else "stand"
        by = f", by how far: {'; '.join(reasons)}" if reasons else ""
        return f"{outside} of {len(trials)} {verb} out and {'comes' if outside == 1 else 'come'} first{by}."
    if not reasons:
        return ""
    none = "The trial does not stand out" if len(trials) == 1 else f"None of the {len(trials)} trials stands out"
    return f"{none}. What would: {'; '.join(reasons)}."


def _within(window_ms: tuple[int, int]) -> str:
    return f"{window_ms[0]} to {window_ms[1]:+d} ms"


def _meanings(heads: Sequence[str]) -> list[str]:
    """What columns and thumbnails mean, of those that are there."""
    meanings = [meaning for name, meaning in TIMES.items() if any(name in head for head in heads)]
    said = [f"{', '.join(meanings)}."] if meanings else []
    if any(head.startswith(("t_c - ", "t_m - ")) for head in heads):
        said.append("A click on a point above shows its trial.")
    if "onset, else busiest" in heads:
        said.append("Thumbnails: white is brighter, black darker.")
    return said


def _own_pages(studies: Sequence[Study]) -> str:
    """How many trials have a page of `view`, and the command that makes one more."""
    without = [study.folder / trial.row.path for study in studies for trial in study.trials if trial.page is None]
    trials = sum(len(study.trials) for study in studies)
    if not without:
        return "Each trial has a page of its own: click its name."
    command = f"<code class='command'>{html.escape(command_for('view', without[:1]))}</code>"
    if len(without) == trials:
        return f"No trial has a page of its own yet: {command} makes one."
    having = trials - len(without)
    verb = "has a page of its own" if having == 1 else "have a page of their own"
    return f"{having} of {trials} {verb}; {command} makes another."


def _first_of(rows: int) -> str:
    return f"The first {MOST_TRIALS:,} of {rows:,} are shown." if rows > MOST_TRIALS else ""


def _median_of(study: Study) -> str:
    return f"median of {study.models} models" if study.models > 1 else "one model"


def _cells(study: Study, trial: StudyTrial, remarked: str, page: Path) -> dict[str, str]:
    """The cells of a trial by the heads of their columns."""
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
        "study": cell(study.name),
        "onset, else busiest": f"<td>{image}</td>",
        "trial": f"<td class='name'>{name}</td>",
        "stands out": f"<td class='remark'>{shared.short(remarked)}</td>" if remarked else cell(None),
        "object": cell(row.object),
        "scene": cell(row.scene),
        "sensor": cell(row.sensor),
        "outcome": cell(row.outcome),
        "t_s [ms]": cell(trial.t_s),
        "t_c [ms]": cell(trial.t_c),
        "t_c - t_s [ms]": cell(trial.label_error_ms),
        "t_m - t_c [ms]": cell(trial.model_error_ms),
        "dots from truth [px]": cell(trial.tracking_px),
        "moved [mm]": cell(grasp.get("moved_mm")),
        "grip at the end [N]": cell(grasp.get("force_end_n")),
        "duration [s]": cell(row.slices / SLICES_PER_S if row.slices is not None else None),
        "events": cell(trial.events),
    }


def _text(value: Any) -> str:
    return "" if value is None else str(value)


def _filters(rows: Sequence[tuple[Study, int, StudyTrial]], several: bool) -> str:
    """A search, and a choice for each column that has more than one value."""
    parts = [
        "<label>find <input type='search' id='find' placeholder='any words' title='press / to come here'></label>",
        "<label><input type='checkbox' id='outliers'> only those that stand out</label>",
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
