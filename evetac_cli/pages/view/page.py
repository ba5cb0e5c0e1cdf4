"""The page of view: one HTML file that needs no network.

Time series are drawn by Bokeh, whose script is included in the page (1.3 MB). The event images and the dots over them
are drawn by the small script in page.html. This module escapes and places text from files: Bokeh only gets numbers.
"""

import html
from base64 import b64encode
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICES_PER_S
from evetac_cli.pages import shared
from evetac_cli.pages.shared import NEUTRAL, UNKNOWN, inner, shown_colour
from evetac_cli.pages.view.gripper import outcome_badges
from evetac_cli.pages.view.trial_files import OpenTrial
from evetac_cli.pages.view.view_data import Lane, Panel, ViewData
from evetac_cli.resources import DATA, PACKAGE
from evetac_cli.store.recordings.onset import LabelledOnset

LOW_PX, TALL_PX, FEW_PANELS = 104, 180, 3  # height of a chart; taller if there are few
AXIS_PX = 24  # for the times below it
LOOKS = {  # of charts, by class of Bokeh
    "Plot": {
        **{f"min_border_{side}": px for side, px in {"left": 58, "right": 14, "top": 4, "bottom": 4}.items()},
        "background_fill_alpha": 0,
        "border_fill_alpha": 0,
        "outline_line_color": None,
    },
    "Axis": {
        **{f"{part}_color": NEUTRAL for part in ("axis_line", "major_tick_line", "major_label_text")},
        "minor_tick_line_color": None,
    },
    "Grid": {"grid_line_color": NEUTRAL, "grid_line_alpha": 0.22},
}


def render_page(trial: OpenTrial, view: ViewData) -> bytes:
    """Return the whole page; raise EvetacError if it would exceed 20 MB."""
    script, library, charts = _charts(view)
    title = trial.files[0].path.name
    width, height = view.frame_px
    parts = {
        "TITLE": html.escape(title),
        "ASPECT": f"{max(width, 1) / max(height, 1):.3f}",
        "HEADING": _heading(trial, title, view.simulated),
        "VIEWER": "" if len(view.frame_times) else "hidden",
        "SIDE": "" if view.side is not None else "hidden",
        "TOUCH": "" if view.touch is not None else "hidden",
        "MADE": "<span class='badge simulated'>simulated</span>" if view.simulated else "",
        "CAMERAS": _cameras(view),
        "EMPTY": _empty(view),
        "ONSETS": _onsets(view),
        "CHARTS": charts,
        "NOTES": "".join(f"<li>{html.escape(note)}</li>" for note in _notes(view)),
        "FILES": _files(trial),
        "DATA": shared.for_script(_data(view)),
        "DRAWING": "" if view.touch is None else (DATA / "touch_map.js").read_text(encoding="utf-8"),
        "LIBRARY": library,
        "SCRIPT": script,
    }
    template = PACKAGE / "pages" / "view" / "page.html"
    hint = "use fewer --images, or a part with --start-s and --stop-s"
    return shared.fill(template, parts, trial.files[0].path, hint)


def _base64(array: NDArray[Any] | None) -> str | None:
    """Return little-endian float32 (or bytes) for the page's script; None for None."""
    if array is None:
        return None
    kind = "<u1" if array.dtype.kind in "ub" else "<f4"
    return b64encode(np.ascontiguousarray(array, kind).tobytes()).decode()


def _data(view: ViewData) -> dict[str, Any]:
    return {
        "span": [at / SLICES_PER_S for at in view.span],
        "shown_ms": view.shown_ms,
        "frame": list(view.frame_px),
        "window": view.window_px,
        "frame_times": view.frame_times.tolist(),
        "pictures": [b64encode(png).decode() for png in view.pictures],
        "events": view.events,
        "dots": 0 if view.rest_xy_px is None else len(view.rest_xy_px),
        "rest": _base64(view.rest_xy_px),
        "tracked": _base64(view.dot_xy_px),
        "lost": _base64(view.lost),
        "true_dots": 0 if view.true_xy_px is None else view.true_xy_px.shape[1],
        "true": _base64(view.true_xy_px),
        "onsets": {source: slice_ for source, slice_ in view.onsets.items() if slice_ is not None},
        "opens_at": view.opens_at,
        "cameras": [
            {"shown": camera.shown, "images": [b64encode(jpeg).decode() for jpeg in camera.images]}
            for camera in view.cameras
        ],
        "side": _encoded(view.side),
        "touch": _encoded(view.touch),
    }


