"""Common parts of the pages of view and report: colours, axes of charts, text, and writing of a page.

A page is one HTML file that loads nothing: it contains the style (data/page.css), Bokeh's script and all data. Text
from files is escaped, also on the axes of charts, which Bokeh draws as text and never as HTML.
"""

import html
import json
import re
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


def check_libraries(names: Iterable[str]) -> None:
    """Raise MissingLibrary, before any work is done, if a library for drawing is missing."""
    for name in names:
        if find_spec(name) is None:
            raise missing_extra(f"{name}, needed to draw the page, is not installed", "plot")


# Where a page goes ----------------------------------------------------------------------------------------------------


def page_path(folder: Path, name: str, out: Path | None) -> Path:
    """Return `folder/name`; if `out` is given, the path in the folder `out`, or the file `out`."""
    if out is None:
        return folder / name
    if out.is_dir() or not out.suffix:
        return out / name
    return with_suffix(out, Path(name).suffix, "--out")


def with_suffix(path: Path, suffix: str, flag: str) -> Path:
    """Return the path; raise InputError if it has another suffix."""
    if path.suffix.lower() != suffix:
        raise InputError(
            "wrong kind of output", where=flag, expected=f"a file name ending in {suffix}", found=str(path)
        )
    return path


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


def badges(values: Iterable[tuple[str, Any]], *, simulated: bool) -> str:
    """Return a badge with name and value for each value that is not None; `simulated` comes first."""
    marks = '<span class="badge simulated">simulated</span>' if simulated else ""
    return marks + "".join(
        f'<span class="badge">{name} <b>{short(value)}</b></span>' for name, value in values if value is not None
    )


# Charts ---------------------------------------------------------------------------------------------------------------


def shown_colour(colour: str) -> str:
    """Return a colour as charts draw it: ink would be invisible on one of a page's two backgrounds."""
    return NEUTRAL if colour == INK else colour


def bare_figure(**more: Any) -> Any:
    """Return a figure of the page's width, without frame and tools, in the page's colours."""
    from bokeh.plotting import figure

    chart = figure(
        **{
            "sizing_mode": "stretch_width",
            "toolbar_location": None,
            "tools": [],
            "min_border_left": 58,
            "min_border_right": 14,
            "min_border_top": 4,
            "min_border_bottom": 4,
            "background_fill_alpha": 0,
            "border_fill_alpha": 0,
            "outline_line_color": None,
            **more,
        }
    )
    for axis in (*chart.xaxis, *chart.yaxis):
        axis.axis_line_color = NEUTRAL
        axis.major_tick_line_color = NEUTRAL
        axis.minor_tick_line_color = None
        axis.major_label_text_color = NEUTRAL
        axis.axis_label_text_color = NEUTRAL
        axis.axis_label_text_font_style = "normal"
    chart.grid.grid_line_color = NEUTRAL
    chart.grid.grid_line_alpha = 0.22
    return chart


def embed(figures: Iterable[Any]) -> tuple[str, str, list[str]]:
    """Return Bokeh's script for these figures, its library, and the HTML that contains each figure."""
    from bokeh.embed import components
    from bokeh.resources import Resources

    all_figures = tuple(figures)
    if not all_figures:
        return "", "", []
    script, places = components(all_figures)
    return script, Resources(mode="inline", components=["bokeh"]).render_js(), list(places)
