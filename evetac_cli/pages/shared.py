"""Common parts of the pages of view and report: colours, text, tables, and writing of a page.

A page is one HTML file that loads nothing: it contains the style (data/page.css) and all data. Text from files is
escaped.
"""

import html
import json
import math
import re
from base64 import b64encode
from collections.abc import Iterable, Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from evetac_cli.errors import EvetacError, InputError, missing_extra
from evetac_cli.resources import DATA
from evetac_cli.store.hdf5.disk import check_free, taking_the_place_of

INK, BLUE, ORANGE, GREEN, PINK = "ink", "#2f82c4", "#d55e00", "#009e73", "#cc79a7"  # distinct to the colour-blind
NEUTRAL = "#7f8790"  # replaces INK in charts: legible on white and on black
UNKNOWN = "#9aa1a9"
LARGEST_BYTES = 20_000_000
LONGEST_TEXT = 300
ADAPTED, KNOWN, NOT_KNOWN = "adapted with known forces", "known", "not known"


def check_libraries(names: Iterable[str]) -> None:
    """Raise MissingLibrary, before any work is done, if a library for drawing is missing."""
    for name in names:
        if find_spec(name) is None:
            raise missing_extra(f"{name}, needed to draw the page, is not installed", "plot")


# Where a page goes ----------------------------------------------------------------------------------------------------


def page_path(folder: Path, name: str, out: Path | None) -> Path:
    """Return `folder/name`; if `out` is given, the path in the folder `out`, or the file `out`, which is HTML."""
    if out is None:
        return folder / name
    if out.is_dir() or not out.suffix:
        return out / name
    if out.suffix.lower() != ".html":
        expected = "a file name ending in .html"
        raise InputError("wrong kind of output", where="--out", expected=expected, found=str(out))
    return out


def write_page(path: Path, content: bytes, *, force: bool) -> None:
    """Write next to the target, then rename, so that no partial page is ever left; InputError as for `check_free`."""
    with taking_the_place_of(path, check=partial(check_free, path, force=force)) as temporary:
        temporary.write_bytes(content)


# Text -----------------------------------------------------------------------------------------------------------------


def fill(template: Path, parts: Mapping[str, str], where: Path, hint: str) -> bytes:
    """Return the page: a template with its @@MARKS@@ and the common style filled in; raise EvetacError above 20 MB."""
    parts = {"STYLE": (DATA / "page.css").read_text(encoding="utf-8"), **parts}
    # A single pass, so that a file name that looks like a mark is not replaced.
    text = re.sub("@@([A-Z]+)@@", lambda mark: parts[mark[1]], template.read_text(encoding="utf-8"))
    done = text.encode("utf-8", "replace")
    if len(done) > LARGEST_BYTES:
        raise EvetacError(
            "the page would be too large",
            where=str(where),
            expected=f"at most {LARGEST_BYTES / 1e6:g} MB",
            found=f"{len(done) / 1e6:.1f} MB",
            hint=hint,
        )
    return done


def for_script(value: Any) -> str:
    """Return JSON that is safe inside a script element: nothing in it can end the element or begin a comment."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def short(value: Any) -> str:
    """Return any value as escaped text, truncated if it is long."""
    text = value if isinstance(value, str) else json.dumps(value)
    return html.escape(text if len(text) <= LONGEST_TEXT else text[:LONGEST_TEXT] + "...")


def image(png: bytes, attributes: str) -> str:
    """Return an image element with its data."""
    return f"<img {attributes} src='data:image/png;base64,{b64encode(png).decode()}'>"


def badges(values: Iterable[tuple[str, Any]], *, simulated: bool) -> str:
    """Return a badge with name and value for each value that is not None; `simulated` comes first."""
    marks = '<span class="badge simulated">simulated</span>' if simulated else ""
    return marks + "".join(
        f'<span class="badge">{name} <b>{short(value)}</b></span>' for name, value in values if value is not None
    )


def shown_colour(colour: str) -> str:
    """Return a colour as charts draw it: ink would be invisible on one of a page's two backgrounds."""
    return NEUTRAL if colour == INK else colour


def inner(table: Any, *names: str) -> Any:
    """Return a value inside nested tables of a header, which may contain anything; None if there is none."""
    for name in names:
        table = table.get(name) if isinstance(table, Mapping) else None
    return table


def stiffness(header: Mapping[str, Any]) -> str:
    """Return ADAPTED, KNOWN or NOT_KNOWN: how well the stiffness that scales the forces of a touch file is known."""
    if any(inner(ancestor, "kind") == "force-model" for ancestor in header["history"].values()):
        return ADAPTED  # the only kind of model used for touch maps
    return NOT_KNOWN if inner(header, "parameters", "known", "shear_modulus_pa") is None else KNOWN


# Tables ---------------------------------------------------------------------------------------------------------------


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