def _encoded(values: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return values with their arrays as the page's script reads them; None for None."""
    if values is None:
        return None
    return {name: _base64(value) if isinstance(value, np.ndarray) else value for name, value in values.items()}


# Text -----------------------------------------------------------------------------------------------------------------


def _heading(trial: OpenTrial, title: str, simulated: bool) -> str:
    parameters = trial.recording_parameters
    values = [
        ("scene", inner(parameters, "scene", "name")),
        ("object", inner(parameters, "object")),
        ("object's material", inner(parameters, "object_row", "material")),
        ("controller", inner(parameters, "controller")),
        *outcome_badges(trial),
        ("imported from", inner(parameters, "source")),
        ("sensor", inner(parameters, "sensor")),
    ]
    badges = shared.badges(values, simulated=simulated)
    summary = inner(parameters, "scene", "summary")
    lead = f'<p class="lead">{shared.short(summary)}</p>' if isinstance(summary, str) else ""
    id_ = f'<p class="id">recording <code>{html.escape(trial.recording_id)}</code></p>'
    return f"<h1>{html.escape(title)}</h1><div>{badges}</div>{lead}{id_}"


def _cameras(view: ViewData) -> str:
    """Return a figure element for the images of each other camera of the trial."""
    return "".join(
        f"<figure><img data-camera='{at}' alt='Image of {html.escape(camera.name)}'>"
        f"<figcaption>{html.escape(camera.name)}</figcaption></figure>"
        for at, camera in enumerate(view.cameras)
    )


def _files(trial: OpenTrial) -> str:
    rows = []
    for file in trial.files:
        parameters = file.header["parameters"]
        shown = ", ".join(
            f"{html.escape(str(name))} {shared.short(value)}"
            for name, value in parameters.items()
            if not isinstance(value, (dict, list))
        )
        rows.append(
            f"<tr><td class='word'>{file.kind}</td><td>{html.escape(file.path.name)}</td>"
            f"<td><code title='{html.escape(file.header['id'])}'>{html.escape(file.header['id'][:12])}</code></td>"
            f"<td>{shown}</td></tr>"
        )
    return "".join(rows)


def _empty(view: ViewData) -> str:
    """Return a sentence in place of images and series if there is nothing to draw."""
    if view.slices == 0:
        return "<p class='empty'>This recording is empty: it has no slices.</p>"
    if view.pictures and not any(view.events) and view.panels and (view.panels[0].lines[0].value <= 1).all():
        return "<p class='empty'>There are no events in the shown part.</p>"
    return ""


def _onsets(view: ViewData) -> str:
    """Return the first slip by truth, label and model, and the differences."""
    if not view.onsets:
        return ""
    reference = next((slice_ for slice_ in view.onsets.values() if slice_ is not None), None)
    cells = []
    for source, slice_ in view.onsets.items():
        simulated = " <small>(gross slip, simulated)</small>" if source == "truth" else ""
        if slice_ is None or reference is None:
            cells.append(f"<span>{source}{simulated} <b>none</b></span>")
            continue
        away = slice_ - reference
        beside = [f"{away:+d} ms"] if away else []
        if source == "label" and view.labelled is not None:
            beside += _sure(view.labelled)
        later = f" <small>{', '.join(beside)}</small>" if beside else ""
        cells.append(
            f"<button type='button' class='jump' data-ms='{slice_}'>{source}{simulated} "
            f"<b>{slice_ / SLICES_PER_S:.3f} s</b>{later}</button>"
        )
    since = f" after {view.span[0] / SLICES_PER_S:.3f} s" if view.span[0] else ""
    return f"<div class='onsets'><h2>First slip{since}</h2>" + "".join(cells) + "</div>"


def _sure(labelled: LabelledOnset) -> list[str]:
    """Return how certain labels are of their onset: its interval, and their confidence."""
    words = ["abstains"] if labelled.abstained else []
    if labelled.earliest is not None and labelled.latest is not None:
        words.append(f"within {labelled.earliest / SLICES_PER_S:.3f} to {labelled.latest / SLICES_PER_S:.3f} s")
    return words if labelled.confidence is None else [*words, f"confidence {labelled.confidence:.2g}"]


def _notes(view: ViewData) -> list[str]:
    start_s, stop_s = (at / SLICES_PER_S for at in view.span)
    notes = [f"Shown: {start_s:.3f} to {stop_s:.3f} s of {view.slices / SLICES_PER_S:.3f} s."]
    if len(view.frame_times):
        dense = ", ".join(f"{at / SLICES_PER_S:.3f} s ({why})" for why, at in view.dense.items())
        notes.append(
            f"{len(view.frame_times):,} images of {view.shown_ms} ms, evenly spaced"
            + (f" and, every 2 ms, around {dense}." if dense else ".")
        )
    notes.append("Series: every value, or the smallest and largest value in each of 3,000 time bins.")
    return notes + view.notes


# Series ---------------------------------------------------------------------------------------------------------------


def _charts(view: ViewData) -> tuple[str, str, str]:
    """Return Bokeh's script for this page, its library, and the HTML of the charts."""
    if not view.panels and not view.lanes:
        return "", "", ""
    from bokeh.embed import components
    from bokeh.models.ranges import Range1d
    from bokeh.resources import Resources
    from bokeh.themes import Theme

    start_s, stop_s = (at / SLICES_PER_S for at in view.span)
    x_range = Range1d(start=start_s, end=stop_s, bounds=(start_s, stop_s))
    figures, texts = [], []
    number = 0
    height = TALL_PX if len(view.panels) <= FEW_PANELS else LOW_PX
    for panel in view.panels:
        most = "" if panel.ends is None else f" data-most='{panel.ends[1]:g}'"
        keys = "".join(
            f"<span class='key {'band' if line.sd is not None else ''}' style='--colour:{shown_colour(line.colour)}'>"
            f"{line.name if len(panel.lines) > 1 else ''}"
            f" <output data-series='series{number + at}'{most}></output></span>"
            for at, line in enumerate(panel.lines)
        )
        keys += "".join(f"<span class='key level'>{name} {value:.3g}</span>" for name, value in panel.levels.items())
        caption = f"<p class='hint'>{html.escape(panel.caption)}</p>" if panel.caption else ""
        texts.append((_head(panel.title, panel.unit, panel.simulated, keys), caption))
        figures.append(_panel_figure(panel, x_range, number, height))
        number += len(panel.lines)
    for title, lanes in (("Slip", view.lanes), ("Phase of the grasp", view.phases)):
        if lanes:
            unknown = any(lane.unknown for lane in lanes)
            texts.append((_head(title, keys="<span class='key unknown'>not examined</span>" if unknown else ""), ""))
            figures.append(_lane_figure(lanes, x_range))
    script, places = components(tuple(figures), theme=Theme(json={"attrs": LOOKS}))
    charts = "".join(
        f"<section class='chart'>{head}{place}{caption}</section>"
        for (head, caption), place in zip(texts, places, strict=True)
    )
    return script, Resources(mode="inline", components=["bokeh"]).render_js(), charts


def _head(title: str, unit: str = "", simulated: bool = False, keys: str = "") -> str:
    unit = f" <small>{shared.short(unit)}</small>" if unit else ""
    mark = " <span class='badge simulated'>simulated</span>" if simulated else ""
    return f"<h2>{shared.short(title)}{unit}{mark}<span class='keys'>{keys}</span></h2>"


def _time_figure(x_range: Any, **more: Any) -> Any:
    """Return a figure with a time axis that zooms in time: drag, or Ctrl and the wheel."""
    from bokeh.models.annotations.geometry import Span
    from bokeh.models.formatters import PrintfTickFormatter
    from bokeh.models.tools import BoxZoomTool, WheelZoomTool
    from bokeh.plotting import figure

    drag, wheel = BoxZoomTool(dimensions="width"), WheelZoomTool(dimensions="width", modifiers={"ctrl": True})
    chart = figure(
        x_range=x_range, sizing_mode="stretch_width", toolbar_location=None, tools=[drag, wheel], active_drag=drag,
        active_scroll=wheel, **more,
    )  # fmt: skip
    chart.add_layout(
        Span(location=x_range.start, dimension="height", line_color="#e0a000", line_width=2, name="cursor")
    )
    chart.xaxis.formatter = PrintfTickFormatter(format="%.6g s")
    chart.xaxis.major_tick_in, chart.xaxis.major_tick_out, chart.xaxis.major_label_standoff = 0, 3, 2
    return chart


def _panel_figure(panel: Panel, x_range: Any, number: int, height: int) -> Any:
    """Return one axis with its series; their sources are named series0, series1, ... for the page's script."""
    from bokeh.models.sources import ColumnDataSource

    more = {} if panel.ends is None else {"y_range": panel.ends}
    kind = "log" if panel.logarithmic else "linear"
    chart = _time_figure(x_range, height=height + AXIS_PX, y_axis_type=kind, **more)
    if not panel.logarithmic:
        chart.yaxis.ticker.desired_num_ticks = 4
    for at, line in enumerate(panel.lines):
        colour = shown_colour(line.colour)
        columns: dict[str, Any] = {"t": line.t_s, "v": line.value.astype(np.float32)}
        if line.sd is not None:
            low, high = line.band
            columns |= {name: each.astype(np.float32) for name, each in (("sd", line.sd), ("low", low), ("high", high))}
        source = ColumnDataSource(columns, name=f"series{number + at}")
        if line.sd is not None:
            chart.varea("t", "low", "high", source=source, fill_color=colour, fill_alpha=0.2)
        if panel.marks:
            chart.scatter("t", "v", source=source, size=4, fill_color=colour, line_color=None)
        else:
            chart.line("t", "v", source=source, line_color=colour, line_width=1.4, line_join="round")
    for value in panel.levels.values():  # a line, not an annotation, so that the axis includes it
        ends = [x_range.start, x_range.end]
        chart.line(ends, [value, value], line_color=NEUTRAL, line_dash="dashed", line_width=1.2)
    return chart


def _lane_figure(lanes: list[Lane], x_range: Any) -> Any:
    """Return rows for truth, label and model: a bar where each reports slip, a thin bar where it did not examine."""
    chart = _time_figure(
        x_range, height=AXIS_PX + 10 + 26 * len(lanes), y_range=[lane.name for lane in reversed(lanes)]
    )
    chart.ygrid.visible = False
    for lane in lanes:
        for parts, colour, height in ((lane.unknown, UNKNOWN, 0.16), (lane.slip, shown_colour(lane.colour), 0.7)):
            left, right = np.array(parts).reshape(-1, 2).T
            # a line of 1 px, so that a slip of one millisecond is still visible
            chart.hbar([lane.name] * len(parts), height, right, left=left, fill_color=colour, line_color=colour)
    return chart
