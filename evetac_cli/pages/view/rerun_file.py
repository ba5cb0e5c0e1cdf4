"""The file that `view --rrd` writes for the viewer rerun: a trial on one timeline, and a layout of its views.

    gel/events            points of each slice; class 1 brighter, 0 darker
    gel/dots              points of each slice, class 1 if the tracker lost the dot
    gel/displacement      arrows from the dots' rest positions to the dots
    gel/true_dots         points of each slice, known exactly in a simulation
    touch/pressure        each touch map as colours, one pixel per cell; `about` states the end of the scale
    touch/shear, centre   arrows of shear in its cells, and the centre of pressure
    images/events         the event images of the page; cameras/NAME those of other cameras
    series/NN_PANEL/LINE  the series of the page: events, gripper, forces, displacement, flow, slip probability;
                          an estimate also has the lines minus and plus its standard deviation
    slip/SOURCE, phase    when each source reports slip; the phases of a grasp
    about                 what is simulated, found and thinned, in words

The timeline `t` counts from the start of the recording; the data of a slice are at its start. Whole columns are sent,
block by block. The size of a file is limited: above MOST_EVENTS only every nth event is included, above MOST_DOTS only
the dots of every nth slice; above MOST_ROWS several slices share a row. `about` states this.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, needs_extra
from evetac_cli.events import SLICE_US, SLICES_PER_S
from evetac_cli.jobs import Progress
from evetac_cli.pages.shared import BLUE, GREEN, INK, ORANGE, PINK, shown_colour
from evetac_cli.pages.view.trial_files import OpenTrial
from evetac_cli.pages.view.view_data import Lane, Panel, TouchView, ViewData
from evetac_cli.store.files import StageFile
from evetac_cli.store.hdf5.disk import utf8_path
from evetac_cli.store.recordings.read import BLOCK_SLICES, Recording
from evetac_cli.text_files import as_utf8

TIMELINE = "t"
MOST_EVENTS = 4_000_000
MOST_ROWS = 200_000  # of events
MOST_DOTS = 1_000_000  # dots times slices
EVENT_COLOURS = {"darker": BLUE, "brighter": ORANGE}
DOT_COLOURS = {"dot": "#ffb52e", "lost": PINK}
TRUE_COLOURS = {"true place (simulated)": GREEN}
DOT_RADIUS_PX, TRUE_RADIUS_PX = 3.0, 5.0
ARROWS = "#ffffff"
PALE = 128  # alpha of 255: lines at plus and minus one standard deviation
BEHIND = 29.0  # draw order of true positions; rerun draws points at 30


def load_rerun() -> Any:
    """Return the module rerun; raise MissingLibrary if it is not installed."""
    with needs_extra("rerun, needed to write the file, is not installed", "view", ""):
        import rerun
    return rerun


def write_rrd(trial: OpenTrial, view: ViewData, path: Path, progress: Progress) -> None:
    """Write the file; raise InputError if it is incomplete, for example because the disk is full."""
    rr = load_rerun()
    start, stop = view.span
    file = _File(rr, f"{trial.recording_id}-{start}-{stop}")
    title = as_utf8(trial.files[0].path.name)
    with utf8_path(path) as plain:
        file.stream.save(plain, default_blueprint=_blueprint(rr.blueprint, trial, view))
        file.stream.send_recording_name(f"{title} (simulated)" if view.simulated else title)
        notes = []
        if trial.recording is not None:
            notes += file.events(trial.recording, view.span, progress)
            if trial.recording.has("truth/dot_xy_px"):
                notes += file.dots("true_dots", trial.recording, "truth/dot_xy_px", view.span, None)
        if trial.tracks is not None:
            notes += file.dots("dots", trial.tracks, "dot_xy_px", view.span, view.rest_xy_px)
        file.images(view)
        if view.touch is not None:
            file.touch(view, view.touch)
        file.series(view)
        for lane in view.lanes:
            file.states(f"slip/{_name(lane.name)}", [lane], start / SLICES_PER_S, ["slip"])
        if view.phases:
            file.states("phase", view.phases, start / SLICES_PER_S, [lane.name for lane in view.phases])
        file.static("about", rr.TextDocument(_about(title, trial, view, notes), media_type="text/markdown"))
        file.stream.flush()
        file.stream.disconnect()
        try:  # rerun reports a full disk only in its log
            rr.chunk.RrdReader(plain).store()
        except Exception as error:
            found = (str(error).splitlines() or [type(error).__name__])[0][:200]
            raise InputError("the file is not complete", where=str(path), found=found, hint="disk full?") from None


class _File:
    """Writer for the parts of a trial, each under its own path."""

    def __init__(self, rr: Any, recording_id: str) -> None:
        self._rr = rr
        self.stream = rr.RecordingStream("evetac", recording_id=recording_id, send_properties=False)

    def static(self, path: str, content: Any) -> None:
        """Log content that is valid at all times."""
        self.stream.log(path, content, static=True)

    def _columns(self, path: str, t_us: NDArray[Any], columns: Any) -> None:
        times = self._rr.TimeColumn(TIMELINE, duration=t_us.astype("timedelta64[us]"))
        self.stream.send_columns(path, [times], columns, strict=True)

    def _classes(self, path: str, colours: dict[str, str]) -> None:
        classes = [(number, name, _rgb(colour)) for number, (name, colour) in enumerate(colours.items())]
        self.static(path, self._rr.AnnotationContext(classes))

    def events(self, recording: Recording, span: tuple[int, int], progress: Progress) -> list[str]:
        """Write a row of points for every slice, even without events; return notes on thinning."""
        start, stop = span
        first, last = (int(recording.starts[at]) for at in span)
        every, step = max(1, -(-(last - first) // MOST_EVENTS)), max(1, -(-(stop - start) // MOST_ROWS))
        self._classes("gel/events", EVENT_COLOURS)
        for block in recording.blocks(step * max(1, BLOCK_SLICES // step), start, stop):
            begin, end, events = block.first, block.stop, block.events
            rows = np.arange(begin, end, step)
            kept = slice(-int(recording.starts[begin]) % every, None, every)
            lengths = np.diff(-(-recording.starts[np.append(rows, end)] // every))
            places = np.stack((events.x[kept], events.y[kept]), axis=1).astype(np.float32)
            columns = self._rr.Points2D.columns(positions=places, class_ids=events.p[kept].astype(np.uint16))
            self._columns("gel/events", rows * SLICE_US, columns.partition(lengths))
            progress(int(recording.starts[end]) - first, last - first, "events")
        thinned = [f"Of {last - first:,} events one in {every} is shown."] if every > 1 else []
        return thinned + ([f"Events are shown {step} ms at a time."] if step > 1 else [])

    def dots(
        self, name: str, file: StageFile, path: str, span: tuple[int, int], rest: NDArray[np.float64] | None
    ) -> list[str]:
        """Write a row of points per slice and, for tracked dots, of arrows from rest; without unknown positions."""
        rr, start = self._rr, span[0]
        stop = min(span[1], file.length(path))
        dots = file.contents()[path][1][1]
        every = max(1, -(-(stop - start) * dots // MOST_DOTS))
        tracked = rest is not None
        self._classes(f"gel/{name}", DOT_COLOURS if tracked else TRUE_COLOURS)
        shape = {"radii": [DOT_RADIUS_PX]} if tracked else {"radii": [TRUE_RADIUS_PX], "draw_order": BEHIND}
        self.static(f"gel/{name}", rr.Points2D.from_fields(**shape))
        for begin in range(start, stop, BLOCK_SLICES):
            end = min(begin + BLOCK_SLICES, stop)
            shown = np.arange(-(begin - start) % every, end - begin, every)
            if not len(shown):
                continue
            places = file.read(path, begin, end)[shown].astype(np.float32)
            is_known = np.isfinite(places).all(axis=2)
            lengths, t_us = is_known.sum(axis=1), (begin + shown) * SLICE_US
            lost = file.read("lost", begin, end)[shown] if tracked else np.zeros(is_known.shape, np.uint8)
            columns = rr.Points2D.columns(positions=places[is_known], class_ids=lost[is_known].astype(np.uint16))
            self._columns(f"gel/{name}", t_us, columns.partition(lengths))
            if rest is not None:
                is_known &= np.isfinite(rest).all(axis=1)
                origins = np.broadcast_to(rest.astype(np.float32), places.shape)[is_known]
                arrows = rr.Arrows2D.columns(vectors=places[is_known] - origins, origins=origins)
                self._columns("gel/displacement", t_us, arrows.partition(is_known.sum(axis=1)))
        return [f"Of `gel/{name}` one slice in {every} is shown."] if every > 1 else []

    def images(self, view: ViewData) -> None:
        """Write the event images, each at its first slice, and the camera images whenever they change."""
        if view.pictures:
            self._images("images/events", "image/png", view.frame_times, view.pictures)
        for camera in view.cameras:
            changes = np.flatnonzero(np.diff(camera.shown, prepend=-1))
            images = [camera.images[camera.shown[at]] for at in changes.tolist()]
            self._images(f"cameras/{_name(camera.name)}", "image/jpeg", view.frame_times[changes], images)

    def _images(self, path: str, media_type: str, at_ms: NDArray[np.int64], images: list[bytes]) -> None:
        if images:
            self.static(path, self._rr.EncodedImage.from_fields(media_type=media_type))
            self._columns(path, at_ms * SLICE_US, self._rr.EncodedImage.columns(blob=images))

    def touch(self, view: ViewData, touch: TouchView) -> None:
        """Write touch maps whenever they change, one pixel per cell, and the centre of pressure of each image."""
        rr, changes = self._rr, np.flatnonzero(np.diff(touch.shown, prepend=-1))
        rows, t_us = touch.shown[changes], view.frame_times[changes] * SLICE_US
        self._images("touch/pressure", "image/png", view.frame_times[changes], [touch.png(row) for row in rows])
        patch = touch.patch[rows] == 1
        shear = np.moveaxis(touch.shear_share[rows], 1, -1)[patch].astype(np.float32)
        middles = np.stack(np.nonzero(patch)[:0:-1], axis=1).astype(np.float32) + 0.5  # x, y
        arrows = rr.Arrows2D.columns(vectors=shear, origins=middles - shear / 2)
        self.static("touch/shear", rr.Arrows2D.from_fields(colors=[_rgb(ARROWS)], radii=[0.04]))
        self._columns("touch/shear", t_us, arrows.partition(patch.sum(axis=(1, 2))))
        centre = (touch.slices["centre_mm"] - [touch.x_mm[0], touch.y_mm[0]]) / (touch.x_mm[1] - touch.x_mm[0]) + 0.5
        is_known = np.isfinite(centre).all(axis=1)
        self.static("touch/centre", rr.Points2D.from_fields(colors=[_rgb(ORANGE)], radii=[0.25]))
        places = rr.Points2D.columns(positions=centre[is_known].astype(np.float32))
        self._columns("touch/centre", view.frame_times * SLICE_US, places.partition(is_known.astype(np.int64)))

    def series(self, view: ViewData) -> None:
        """Write the lines of all panels, with one standard deviation below and above if known, and level lines."""
        for number, panel in enumerate(view.panels):
            path = _chart(number, panel)
            for line in panel.lines:
                colour = _rgb(shown_colour(line.colour))
                if panel.marks:
                    style = self._rr.SeriesPoints(names=line.name, colors=colour, marker_sizes=2.0)
                else:
                    style = self._rr.SeriesLines(names=line.name, colors=colour)
                self._series(f"{path}/{_name(line.name)}", style, line.t_s, line.value)
                ends = {} if line.sd is None else dict(zip(("minus sd", "plus sd"), line.band, strict=True))
                for which, value in ends.items():
                    name = f"{line.name} {which}"
                    style = self._rr.SeriesLines(names=name, colors=[*colour, PALE], widths=0.7)
                    self._series(f"{path}/{_name(name)}", style, line.t_s, value)
            for name, level in panel.levels.items():
                style = self._rr.SeriesLines(names=name, colors=_rgb(shown_colour(INK)))
                self._series(f"{path}/{_name(name)}", style, np.array(view.span) / SLICES_PER_S, np.full(2, level))

    def _series(self, path: str, style: Any, t_s: NDArray[np.float64], value: NDArray[np.float64]) -> None:
        self.static(path, style)
        self._columns(path, np.rint(t_s * 1e6), self._rr.Scalars.columns(scalars=value))

    def states(self, path: str, lanes: list[Lane], start_s: float, names: list[str]) -> None:
        """Write each lane's name while it is active: empty in between, `not examined` where it is unknown."""
        slips = [(name, part) for lane, name in zip(lanes, names, strict=True) for part in lane.slip]
        parts = slips + [("not examined", part) for lane in lanes for part in lane.unknown]
        changes = {start_s: ""} | {last: "" for _, (_, last) in parts} | {first: name for name, (first, _) in parts}
        t_us = np.rint(np.array(sorted(changes)) * 1e6)
        state = [as_utf8(changes[at]) for at in sorted(changes)]
        self._columns(path, t_us, self._rr.StateChange.columns(state=state))


