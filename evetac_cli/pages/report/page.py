"""The page of report: trials, onsets and evaluations of one study, or of two compared."""

import html
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from evetac_cli.commands.columns import Column, columns_of, find
from evetac_cli.evaluate import PAPER, SUBJECTS
from evetac_cli.evaluate.subject import Subject, SubjectTable
from evetac_cli.jobs import Row
from evetac_cli.pages import shared
from evetac_cli.pages.report import figures
from evetac_cli.pages.report.figures import StudyFigure
from evetac_cli.pages.report.study import Found, Study
from evetac_cli.pages.report.trial_table import onset_charts, trial_table, trials_of_both
from evetac_cli.pages.shared import cell, figure_text, table
from evetac_cli.resources import PACKAGE

MOST_ROWS = 300  # of each table except the trials
Entries = list[tuple[Study, Found, Row]]


def render(studies: Sequence[Study], page: Path) -> bytes:
    """Return the whole page; raise EvetacError if it would exceed 20 MB."""
    title = " against ".join(study.name for study in studies)
    simulated = any(study.simulated for study in studies)
    sections = [("overview", "Overview", _overview(studies))]
    if len(studies) > 1:
        sections.append(("both", "Trials in both studies", trials_of_both(studies)))
    sections.append(("trials", "Trials", _charts(onset_charts(studies)) + trial_table(studies, page)))
    sections += [(subject.name, subject.title, _section(subject, studies)) for subject in SUBJECTS]
    sections = [section for section in (*sections, ("notes", "Notes", _notes(studies))) if section[2]]
    body = "".join(
        f"<section class='card' id='{name}'><h2>{head}</h2>{text}</section>" for name, head, text in sections
    )
    nav = "".join(f"<a href='#{name}'>{head}</a>" for name, head, _ in sections)
    lead = "".join(
        f"<p class='id'>{html.escape(str(study.folder.resolve()))}: "
        + ", ".join(f"{kind} {count:,}" for kind, count in sorted(study.files.items()))
        + "</p>"
        for study in studies
    )
    parts = {
        "TITLE": html.escape(title),
        "HEADING": f"<h1>{html.escape(title)}</h1><div>{shared.badges((), simulated=simulated)}</div>{lead}",
        "NAV": nav,
        "BODY": body,
    }
    return shared.fill(PACKAGE / "pages" / "report" / "page.html", parts, studies[0].folder, "report on a subfolder")


def _overview(studies: Sequence[Study]) -> str:
    if len(studies) == 1:
        tiles = "".join(
            f"<div><dt>{html.escape(one.name)}</dt><dd>{figures.in_words(one.value, one.kind)}{_over(one)}</dd></div>"
            for one in figures.headline(studies[0])
        )
        return f"<dl class='tiles'>{tiles}</dl>"
    by_study = [{one.name: one for one in figures.headline(study)} for study in studies]
    rows = []
    for name in dict.fromkeys(name for of_study in by_study for name in of_study):
        one, other = (of_study.get(name) for of_study in by_study)
        both = [
            cell(None)
            if figure is None
            else cell(figure.value, _over(figure), figures.in_words(figure.value, figure.kind))
            for figure in (one, other)
        ]
        cells = [cell(name), *both, cell(None)]
        if one is not None and other is not None:
            difference = other.value - one.value
            cells[-1] = cell(difference, text=figures.in_words(difference, one.kind))
        rows.append(f"<tr>{''.join(cells)}</tr>")
    names = [html.escape(study.name) for study in studies]
    return table(["figure", *names, f"{names[1]} minus {names[0]}"], rows)


def _over(figure: StudyFigure) -> str:
    return f" <small>over {html.escape(figure.over)}</small>" if figure.over else ""


def _charts(titled: Iterable[tuple[str, str]]) -> str:
    """Return HTML for charts with their titles."""
    shown = "".join(f"<figure class='chart'><h3>{shared.short(title)}</h3>{chart}</figure>" for title, chart in titled)
    return f"<div class='charts'>{shown}</div>" if shown else ""


