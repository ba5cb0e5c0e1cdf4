"""view: show a recording and what was computed from it, on one page that needs no network and as an animation."""

import os
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.errors import EvetacError, InputError, install_hint
from evetac_cli.inspect.view.event_images import choose_frame_times, draw_pictures, frame_size_px, place_dots, window_px
from evetac_cli.inspect.view.page import render_page
from evetac_cli.inspect.view.time_series import model_output, series_panels, slip_lanes, slip_onsets
from evetac_cli.inspect.view.trial_files import Trial, open_trial
from evetac_cli.inspect.view.view_data import ViewData
from evetac_cli.jobs import Outcome, Progress, require_possible_name, silent
from evetac_cli.params.inspection import View
from evetac_cli.store.disk import taking_the_place_of
from evetac_cli.store.files import stem


def run(
    files: list[Path], params: View, out: Path | None, *, force: bool = False, progress: Progress = silent
) -> Outcome:
    """Write the page of one trial, and the animation if asked; InputError if either exists, unless `force`."""
    _check_libraries(("bokeh", "PIL"))
    target = _target(files[0], out)
    outputs = [target] if params.film is None else [target, _with_suffix(params.film, ".gif", "--film")]
    for path in outputs:
        _check_free(path, force)
    with open_trial(files) as trial:
        view = collect_view(trial, params, progress)
        written = {target: render_page(trial, view)}
        if params.film is not None:
            written[params.film] = _film(trial, view)
    for path, content in written.items():
        _write(path, content)
    row: dict[str, Any] = {
        "page": str(target),
        "size_bytes": len(written[target]),
        "film": None if params.film is None else str(params.film),
        "film_bytes": None if params.film is None else len(written[params.film]),
        "frame_times": len(view.frame_times),
        "images": len(view.pictures),
        "series": sum(len(panel.lines) for panel in view.panels),
        "shown_ms": view.span[1] - view.span[0],
        "files": " ".join(file.path.name for file in trial.files),
    }
    return Outcome([row], view.simulated, {"notes": " ".join(view.notes) or None})


def _check_libraries(names: Iterable[str]) -> None:
    """EvetacError, before any work is done, where a library that draws is missing."""
    for name in names:
        if find_spec(name) is None:
            raise EvetacError(f"{name}, which draws the page, is not installed", hint=install_hint("plot"))


def collect_view(trial: Trial, params: View, progress: Progress) -> ViewData:
    """Gather what is drawn of a trial; no larger for an hour than for a second."""
    span = _span(trial, params)
    empty = span[0] == span[1]
    probability = model_output(trial, span)
    view = ViewData(
        slices=trial.slices,
        span=span,
        shown_ms=params.shown_ms,
        simulated=any(file.header["simulated"] for file in trial.files),
        frame_px=frame_size_px(trial),
        window_px=window_px(trial),
        onsets={} if empty else slip_onsets(trial, span, probability),
        panels=[] if empty else series_panels(trial, span, probability),
        lanes=[] if empty else slip_lanes(trial, span, probability),
        notes=_label_notes(trial) + trial.notes,
        frame_times=np.empty(0, np.int64),
        dense={},
        pictures=[],
        events=[],
        rest_xy_px=None,
        dot_xy_px=None,
        lost=None,
        true_xy_px=None,
    )
    if not empty and (trial.recording is not None or trial.tracks is not None):
        choose_frame_times(view, trial, params.images)
        draw_pictures(view, trial, progress)
        place_dots(view, trial)
    return view


def _label_notes(trial: Trial) -> list[str]:
    """A note on labels that no sensor could have given."""
    copied = trial.labels is not None and trial.labels.header["parameters"].get("method") == "truth"
    return ["The labels were copied from the truth (simulated)."] if copied else []


def _film(trial: Trial, view: ViewData) -> bytes:
    if not view.pictures:
        raise InputError("there is nothing to animate: no event images", where=str(trial.files[0].path))
    from evetac_cli.inspect.view.film import render_film

    return render_film(view, trial.files[0].path.name)


def _span(trial: Trial, params: View) -> tuple[int, int]:
    """First and last (excluded) slice to show; InputError where none is left."""
    slices = trial.slices
    start = round(params.start_s * 1000)
    stop = slices if params.stop_s is None else min(slices, round(params.stop_s * 1000))
    if start < stop or (slices == 0 and start == 0):
        return start, stop
    raise InputError(
        "no time is left to show",
        where="--start-s, --stop-s",
        expected=f"0 <= start < stop, within {slices / 1000:.3f} s",
        found=f"{params.start_s:g} to {stop / 1000:g}",
    )


def _target(file: Path, out: Path | None) -> Path:
    """NAME.html beside the file, in the folder `out`, or the file `out`."""
    name = f"{stem(file)}.html"
    if out is None:
        return file.with_name(name)
    if out.is_dir() or not out.suffix:
        return out / name
    return _with_suffix(out, ".html", "--out")


def _with_suffix(path: Path, suffix: str, flag: str) -> Path:
    if path.suffix.lower() != suffix:
        raise InputError("wrong kind of output", where=flag, expected=f"a name that ends in {suffix}", found=str(path))
    return path


def _check_free(path: Path, force: bool) -> None:
    require_possible_name(path)
    if os.path.isdir(path):
        raise InputError("the output is a folder", where=str(path))
    if os.path.lexists(path) and not force:
        raise InputError("the output exists", where=str(path), hint="--force replaces it, -o NAME writes elsewhere")


def _write(path: Path, content: bytes) -> None:
    """Write beside the target, then rename, so that no half page is ever left."""
    with taking_the_place_of(path) as temporary:
        temporary.write_bytes(content)
