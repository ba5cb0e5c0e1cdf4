"""The trials of the report: charts of their onsets, the table with its filters, those of both studies."""

import html
import math
import os
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from evetac_cli.inspect import pages
from evetac_cli.inspect.report import charts, figures
from evetac_cli.inspect.report.charts import Chart
from evetac_cli.inspect.report.figures import LABELS_MS, TIMING_MS
from evetac_cli.inspect.report.study import Study, StudyTrial, remark
from evetac_cli.inspect.report.tables import cell, table

MOST_TRIALS = 2000  # in the table: those that stand out most
FILTERED = ("study", "object", "scene", "sensor", "outcome")  # columns by which trials are chosen
LABEL_AXIS = "onset in the labels minus true onset, t_c - t_s [ms]"
MODEL_AXIS = "first detection minus onset in the labels, t_m - t_c [ms]"


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
        cells += [cell(one.outcome), cell(other.outcome)]
        changed = one.outcome != other.outcome
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
    found = []
    for number, study in enumerate(studies):
        models = f"Models against the labels, {_median_of(study)}"
        found.append(
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
    return found


def trial_table(studies: Sequence[Study], page: Path) -> str:
    """All trials, outliers first; page: where the report goes, from which its links lead."""
    rows = [(remark(trial, TIMING_MS), study, at, trial) for study in studies for at, trial in enumerate(study.trials)]
    rows.sort(key=lambda row: -row[0][0])  # stable: by name where nothing stands out
    outside = sum(1 for (score, _), *_ in rows if score)
    several = len(studies) > 1
    views = sum(trial.page is not None for _, _, _, trial in rows)
    example = next((str(study.folder / trial.row.path) for _, study, _, trial in rows if trial.page is None), "")
    text = (
        f"<p class='hint'>{outside} of {len(rows)} stand out and come first: grasps that lost their object, slips that"
        " labels or models never find, then by how far an onset is outside its window (labels -4 to +3 ms of the truth,"
        f" models -50 to +20 ms of the labels). {views} have a page of their own"
        + (f"; <code>evetac view {html.escape(example)}</code> makes one." if example else ".")
        + " A click on a point above shows its trial.</p>"
    )
    if len(rows) > MOST_TRIALS:
        text += f"<p class='hint'>The first {MOST_TRIALS:,} of {len(rows):,} are shown.</p>"
    heads = [
        *(["study"] if several else []),
        *("", "trial", "object", "scene", "sensor", "outcome", "t_s [ms]", "t_c [ms]", "t_c - t_s [ms]"),
        *("t_m - t_c [ms]", "dots [px]", "moved [mm]", "grip [N]", "duration [s]", "events", "remark"),
    ]
    body = [
        _trial(study, studies.index(study), at, trial, remarked, several, page)
        for (_, remarked), study, at, trial in rows[:MOST_TRIALS]
    ]
    return text + _filters([row[1:] for row in rows], several) + table(heads, body, "all-trials") + _unreadable(studies)


def _median_of(study: Study) -> str:
    return f"median of {study.models} models" if study.models > 1 else "one model"


def _trial(study: Study, number: int, at: int, trial: StudyTrial, remarked: str, several: bool, page: Path) -> str:
    row, grasp = trial.row, trial.grasp or {}
    image = ""
    if trial.thumbnail is not None:
        data = b64encode(trial.thumbnail).decode()
        image = f"<img loading='lazy' width='96' alt='events at the onset' src='data:image/png;base64,{data}'>"
    name = pages.short(trial.name)
    if trial.page is not None:
        link = quote(os.path.relpath(trial.page.resolve(), page.resolve().parent))
        image, name = (f"<a href='{link}'>{part}</a>" if part else "" for part in (image, name))
    values = {name: getattr(row, name, None) for name in FILTERED} | {"study": study.name}
    chosen = "".join(f" data-{name}='{pages.short(_text(value))}'" for name, value in values.items())
    outlier = " data-outlier" if remarked else ""
    cells = [
        *([cell(study.name)] if several else []),
        f"<td>{image}</td><td class='name'>{name}</td>",
        *(cell(getattr(row, name)) for name in ("object", "scene", "sensor", "outcome")),
        *(cell(value) for value in (trial.t_s, trial.t_c, trial.label_error_ms, trial.model_error_ms)),
        *(cell(value) for value in (trial.tracking_px, grasp.get("moved_mm"), grasp.get("force_end_n"))),
        *(cell(value) for value in (row.slices / 1000 if row.slices is not None else None, trial.events)),
        f"<td class='remark'>{pages.short(remarked)}</td>",
    ]
    return f"<tr data-row='{number}-{at}'{chosen}{outlier}>{''.join(cells)}</tr>"


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
                f"<option value='{pages.short(value)}'>{pages.short(value) or 'none'}</option>" for value in ordered
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
