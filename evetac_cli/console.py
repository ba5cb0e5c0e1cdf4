"""What people see: progress on stderr while it lasts, one table or one JSON object on stdout at the end."""

import itertools
import json
import math
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from evetac_cli.errors import error_dict
from evetac_cli.jobs import Outcome, Progress, silent

FEW_ROWS = 3
BAR_WIDTH = 14  # leaves room for a name on a line of 80 signs
MOST_PASTED = 3  # files that are named one by one at the end
MOST_NAMING = 3  # columns that are repeated where a table is split
MOST_SHORT, EXPONENT_FROM = 9999.5, 1e9  # between them a number has more than four digits, and is still easily read


def safe(text: str) -> str:
    """Text that cannot change a terminal: what is neither printable nor a line's end nor a tab is spelt out.

    File names and texts in files may hold escape sequences, or marks that turn the direction of writing.
    """
    if text.isprintable():
        return text
    return "".join(
        sign if sign.isprintable() or sign in "\n\t" else sign.encode("unicode_escape").decode() for sign in text
    )


def _in_a_line(text: str) -> str:
    return safe(text).replace("\n", "\\n").replace("\t", "\\t")


def say(text: str) -> None:
    """A message to the user, on stderr."""
    print(safe(text), file=sys.stderr)


def print_text(text: str) -> None:
    """Lines of a result, on stdout."""
    print(safe(text))


def wait_for_enter(text: str) -> None:
    """Say something and wait for the user, if there is one at the keyboard."""
    if sys.stdin.isatty():
        say(text)
        sys.stdin.readline()


@contextmanager
def progress_bar(what: str, unit: str, *, quiet: bool) -> Iterator[Progress]:
    """A bar with rate and time left, if stderr is a terminal; otherwise nothing."""
    if quiet or not sys.stderr.isatty():
        yield silent
        return
    from rich.console import Console
    from rich.progress import BarColumn, ProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar
    from rich.table import Column
    from rich.text import Text

    class Count(ProgressColumn):
        """Done, of how many once that is known, and what is counted."""

        def render(self, task: Any) -> Text:
            of_all = "" if task.total is None else f"/{task.total:,.0f}"
            count = f"{math.floor(task.completed):,}{of_all} " if task.completed or of_all else ""
            return Text(f"{count}{task.fields['doing']}")

    class Rate(ProgressColumn):
        """Units a second, where they are many."""

        def render(self, task: Any) -> Text:
            return Text(f"{task.speed:,.0f}/s" if task.speed and task.speed >= 1 else "")

    one_line: dict[str, Any] = {"no_wrap": True, "overflow": "ellipsis"}
    columns = (
        TextColumn("{task.description}", markup=False, table_column=Column(ratio=1, **one_line)),
        BarColumn(BAR_WIDTH, table_column=Column(width=BAR_WIDTH)),
        Count(Column(**one_line)),
        Rate(Column(**one_line)),
        TimeRemainingColumn(table_column=Column(**one_line)),
    )
    with Bar(*columns, console=Console(stderr=True), transient=True, expand=True) as bar:
        bar.add_task(_in_a_line(what), total=None, doing="")
        (task,) = bar.tasks

        def advance(done: float, total: float, doing: str = "") -> None:
            doing = _in_a_line(doing or unit)
            task.total = total or None
            if task.fields["doing"] != doing:  # another work has another speed
                bar.reset(task.id, doing=doing)
            bar.update(task.id, completed=done)

        yield advance


@contextmanager
def live() -> Iterator[Callable[[str], None]]:
    """A text that is shown anew in its place while the block lasts, on stderr; nothing if that is no terminal."""
    if not sys.stderr.isatty():
        yield lambda text: None
        return
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    with Live(console=Console(stderr=True), auto_refresh=False, transient=True) as shown:
        yield lambda text: shown.update(Text(safe(text)), refresh=True)


def show(command: str, rows: list[dict[str, Any]], summary: dict[str, Any], *, simulated: bool, as_json: bool) -> None:
    """Print the result of a command: one JSON object, or a table with the summary below."""
    if as_json:
        _print_json({"command": command, "simulated": simulated, "rows": rows, "summary": summary})
        return
    print_table(command, rows, summary, simulated=simulated)


