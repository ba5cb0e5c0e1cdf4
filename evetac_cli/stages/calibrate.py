"""calibrate: find a gel's dots at rest in a press recording, or import them; writes a JSON file for --calibration.

In a press recording, a stylus strokes the whole gel and lifts off between strokes; `--scene press` simulates one. The
positions and size of the dots need not be known (kernels/calibration). calibrated_gel.py determines the gel to which
they belong, closed or cut.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.commands.calibrate import Calibrate
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX
from evetac_cli.formats.calibration_files import read_pickle
from evetac_cli.jobs import Job, Outcome, Progress, Stage, outcome, silent
from evetac_cli.kernels.calibration import gel_layout, grid
from evetac_cli.kernels.calibration.gel_layout import Grid
from evetac_cli.sim.setup import sensor_file
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.stages import calibrated_gel, output_in
from evetac_cli.stages.calibrated_gel import FoundDots
from evetac_cli.store.calibration import Calibration, read_calibration, read_quality, up_to_date, write_calibration
from evetac_cli.store.files import stem
from evetac_cli.store.hdf5.disk import Recheck
from evetac_cli.store.layout.provenance import Recipe, time_host_versions
from evetac_cli.store.recordings.read import Recording, open_recording

OUTPUT = "calibration"
METHOD = 6
LEFT_OUT = "positions_left_out"
LEAST_DOTS = 4
WORST_JITTER_PX = 1.0


def jobs(files: list[Path], params: Calibrate, out: Path | None) -> list[Job]:
    """Return a job for every recording, with output `<name>.calibration.json`, or one for the imported file."""
    calibrated_gel.check_options(params)
    if params.source is not None and (files or params.refine):
        raise InputError("cannot be combined with recordings or a default grid", where="--import")
    if params.source is None and not files:
        raise InputError("no recording is given", expected="a press recording, or --import FILE")
    sources = [params.source] if params.source is not None else files
    return [Job((file,), output_in(out, file.parent, f"{stem(file)}.{OUTPUT}.json", ".json")) for file in sources]


def run(job: Job, params: Calibrate, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Find the dots in one recording, or import them, and write the calibration."""
    if params.source is not None:
        return _import(job, params, force)
    default = None
    with open_recording(job.inputs[0]) as recording:
        parameters = recipe_of(params)
        if params.refine is not None:
            default = read_calibration(params.refine, recording.frame_px)
            parameters["default"] = default.digest()
        recipe = Recipe(OUTPUT, METHOD, parameters, parents=(recording.header,))
        if up_to_date(job.output, recipe, force=force):
            return _outcome(job, recipe, made_now=False)
        from evetac_cli.kernels.calibration import dot_search
        from evetac_cli.stages import gel_at_rest

        where = str(recording.path)
        halves = gel_at_rest.rest_images(recording, progress)
        picture = halves[0].joined(halves[1])
        places = dot_search.find(picture)
        if len(places.radius_px) < LEAST_DOTS:
            largest = dot_search.LARGEST_SHARE * min(recording.frame_px)
            radii = f"{dot_search.SMALLEST_RADIUS_PX} to {largest:.0f} px radius"
            expected, found = f"{LEAST_DOTS} or more, dark and round, of {radii}", str(len(places.radius_px))
            message = "too few dots were seen to move"
            raise InputError(message, where=where, expected=expected, found=found, hint=calibrated_gel.PRESS)
        radius = float(np.median(places.radius_px))
        if default is None:
            dots, window = calibrated_gel.arranged(_found(recording, places.centre_xy_px, radius), params)
            from_default, left_out = 0, _left_out(places.centre_xy_px, dots)
        else:
            dots, from_default = _refined(default.dot_xy_px, places.centre_xy_px, where)
            window, left_out = default.window_px, {}
        jitter = gel_at_rest.jitter_px(halves, dots, radius)
        if not jitter <= WORST_JITTER_PX:
            message = "the dots come to rest at different positions after each stroke, or there are too few strokes"
            expected, found = f"jitter of at most {WORST_JITTER_PX:g} px rms", f"{jitter:.2f} px"
            raise InputError(message, where=where, expected=expected, found=found, hint=calibrated_gel.PRESS)
        figures = {"jitter_px_rms": jitter, "kept_from_default": from_default, **left_out}
        calibration = Calibration(recording.frame_px, dots, radius, window)
        hot = gel_at_rest.hot_pixels(recording)
        if hot is not None:
            calibration = replace(calibration, hot_xy_px=hot)
    made = _write(job, calibration, recipe, figures, force=force)
    return _outcome(job, recipe, made_now=made)