def _section(subject: Subject, studies: Sequence[Study]) -> str:
    """Return plots and tables of the reports of a subject; empty if there are none."""
    of_reports = [(study, one) for study in studies for one in study.reports(f"evaluate {subject.name}")]
    several = len(studies) > 1
    legend = columns_of(f"evaluate {subject.name}")
    explained: dict[str, str] = {}
    text = _charts(
        (
            f"{study.name}: {evaluation.path}" if several else evaluation.path,
            shared.image(evaluation.plot, "alt='plot'"),
        )
        for study, evaluation in of_reports
        if evaluation.plot is not None
    )
    for shown in subject.tables:
        # A table without columns shows all columns of a report, which differ between reports.
        for some in [of_reports] if shown.columns else [[one] for one in of_reports]:
            if entries := _entries(shown, some):
                columns = [find(legend, name) or Column(name, "") for name in _with_values(shown, entries)]
                text += _table(shown, some, entries, columns, several)
                explained |= {column.title: column.in_words for column in columns}
    return f"<p class='hint'>{html.escape(subject.about)}</p>{text}{_legend(explained)}" if text else ""


def _legend(explained: Mapping[str, str]) -> str:
    """Return the meaning of each heading, folded; empty without any."""
    rows = "".join(f"<dt>{html.escape(title)}</dt><dd>{html.escape(words)}</dd>" for title, words in explained.items())
    return f"<details class='legend'><summary>What the columns mean</summary><dl>{rows}</dl></details>" if rows else ""


def _entries(shown: SubjectTable, of_reports: Sequence[tuple[Study, Found]]) -> Entries:
    """Return the rows of a table, and where they come from."""
    return [
        (study, evaluation, row)
        for study, evaluation in of_reports
        for row in shown.rows(evaluation.rows, evaluation.summary)
    ]


def _with_values(shown: SubjectTable, entries: Entries) -> list[str]:
    """Return the names of the columns that have a value in any row; the paper's figure is next to evetac's."""
    rows = [row for *_, row in entries]
    every = dict.fromkeys(key for row in rows for key in row)
    names = shown.columns or [
        name for name in every if not (name.startswith("paper_") and name.removeprefix("paper_") in every)
    ]
    return [name for name in names if any(row.get(name) is not None for row in rows)]


def _table(
    shown: SubjectTable,
    of_reports: Sequence[tuple[Study, Found]],
    entries: Entries,
    columns: Sequence[Column],
    several: bool,
) -> str:
    """Return a table of a subject."""
    with_report = len(of_reports) > 1
    heads = ["study"] * several + ["report"] * with_report
    heads += [html.escape(column.title) for column in columns]
    rows = []
    for study, evaluation, row in entries[:MOST_ROWS]:
        cells = [cell(study.name)] * several + [cell(evaluation.path)] * with_report
        cells += [_with_paper(column.name, row, evaluation) for column in columns]
        bad = " class='bad'" if row.get("ok") is False else ""
        rows.append(f"<tr{bad}>{''.join(cells)}</tr>")
    simulated = all(evaluation.simulated for _, evaluation in of_reports)
    badge = " <span class='badge simulated'>simulated</span>" if simulated else ""
    more = f" <small>first {MOST_ROWS} of {len(entries)}</small>" if len(entries) > MOST_ROWS else ""
    title = shown.title if shown.columns else f"{shown.title}, {of_reports[0][1].path}"
    return f"<h3>{shared.short(title)}{badge}{more}</h3>" + table(heads, rows)


def _with_paper(name: str, row: Row, evaluation: Found) -> str:
    """Return a cell with evetac's figure, and the paper's with its mark."""
    of_paper = f"paper_{name}"
    beside = PAPER.beside(of_paper, row, evaluation.source) if of_paper in PAPER.columns else None
    words = f" <small class='paper'>({figure_text(beside.value)}, {beside.mark})</small>" if beside else ""
    return cell(row.get(name), words)


def _notes(studies: Sequence[Study]) -> str:
    """Return the notes of each study; empty without any."""
    lines = [f"{study.name}: {note}" if len(studies) > 1 else note for study in studies for note in study.notes]
    return f"<ul>{''.join(f'<li>{html.escape(line)}</li>' for line in lines)}</ul>" if lines else ""
