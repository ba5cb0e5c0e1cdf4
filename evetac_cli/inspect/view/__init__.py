"""view: look at a recording and what was computed from it: one page that needs no network, or an animation."""

import os
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from evetac_cli.errors import EvetacError, InputError
from evetac_cli.inspect.view.collect import collect_view
from evetac_cli.inspect.view.page import render_page
from evetac_cli.inspect.view.trial_files import Trial, open_trial
from evetac_cli.inspect.view.view_data import ViewData
from evetac_cli.jobs import Outcome, Progress, silent
from evetac_cli.params import View
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
        span = _span(trial, params)
        shown = collect_view(trial, params, span, progress)
        written = {target: render_page(trial, shown)}
        if params.film is not None:
            written[params.film] = _film(trial, shown)
    for path, content in written.items():
        _write(path, content)
    row: dict[str, Any] = {
        "page": str(target),
        "size_bytes": len(written[target]),
        "film": None if params.film is None else str(params.film),
        "film_bytes": None if params.film is None else len(written[params.film]),
        "frame_times": len(shown.frame_times),
        "images": len(shown.pictures),
        "series": sum(len(panel.lines) for panel in shown.panels),
        "shown_ms": span[1] - span[0],
        "files": " ".join(file.path.name for file in trial.files),
    }
    return Outcome([row], shown.simulated, {"notes": " ".join(shown.notes) or None})


def _check_libraries(names: Iterable[str]) -> None:
    """Say what is missing before any work is done."""
    for name in names:
        if find_spec(name) is None:
            raise EvetacError(f"{name}, which draws the page, is not installed", hint="pip install 'evetac[plot]'")


def _film(trial: Trial, shown: ViewData) -> bytes:
    if not shown.pictures:
        raise InputError("there is nothing to animate: no event images", where=str(trial.files[0].path))
    from evetac_cli.inspect.view.film import render_film

    return render_film(shown, trial.files[0].path.name)


def _span(trial: Trial, params: View) -> tuple[int, int]:
    """The slices to show."""
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
    if os.path.isdir(path):
        raise InputError("the output is a folder", where=str(path))
    if os.path.lexists(path) and not force:
        raise InputError("the output exists", where=str(path), hint="--force replaces it, -o NAME writes elsewhere")


def _write(path: Path, content: bytes) -> None:
    """Write beside the target, then rename: a page is there whole or not at all."""
    with taking_the_place_of(path) as temporary:
        temporary.write_bytes(content)