def show_failure(command: str, errors: Sequence[BaseException], outcomes: Sequence[Outcome]) -> None:
    """Print, as one JSON object, what ended a command (the first error gives the exit status) and what was made.

    Whether that is simulated is unknown (null) where nothing was made.
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
    """How many files were made, and how many needed not be."""
    made = sum(outcome.made for outcome in outcomes)
    return {"made": made, "up_to_date": len(outcomes) - made}


def _print_json(result: dict[str, Any]) -> None:
    print(json.dumps(plain(result), allow_nan=False))


def print_table(title: str, rows: list[dict[str, Any]], summary: dict[str, Any], *, simulated: bool) -> None:
    """Print rows as a table; figures from simulation say so."""
    from rich.console import Console

    # What is printed is text, not markup: a path may hold [brackets] or :colons:.
    console = Console(soft_wrap=not sys.stdout.isatty(), markup=False, emoji=False)
    heading = _in_a_line(title) + (" (simulated)" if simulated else "")
    for _, group in itertools.groupby(rows, key=tuple):  # rows of other columns are a table of their own
        for table in _tables(heading, list(group), console.width):
            console.print(table)
    for name, value in summary.items():
        console.print(f"{_in_a_line(name)}: {format_value(value)}", highlight=False, soft_wrap=True)


def _tables(title: str, rows: list[dict[str, Any]], width: int) -> Iterator[Any]:
    """Rows of the same columns as a table.

    Where that is too wide, a few rows get a line for every figure, and many get several tables, each with the columns
    that name a row.
    """
    from rich.table import Table

    names = list(map(_in_a_line, rows[0]))
    cells = [[format_value(value) for value in row.values()] for row in rows]
    widths = [3 + max(map(len, column)) for column in zip(names, *cells, strict=True)]
    if len(rows) <= FEW_ROWS and 1 + sum(widths) > width:
        table = Table(title=title, title_justify="left", show_header=False)
        for _ in range(1 + len(rows)):
            table.add_column(overflow="fold")
        for line in zip(names, *cells, strict=True):
            table.add_row(*line)
        yield table
        return
    for columns in _side_by_side(widths, _naming(rows), width):
        table = Table(title=title, title_justify="left")
        for column in columns:
            numeric = all(isinstance(list(row.values())[column], (int, float, type(None))) for row in rows)
            table.add_column(names[column], justify="right" if numeric else "left", overflow="fold")
        for values in cells:
            table.add_row(*(values[column] for column in columns))
        yield table
        title = ""


def _naming(rows: list[dict[str, Any]]) -> list[int]:
    """The leading columns that tell one row from another: the first, and the next ones for as long as that takes."""
    values = [tuple(map(str, row.values())) for row in rows]
    for count in range(1, MOST_NAMING):
        if len({value[:count] for value in values}) == len(values):
            return list(range(count))
    return list(range(min(MOST_NAMING, len(rows[0]))))


def _side_by_side(widths: list[int], naming: list[int], width: int) -> Iterator[list[int]]:
    """Columns of each table, so that every one fits; one that is too wide for that is alone with those that name."""
    columns = list(naming)
    for column in range(len(naming), len(widths)):
        if len(columns) > len(naming) and 1 + sum(widths[other] for other in [*columns, column]) > width:
            yield columns
            columns = list(naming)
        columns.append(column)
    yield columns


def print_result(verdict: Sequence[str], made: Sequence[Path]) -> None:
    """Below a table: what its figures amount to, then the files that were made, as they can be pasted."""
    for line in verdict:
        print_text(line)
    written = [path for path in made if path.exists()]
    folders = sorted({path.parent for path in written})
    if len(written) <= MOST_PASTED:
        words = [shlex.quote(str(path)) for path in written]
    else:
        words = [shlex.quote(str(folder)) for folder in folders]  # a folder stands for its files
    if words:
        print_text(" ".join(words))


def format_value(value: Any) -> str:
    """A cell, of one line: numbers to four digits, large ones whole, nothing for None, yes and no for truth values."""
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
    """JSON has no NaN: a figure that does not exist is null."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
