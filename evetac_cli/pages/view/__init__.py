"""view: show a recording and its results on one self-contained page."""

from pathlib import Path
from typing import Any

from evetac_cli.commands.view import View
from evetac_cli.errors import InputError
from evetac_cli.events import SLICES_PER_S
from evetac_cli.jobs import Outcome, Progress, require_possible_name, silent
from evetac_cli.pages import shared
from evetac_cli.pages.view import gripper, streams, touch
from evetac_cli.pages.view.event_images import (
    choose_frame_times,
    draw_pictures,
    frame_size_px,
    place_dots,
    telling_frame,
    window_px,
)
from evetac_cli.pages.view.page import render_page
from evetac_cli.pages.view.time_series import model_output, series_panels, slip_lanes, slip_onsets
from evetac_cli.pages.view.trial_files import OpenTrial, open_trial
from evetac_cli.pages.view.view_data import ViewData
from evetac_cli.resources import with_shipped
from evetac_cli.store.files import stem
from evetac_cli.store.hdf5.disk import check_free
from evetac_cli.store.recordings.onset import PERSON, labelled_onset
from evetac_cli.store.recordings.streams import marks_in_words


def run(
    files: list[Path], params: View, out: Path | None, *, force: bool = False, progress: Progress = silent
) -> Outcome:
    """Write the page of one trial; raise InputError if it exists, unless `force`."""
    shared.check_libraries(("bokeh", "PIL"))
    files = with_shipped(files)
    folders = [path for path in files if path.is_dir()]
    if folders:
        raise InputError(
            "a page shows one trial",
            where=str(folders[0]),
            expected="stage files of one trial",
            found="a folder",
            hint=f"evetac report {folders[0]} shows all its trials on one page",
        )
    target = shared.page_path(files[0].parent, f"{stem(files[0])}.html", out)
    require_possible_name(target)
    check_free(target, force=force)
    with open_trial(files, progress) as trial:
        view = collect_view(trial, params, progress)
        shared.write_page(target, render_page(trial, view), force=force)
    row: dict[str, Any] = {
        "page": str(target),
        "size_bytes": target.stat().st_size,
        "frame_times": len(view.frame_times),
        "images": len(view.pictures),
        "series": sum(len(panel.lines) for panel in view.panels),
        "shown_ms": view.span[1] - view.span[0],
        "files": " ".join(file.path.name for file in trial.files),
    }
    return Outcome([row], view.simulated, {"notes": " ".join(view.notes) or None})


def collect_view(trial: OpenTrial, params: View, progress: Progress) -> ViewData:
    """Collect the data to draw of a trial; their size is the same for an hour as for a second."""
    span = _span(trial, params)
    view = ViewData(
        slices=trial.slices,
        span=span,
        shown_ms=params.shown_ms,
        simulated=any(file.header["simulated"] for file in trial.files),
        frame_px=frame_size_px(trial),
        window_px=window_px(trial),
        labelled=None if trial.labels is None else labelled_onset(trial.labels),
        notes=_label_notes(trial) + _mark_notes(trial) + trial.notes,
    )
    if span[0] == span[1]:
        return view
    probability = model_output(trial, span)
    of_touch = [] if trial.touch is None else touch.touch_panels(trial.touch, span)
    panels = series_panels(trial, span, probability, of_touch)
    # gripper below events, which come first if there is a recording
    view.panels = [*panels[:1], *gripper.gripper_panels(trial, span), *panels[1:]]
    view.panels += streams.stream_panels(trial, span, view.notes)
    view.onsets = slip_onsets(trial, span, probability)
    view.lanes = slip_lanes(trial, span, probability)
    view.phases = gripper.phase_lanes(trial, span)
    view.contact_times = gripper.contact_times(trial, span)
    if trial.recording is not None or trial.tracks is not None:
        choose_frame_times(view, trial, params.images)
        draw_pictures(view, trial, progress)
        place_dots(view, trial)
        streams.draw_cameras(view, trial)
        touch.place_touch(view, trial)
        view.side = gripper.side_view(trial, view.ends)
        view.opens_at = telling_frame(view)
    return view


def _label_notes(trial: OpenTrial) -> list[str]:
    """Return notes on labels copied from truth, made by a person, or abstaining."""
    if trial.labels is None:
        return []
    parameters = trial.labels.header["parameters"]
    notes = ["The labels were copied from the truth (simulated)."] if parameters.get("method") == "truth" else []
    if parameters.get("method") == PERSON:
        notes.append(f"The labels were made by a person: {parameters.get('by')}.")
    return [*notes, *filter(None, [labelled_onset(trial.labels).in_words()])]


def _mark_notes(trial: OpenTrial) -> list[str]:
    """Return a note on the marks that a robot's program set during recording."""
    marked = "" if trial.recording is None else marks_in_words(trial.recording.marks)
    return [f"Marked by the robot's program: {marked}."] if marked else []


def _span(trial: OpenTrial, params: View) -> tuple[int, int]:
    """Return the first and the last (excluded) slice to show; raise InputError if none is left."""
    slices = trial.slices
    start = round(params.start_s * SLICES_PER_S)
    stop = slices if params.stop_s is None else min(slices, round(params.stop_s * SLICES_PER_S))
    if start < stop or (slices == 0 and start == 0):
        return start, stop
    raise InputError(
        "no time is left to show",
        where="--start-s, --stop-s",
        expected=f"0 <= start < stop, within {slices / SLICES_PER_S:.3f} s",
        found=f"{params.start_s:g} to {stop / SLICES_PER_S:g}",
    )
