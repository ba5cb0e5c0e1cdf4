"""Output for people: progress on stderr during a command, one table or one JSON object on stdout at its end."""

import itertools
import json
import math
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from evetac_cli.errors import error_dict
from evetac_cli.jobs import Outcome, Progress, silent

MOST_ROWS = 100  # printed of one table on a terminal
FEW_ROWS = 3  # up to this many rows, a table that is too wide is transposed
BAR_WIDTH = 14  # leaves space for a name on a line of 80 characters
MOST_PASTED = 3  # files that are listed individually at the end
_stdout: Any = None  # the stream for JSON while stdout is kept for it
MOST_SHORT, EXPONENT_FROM = 9999.5, 1e9  # between these, a number is printed whole, with more than four digits


def safe(text: str) -> str:
    """Return the text with all characters escaped that are not printable, except line breaks and tabs.

    File names and texts in files may contain escape sequences that change a terminal, or marks that reverse the
    direction of writing.
    """
    if text.isprintable():
        return text
    return "".join(
        sign if sign.isprintable() or sign in "\n\t" else sign.encode("unicode_escape").decode() for sign in text
    )


def _in_a_line(text: str) -> str:
    return safe(text).replace("\n", "\\n").replace("\t", "\\t")


def say(text: str) -> None:
    """Print a message to the user, on stderr."""
    print(safe(text), file=sys.stderr)


def print_text(text: str) -> None:
    """Print lines of a result, on stdout."""
    print(safe(text))


def wait_for_enter(text: str) -> None:
    """Print a message and wait for Enter, if stdin is a terminal."""
    if sys.stdin.isatty():
        say(text)
        sys.stdin.readline()


@contextmanager
def progress_bar(what: str, unit: str, *, quiet: bool) -> Iterator[Progress]:
    """Show a progress bar with the remaining time, if stderr is a terminal; otherwise show nothing."""
    if quiet or not sys.stderr.isatty():
        yield silent
        return
    from rich.console import Console
    from rich.progress import BarColumn, ProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar
    from rich.table import Column
    from rich.text import Text

    class Count(ProgressColumn):
        """Number done, the total once it is known, and the unit."""

        def render(self, task: Any) -> Text:
            of_all = "" if task.total is None else f"/{task.total:,.0f}"
            count = f"{math.floor(task.completed):,}{of_all} " if task.completed or of_all else ""
            return Text(f"{count}{task.fields['doing']}")

    one_line: dict[str, Any] = {"no_wrap": True, "overflow": "ellipsis"}
    columns = (
        TextColumn("{task.description}", markup=False, table_column=Column(ratio=1, **one_line)),
        BarColumn(BAR_WIDTH, table_column=Column(width=BAR_WIDTH)),
        Count(Column(**one_line)),
        TimeRemainingColumn(table_column=Column(**one_line)),
    )
    with Bar(*columns, console=Console(stderr=True), transient=True, expand=True) as bar:
        bar.add_task(_in_a_line(what), total=None, doing="")
        (task,) = bar.tasks

        def advance(done: float, total: float, doing: str = "") -> None:
            doing = _in_a_line(doing or unit)
            task.total = total or None
            if task.fields["doing"] != doing:  # a new kind of work has another speed
                bar.reset(task.id, doing=doing)
            bar.update(task.id, completed=done)

        yield advance


def show(
    command: str,
    rows: list[dict[str, Any]],
    summary: dict[str, Any],
    *,
    simulated: bool,
    as_json: bool,
    verbose: bool = False,
) -> None:
    """Print the result of a command: one JSON object, or a table with the summary below."""
    if as_json:
        _print_json({"command": command, "simulated": simulated, "rows": rows, "summary": summary})
        return
    print_table(command, rows, summary, simulated=simulated, verbose=verbose)


