"""What people see: progress on stderr while it lasts, one table or one JSON object on stdout at the end."""

import json
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from evetac_cli.stages import Progress, silent


FEW_ROWS = 3


def say(text: str) -> None:
    """A message to the user, on stderr."""
    print(text, file=sys.stderr)


@contextmanager
def progress_bar(what: str, unit: str, *, quiet: bool) -> Iterator[Progress]:
    """A bar with rate and time left, if stderr is a terminal; otherwise nothing."""
    if quiet or not sys.stderr.isatty():
        yield silent
        return
    from rich.console import Console
    from rich.progress import BarColumn, ProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar
    from rich.text import Text

    class Count(ProgressColumn):
        """Done of all, once it is known how many that are."""

        def render(self, task: Any) -> Text:
            return Text(f"{task.completed:.0f}/{task.total:.0f} {unit}" if task.total is not None else "")

    class Rate(ProgressColumn):
        """Units a second."""

        def render(self, task: Any) -> Text:
            return Text(f"{task.speed:.3g} {unit}/s" if task.speed else "")

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        Count(),
        Rate(),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)

        def advance(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        yield advance


def show(command: str, rows: list[dict[str, Any]], summary: dict[str, Any], *, simulated: bool, as_json: bool) -> None:
    """Print the result of a command: one JSON object, or a table with the summary below."""
    if as_json:
        result = {"command": command, "simulated": simulated, "rows": rows, "summary": summary}
        print(json.dumps(plain(result), allow_nan=False))
        return
    print_table(command, rows, summary, simulated=simulated)


def print_table(title: str, rows: list[dict[str, Any]], summary: dict[str, Any], *, simulated: bool) -> None:
    """Print rows as a table; figures from simulation say so."""
    from rich.console import Console
    from rich.table import Table

    # What is printed is text, not markup: a path may hold [brackets] or :colons:.
    console = Console(soft_wrap=not sys.stdout.isatty(), markup=False, emoji=False)
    if rows:
        names = list(dict.fromkeys(name for row in rows for name in row))
        cells = [[format_value(row.get(name)) for name in names] for row in rows]
        table = Table(title=title + (" (simulated)" if simulated else ""), title_justify="left")
        widths = [max(map(len, column)) for column in zip(names, *cells, strict=True)]
        if len(rows) <= FEW_ROWS and sum(widths) + 3 * len(names) > console.width:  # too wide: one line a figure
            table.show_header = False
            for _ in range(1 + len(rows)):
                table.add_column(overflow="fold")
            for column in zip(names, *cells, strict=True):
                table.add_row(*column)
        else:
            for name in names:
                numeric = all(isinstance(row.get(name), (int, float, type(None))) for row in rows)
                table.add_column(name, justify="right" if numeric else "left", overflow="fold")
            for line in cells:
                table.add_row(*line)
        console.print(table)
    for name, value in summary.items():
        console.print(f"{name}: {format_value(value)}", highlight=False, soft_wrap=True)


def format_value(value: Any) -> str:
    """A cell: numbers to four digits, nothing for None, yes and no for truth values."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.4g}"
    if isinstance(value, int):
        return f"{value:,}"
    return str(value)


def plain(value: Any) -> Any:
    """JSON has no NaN: a figure that does not exist is null."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