def _blueprint(rrb: Any, trial: OpenTrial, view: ViewData) -> Any:
    """Return the layout: gel and images on the left, series and slip in the middle, text on the right."""
    pictures = []
    if trial.recording is not None or trial.tracks is not None:
        width, height = view.frame_px
        bounds = rrb.VisualBounds2D(x_range=(0, width), y_range=(0, height))
        pictures.append(rrb.Spatial2DView(origin="gel", name="Events and dots", visual_bounds=bounds))
    if view.pictures:
        pictures.append(rrb.Spatial2DView(origin="images", name=f"Events of {view.shown_ms} ms"))
    if view.touch is not None:
        pictures.append(rrb.Spatial2DView(origin="touch", name="Touch map"))
    charts = []
    pictures += [rrb.Spatial2DView(origin=f"cameras/{_name(one.name)}", name=one.name) for one in view.cameras]
    for number, panel in enumerate(view.panels):
        words = [panel.title, f"[{panel.unit}]" if panel.unit else "", "(simulated)" if panel.simulated else ""]
        name = as_utf8(" ".join(word for word in words if word))
        axis = None if panel.ends is None else rrb.ScalarAxis(range=panel.ends)
        charts.append(rrb.TimeSeriesView(origin=_chart(number, panel), name=name, axis_y=axis))
    if view.lanes:
        charts.append(rrb.StateTimelineView(origin="slip", name="Slip"))
    if view.phases:
        charts.append(rrb.StateTimelineView(origin="phase", name="Phase of the grasp"))
    about = rrb.TextDocumentView(origin="about", name="About")
    columns = [rrb.Vertical(*views) for views in (pictures, charts, [about]) if views]
    shares = [share for share, views in ((4, pictures), (4, charts), (2, [about])) if views]
    return rrb.Blueprint(
        rrb.Horizontal(*columns, column_shares=shares), rrb.TimePanel(timeline=TIMELINE), collapse_panels=True
    )