def first_rows(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the first MOST_ROWS rows of each table, for a terminal, and print how many more there are."""
    shown = []
    for _, group in itertools.groupby(rows, key=tuple):
        table = list(group)
        shown += table[:MOST_ROWS]
        if len(table) > MOST_ROWS:
            say(f"{len(table) - MOST_ROWS:,} more rows with {next(iter(table[0]))}; -v and --json print all")
    return shown


def show_failure(command: str, errors: Sequence[BaseException], outcomes: Sequence[Outcome]) -> None:
    """Print the errors that ended a command and the rows of what was made, as one JSON object.

    The first error determines the exit status. `simulated` is null if nothing was made.
    """
    result: dict[str, Any] = {
        "command": command,
        "simulated": any(outcome.simulated for outcome in outcomes) if outcomes else None,
        "rows": [row for outcome in outcomes for row in outcome.rows],
        "summary": count(outcomes),
        "error": error_dict(errors[0]),
    }
    if len(errors) > 1:
        result["more_errors"] = [error_dict(error) for error in errors[1:]]
    _print_json(result)


def count(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return how many files were made and how many were already up to date."""
    new_count = sum(outcome.made for outcome in outcomes)
    return {"made": new_count, "up_to_date": len(outcomes) - new_count}


def counted(outcomes: Sequence[Outcome]) -> str:
    """Return these numbers as a text, for example `2 files made, 1 file up to date`."""
    numbers = {name.replace("_", " "): number for name, number in count(outcomes).items()}
    parts = [f"{number} file{'s' * (number != 1)} {what}" for what, number in numbers.items() if number]
    return ", ".join(parts)


@contextmanager
def stdout_for_json() -> Iterator[None]:
    """Keep stdout for the JSON object that ends a command.

    All else that is printed within this block goes to stderr, whether by plug-ins, libraries or child processes.
    """
    global _stdout
    before, kept = (_stdout, sys.stdout), os.dup(1)
    _stdout, sys.stdout = _stdout or sys.stdout, sys.stderr
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        _stdout, sys.stdout = before


def _print_json(result: dict[str, Any]) -> None:
    print(json.dumps(plain(result), allow_nan=False), file=_stdout)


def print_table(
    title: str, rows: list[dict[str, Any]], summary: dict[str, Any], *, simulated: bool, verbose: bool = False
) -> None:
    """Print rows as a table; results from simulation are marked.

    Columns and figures without any value are left out unless `verbose`.
    """
    from rich.console import Console

    # What is printed is text, not markup: a path may hold [brackets] or :colons:.
    console = Console(soft_wrap=not sys.stdout.isatty(), markup=False, emoji=False)
    heading = _in_a_line(title) + (" (simulated)" if simulated else "")
    for _, group in itertools.groupby(rows, key=tuple):  # rows with other columns form a separate table
        of_group = list(group)
        for table in _tables(heading, of_group if verbose else _with_values(of_group), console.width):
            console.print(table)
    for name, value in summary.items():
        if verbose or not _is_nothing(value):
            console.print(f"{_in_a_line(name)}: {format_value(value)}", highlight=False, soft_wrap=True)


def _with_values(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows without columns that are empty in all of them; the first column, which names rows, stays."""
    first, *others = rows[0]
    kept = [first, *(name for name in others if not all(_is_nothing(row[name]) for row in rows))]
    return [{name: row[name] for name in kept} for row in rows]


def _is_nothing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def _tables(title: str, rows: list[dict[str, Any]], width: int) -> Iterator[Any]:
    """Yield tables for rows with the same columns.

    If one table is too wide, up to FEW_ROWS rows are transposed, with a line per figure. More rows are split into
    several tables, each with the first column, which names a row.
    """
    names = list(map(_in_a_line, rows[0]))
    cells = [[format_value(value) for value in row.values()] for row in rows]
    widths = [3 + max(map(len, column)) for column in zip(names, *cells, strict=True)]  # with a line and two spaces
    if len(rows) <= FEW_ROWS and 1 + sum(widths) > width:
        yield _table(title, [names, *cells], ["left"] * (1 + len(cells)), header=False)
        return
    columns = [list(column) for column in zip(names, *cells, strict=True)]
    sides = [
        "right" if all(isinstance(each, (int, float, type(None))) for each in of) else "left"
        for of in zip(*(row.values() for row in rows), strict=True)
    ]
    shown = [0]
    for column in range(1, len(columns) + 1):
        is_full = column == len(columns) or 1 + sum(widths[each] for each in (*shown, column)) > width
        if is_full and (len(shown) > 1 or len(columns) == 1):
            yield _table(title, [columns[each] for each in shown], [sides[each] for each in shown], header=True)
            title, shown = "", [0]
        shown.append(column)


def _table(title: str, columns: list[list[str]], sides: list[Any], *, header: bool) -> Any:
    """Return a table of texts; with a header, the first text of each column is its heading."""
    from rich.table import Table

    table = Table(title=title, title_justify="left", show_header=header)
    for column, side in zip(columns, sides, strict=True):
        table.add_column(column[0] if header else "", justify=side, overflow="fold")
    for line in list(zip(*columns, strict=True))[header:]:
        table.add_row(*line)
    return table


def print_result(verdict: Sequence[str], outputs: Sequence[Path]) -> None:
    """Print, below a table, the verdict on its figures, then the files that were made, ready to paste."""
    for line in verdict:
        print_text(line)
    written = [path for path in outputs if path.exists()]
    folders = sorted({path.parent for path in written})
    if len(written) <= MOST_PASTED:
        words = [shlex.quote(str(path)) for path in written]
    else:
        words = [shlex.quote(str(folder)) for folder in folders]  # each represents its files
    if words:
        print_text(" ".join(words))


def format_value(value: Any) -> str:
    """Return a one-line cell: numbers with four digits, large ones whole, `-` for None, yes or no for booleans."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        if math.isnan(value):
            return "-"
        return f"{value:,.0f}" if MOST_SHORT <= abs(value) < EXPONENT_FROM else f"{value:.4g}"
    if isinstance(value, int):
        return f"{value:,}"
    return _in_a_line(str(value))


def plain(value: Any) -> Any:
    """Return a value as JSON allows it: a number that is not finite becomes null."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
