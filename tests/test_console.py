"""What people see: one JSON object, a table of plain text, a bar on a terminal and nothing elsewhere."""

import ast
import io
import json
import math
import re
from typing import Any

import numpy as np
import pytest

from evetac_cli import console
from evetac_cli.resources import PACKAGE

ROWS: list[dict[str, Any]] = [
    {"file": "a.h5", "delay_ms": 1.25, "ok": True},
    {"file": "b.h5", "delay_ms": None, "more": 12345},
]


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def test_json_has_no_nan(capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that numbers that do not exist are null, however deep, and the rest stays as it is."""
    deep = {"a": [1, math.nan, (math.inf, {"b": -math.inf})], "c": np.float64("nan"), "d": True, "e": "NaN"}
    console.show("x", [deep], {"mean": math.nan}, simulated=True, as_json=True)
    result = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert result["rows"] == [{"a": [1, None, [None, {"b": None}]], "c": None, "d": True, "e": "NaN"}]
    assert result["summary"] == {"mean": None}


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "-"),
        (True, "yes"),
        (math.nan, "-"),
        (math.inf, "inf"),
        (0.123456, "0.1235"),
        (-667300.4, "-667,300"),
        (9999.6, "10,000"),
        (2e9, "2e+09"),
        (1234567, "1,234,567"),
        ("1234", "1234"),
    ],
)
def test_format_value(value: object, text: str) -> None:
    """Assert how each kind of value is written in a cell."""
    assert console.format_value(value) == text


def table(capsys: pytest.CaptureFixture[str], rows: list[dict[str, Any]], summary: dict[str, Any], **more: Any) -> str:
    """What is printed for people."""
    console.show("track", rows, summary, as_json=False, **{"simulated": False, **more})
    out, err = capsys.readouterr()
    assert err == ""
    return out


def test_table_shows_every_column(capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that rows with other names are a table of their own, and the summary stands below all."""
    text = table(capsys, ROWS, {"files": 2})
    lines = text.splitlines()
    assert sum("┏" in line for line in lines) == len({tuple(row) for row in ROWS}) > 1
    for name in ("file", "delay_ms", "ok", "more"):
        assert name in text
    assert "12,345" in text
    assert "yes" in text
    assert lines[-1] == "files: 2"


def test_wide_tables_are_split(capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that no line is wider than the terminal, no figure is lost, and each part says which rows it shows."""
    rows = [
        {"object": row, "seed": 0} | {f"figure_{column}": f"{row}-{column}" for column in range(20)} for row in range(5)
    ]
    console.print_table("wide", rows, {}, simulated=False)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    for row in range(5):
        shown = [
            line.split("│")[1:-1] for line in lines if line.startswith("│") and line.split("│")[1].strip() == str(row)
        ]
        assert len(shown) > 1
        figures = [cell.strip() for line in shown for cell in line if "-" in cell]
        assert figures == [f"{row}-{column}" for column in range(20)]


NAMES = ["runs[a]/b.h5", "[bold]x", "[/]", "a[/red].h5", "\\[x]", "x:smile:y", "[link=x]y[/link]", "100%", "{0}", "ä°"]


@pytest.mark.parametrize("name", NAMES)
def test_text_is_no_markup(capsys: pytest.CaptureFixture[str], name: str) -> None:
    """Assert that brackets and colons in names are printed as they are, in cells, headings and the summary."""
    text = table(capsys, [{"file": name, name: "z"}], {"report": name, name: 1})
    assert text.count(name) == 4


@pytest.mark.parametrize(("quiet", "stream"), [(True, Terminal()), (False, io.StringIO()), (True, io.StringIO())])
def test_no_bar_where_nobody_looks(monkeypatch: pytest.MonkeyPatch, quiet: bool, stream: io.StringIO) -> None:
    """Assert that without a terminal, or with --quiet, progress prints nothing."""
    monkeypatch.setattr("sys.stderr", stream)
    with console.progress_bar("track", "slices", quiet=quiet) as progress:
        progress(1, 2)
    assert stream.getvalue() == ""


def test_bar_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a bar shows what is done and of how much, also before the first step, and names are no markup."""
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("TERM", "xterm")
    with console.progress_bar("track runs[a].h5", "slices", quiet=False) as progress:
        progress(0, 0)
        progress(5, 10)
        progress(10, 10)
    assert "track runs[a].h5" in terminal.getvalue()
    assert "10/10 slices" in terminal.getvalue()


@pytest.mark.parametrize("name", ["label lift.h5", "label 3 of 40: " + "x" * 100 + ".labels.h5"])
def test_bar_fits_a_line_of_80_signs(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Assert that no line is wider than the terminal, that count and total are whole, and that it says what it does."""
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    with console.progress_bar(name, "slices", quiet=False) as progress:
        progress(3, 40, "files read")
        progress(0, 0, "loading torch")
        for done in range(0, 1_000_000, 100_000):
            progress(done, 1_000_000)
        progress(1_000_000, 1_000_000)
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", terminal.getvalue())
    lines = [line.rstrip() for line in re.split(r"[\r\n]", shown)]
    assert max(map(len, lines)) <= 80
    assert "1,000,000/1,000,000 slices" in shown
    assert "━ loading torch" in shown and "/40 loading" not in shown
    assert all(line.startswith(name[:11]) for line in lines if line)


NASTY = "\x1b[31mred\x9b2J\u202egnp\r\udcff"
SHOWN = "\\x1b[31mred\\x9b2J\\u202egnp\\r\\udcff"


def test_no_control_character_reaches_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that headings, names of columns, cells and the summary have control characters spelt out."""
    console.show(NASTY, [{"file": NASTY, NASTY: "a\nb"}], {NASTY: NASTY}, simulated=False, as_json=False)
    out = capsys.readouterr().out
    assert out.count(SHOWN) == 5
    assert "a\\nb" in out
    assert not any(raw in out for raw in NASTY if not raw.isprintable())


def test_no_control_character_reaches_messages(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that messages and the lines of a result keep their lines, and have the rest spelt out."""
    console.say(f"a\n{NASTY}\tb")
    console.print_text(f"a\n{NASTY}\tb")
    assert capsys.readouterr() == (f"a\n{SHOWN}\tb\n", f"a\n{SHOWN}\tb\n")


def test_no_control_character_reaches_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that names beside a bar are spelt out; the bar's own codes are there."""
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("TERM", "xterm")
    with console.progress_bar(NASTY, "slices", quiet=False) as progress:
        progress(1, 2)
    shown = terminal.getvalue()
    assert SHOWN in shown
    assert "\x1b[31mred" not in shown and "\u202e" not in shown and "\x9b" not in shown


def test_only_console_prints() -> None:
    """Assert that every line goes through console, which spells control characters out; udev rules are ours alone."""
    printing = {
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        if re.search(r"\bprint\b", text := path.read_text())
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "print"
    }
    assert printing == {"console.py", "cli/main.py"}


def test_columns_that_say_nothing_are_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that a column without a value in any row, and such a line below, is printed with -v alone; zeros stay."""
    rows = [{"page": "a.html", "film": None, "lost": 0, "late": math.nan, "kept": value} for value in (None, 1.5)]
    summary = {"files": 2, "notes": None}
    short, whole = table(capsys, rows, summary), table(capsys, rows, summary, verbose=True)
    for name in ("page", "lost", "kept", "files: 2"):
        assert name in short and name in whole
    for name in ("film", "late", "notes: -"):
        assert name not in short
        assert name in whole


def test_the_column_that_names_rows_stays(capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that rows without any value are a table of their first column, and not an error."""
    text = table(capsys, [{"file": None, "kind": None}], {})
    assert "file" in text
    assert "kind" not in text


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_few_rows_that_are_too_wide_stand_on_their_side(capsys: pytest.CaptureFixture[str], count: int) -> None:
    """Assert that up to three rows of many short figures are one table with a line for each figure, not several."""
    rows = [{f"a_rather_long_name_{column}": column + row for column in range(12)} for row in range(count)]
    text = table(capsys, rows, {})
    assert sum(line.startswith(("┏", "┌")) for line in text.splitlines()) == 1
    assert text.count("│ a_rather_long_name_") == 12