def _about(title: str, trial: OpenTrial, view: ViewData, notes: list[str]) -> str:
    """Return a description of the file in Markdown."""
    start_s, stop_s = (at / SLICES_PER_S for at in view.span)
    onsets = [f"- {name}: {'none' if at is None else f'{at / SLICES_PER_S:.3f} s'}" for name, at in view.onsets.items()]
    all_notes = [
        "Data of a 1 ms slice are at its start.",
        "Event images: white is brighter, black is darker, grey is no event.",
        "Series: every value, or the smallest and largest value in each of 3,000 time bins.",
        *(f"{panel.title}: {panel.says}" for panel in view.panels if panel.says),
        *([] if view.touch is None else [view.touch.words]),
        *notes,
        *view.notes,
    ]
    parts = [
        f"# {title}",
        "**Simulated.**" if view.simulated else "",
        f"{start_s:.3f} to {stop_s:.3f} s of {view.slices / SLICES_PER_S:.3f} s, of `{trial.recording_id[:12]}`",
        "\n".join(["## First slip", *onsets]) if onsets else "",
        "\n".join(["## Notes", *(f"- {note}" for note in all_notes)]),
    ]
    return as_utf8("\n\n".join(part for part in parts if part))


def _chart(number: int, panel: Panel) -> str:
    """Return the path for the lines of a panel; the number distinguishes panels with the same title."""
    return f"series/{number:02}_{_name(panel.title)}"


def _name(text: str) -> str:
    """Return part of a path: lower-case letters, digits and underscores."""
    return re.sub("[^a-z0-9]+", "_", text.lower()).strip("_")


def _rgb(colour: str) -> list[int]:
    """Return red, green and blue, 0 to 255, of `#rrggbb`."""
    return [int(colour[at : at + 2], 16) for at in (1, 3, 5)]