def _import(job: Job, params: Calibrate, force: bool) -> Outcome:
    """Read the official software's pickle, JSON, or a sensor's TOML file, and write a calibration file."""
    (source,) = job.inputs
    left_out = {}
    if source.suffix == ".json":
        given = read_calibration(source)
        calibration = calibrated_gel.rearranged(given, params, str(source))
        left_out = _left_out(given.dot_xy_px, calibration.dot_xy_px)
    elif source.suffix == sensor_file.SUFFIX:
        calibration = _of_sensor(source, params)
    else:
        centres, radius = read_pickle(source)
        if (centres < 0).any() or (centres > np.array(FRAME_PX) - 1).any():
            message = "a dot is outside the frame of the official software"
            hint = "write the dots as JSON with frame_px"
            raise InputError(message, where=str(source), expected="{} x {} px".format(*FRAME_PX), hint=hint)
        dots, window = calibrated_gel.arranged(FoundDots(centres, radius, FRAME_PX, str(source)), params)
        if np.isfinite(dots[..., 0]).sum() != len(centres):
            expected, found = f"{len(centres)} dots in rows and columns", str(np.isfinite(dots[..., 0]).sum())
            message, hint = "the dots do not form a grid", calibrated_gel.IRREGULAR
            raise InputError(message, where=str(source), expected=expected, found=found, hint=hint)
        calibration = Calibration(FRAME_PX, dots, radius, window)
    recipe = Recipe(OUTPUT, METHOD, recipe_of(params) | {"source": source.name}, content=calibration.digest())
    if up_to_date(job.output, recipe, force=force):
        return _outcome(job, recipe, made_now=False)
    made = _write(job, calibration, recipe, left_out, force=force)
    return _outcome(job, recipe, made_now=made)


def _left_out(places: Grid, dots: Grid) -> dict[str, int]:
    """Return the number of known positions that are not in the grid, as a figure; nothing if all are."""
    count = int(np.isfinite(places[..., 0]).sum() - np.isfinite(dots[..., 0]).sum())
    return {LEFT_OUT: count} if count else {}


def _of_sensor(source: Path, params: Calibrate) -> Calibration:
    """Return the dots of a sensor's file as seen by its camera, and its sensitivity to contact."""
    from evetac_cli.sim.camera.gel_camera import Lens, dot_grid

    _, sensor = sensor_file.read(source, one_sensor)
    cut = params.gel != "closed"
    dots, lens = dot_grid(sensor, cut), Lens.of_sensor(sensor)
    return Calibration(
        sensor.frame_px,
        dots if lens is None else lens.seen(dots),
        sensor.dot_radius_px,
        sensor.window_px if cut else None,
        sensor.sensitivity(),
    )


def _found(recording: Recording, places: Grid, radius_px: float) -> FoundDots:
    """Return the dots of a press with the recording's information on the gel: if it has a grid, also its window."""
    window = recording.window_px
    gel = None if recording.dot_xy_px is None else "closed" if window is None else "cut"
    if window is not None and gel_layout.touches(window, places, radius_px):
        gel = window = None  # it was recorded with the calibration of another gel
    return FoundDots(places, radius_px, recording.frame_px, str(recording.path), calibrated_gel.PRESS, gel, window)


def _write(job: Job, calibration: Calibration, recipe: Recipe, figures: dict[str, Any], *, force: bool) -> bool:
    pairs = grid.neighbours(calibration.dot_xy_px.reshape(-1, 2))
    neighbours = [[int(other) for other in row if other >= 0] for row in pairs]
    provenance = recipe.identity | {"id": recipe.id, "made": time_host_versions()}
    recheck = Recheck(partial(up_to_date, job.output, recipe, force=force))
    write_calibration(job.output, calibration, neighbours, figures, provenance, str(job.inputs[0]), recheck)
    return recheck.made


def _outcome(job: Job, recipe: Recipe, *, made_now: bool) -> Outcome:
    """Return the outcome for a calibration file, which may have been made now or earlier."""
    calibration, quality = read_calibration(job.output), read_quality(job.output)
    rows, columns = calibration.dot_xy_px.shape[:2]
    missing = int(np.isnan(calibration.dot_xy_px[..., 0]).sum())
    figures = {
        "dots": rows * columns - missing,
        "missing_dots": missing,
        "rows": rows if rows > 1 else None,  # one row is dots in no grid
        "columns": columns if rows > 1 else None,
        "gel": "closed" if calibration.window_px is None else "cut",
        "window_px": " ".join(map(str, calibration.window_px or ())) or None,
        "radius_px": calibration.dot_radius_px,
        "hot_pixels": len(calibration.hot_xy_px),
        "notes": "; ".join(calibrated_gel.notes(calibration, int(quality.get(LEFT_OUT, 0)))) or None,
    }
    result = outcome(job, made=made_now, simulated=recipe.simulated, **figures)
    result.rows[0].update(quality)
    return result


def _refined(default: Grid, measured: Grid, where: str) -> tuple[Grid, int]:
    """Return the default grid with the measured dots, and the number of dots without a measurement.

    Dots without a measurement keep their position, shifted with the grid. The default must be within half a pitch of
    the true grid; beyond that, dots are mistaken for their neighbours.
    """
    reach = grid.pitch(default) / 2
    shift = np.zeros(2)
    for _ in range(2):  # the second time with the positions of most dots
        offset = measured[None] - (default.reshape(-1, 2) + shift)[:, None]
        distance = np.linalg.norm(offset, axis=2)
        nearest = np.where(np.isnan(distance), np.inf, distance).argmin(axis=1)
        every_dot = np.arange(len(offset))
        near = np.flatnonzero(distance[every_dot, nearest] < reach)
        if len(near) < LEAST_DOTS:
            expected = f"{LEAST_DOTS} of its dots"
            raise InputError("the default grid does not fit", where=where, expected=expected, found=str(len(near)))
        shift = shift + np.median(offset[near, nearest[near]], axis=0)
    refined = default.reshape(-1, 2) + shift
    refined[near] = measured[nearest[near]]
    return refined.reshape(default.shape), int(np.isfinite(default[..., 0]).sum()) - len(near)


STAGE = Stage(jobs, run)
