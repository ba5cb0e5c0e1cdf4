"""HTML tables of the report: cells with their values; a click on a heading sorts by its column."""

import math
from collections.abc import Iterable
from typing import Any

from evetac_cli.pages.shared import short


def figure_text(value: Any) -> str:
    """Return a value as the text of a cell: numbers to three digits, a dash for None."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        if math.isinf(value):
            return "never"
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else short(str(value))


def cell(value: Any, beside: str = "", text: str = "") -> str:
    """Return a cell that is sorted by its value; text: overrides `figure_text`."""
    numeric = isinstance(value, (int, float)) and not isinstance(value, bool)
    by = f" data-v='{float(value)!r}'" if numeric and math.isfinite(value) else " data-v='1e99'" if numeric else ""
    return f"<td{by}{' class=n' if numeric else ''}>{text or figure_text(value)}{beside}</td>"


def table(heads: Iterable[str], rows: Iterable[str], name: str = "") -> str:
    """Return a table whose columns are sorted by a click on their headings; heads and rows are HTML."""
    buttons = "".join(f"<th scope='col'><button type='button'>{head}</button></th>" for head in heads)
    id_ = f" id='{name}'" if name else ""
    body = "".join(rows)
    rows_ = f"<thead><tr>{buttons}</tr></thead><tbody>{body}</tbody>"
    return f"<div class='scroll'><table class='sorted'{id_}>{rows_}</table></div>"
