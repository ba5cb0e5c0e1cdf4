"""track: the position of every dot in each slice (paper, "Signal Processing - Dot Tracking")."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.parameter import refuse_unused
from evetac_cli.commands.track import EVENTS, RGB, Track
from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, Stage, outcome, silent
from evetac_cli.kernels.tracking import presets
from evetac_cli.stages import per_file, row_blocks
from evetac_cli.store.calibration import MAKE_GRID, Calibration, read_calibration, stored_calibration
from evetac_cli.store.files import up_to_date, write_stage
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.store.recordings.read import Recording, open_recording

if TYPE_CHECKING:
    from evetac_cli.kernels.tracking.tracker import TrackerState, Tracks

OUTPUT = "tracks"
METHOD = 7


def jobs(files: list[Path], params: Track, out: Path | None) -> list[Job]:
    """Return a job for every recording; with --rgb, InputError for an option that only the tracking of events has."""
    refuse_unused(params, RGB if params.rgb else EVENTS, "--rgb" if params.rgb else "no --rgb")
    if params.rgb:
        from evetac_cli.stages import track_rgb

        return track_rgb.jobs(files, params, out)
    return per_file(files, OUTPUT, out)


def constants(preset: str, **overrides: Any) -> tuple[str, presets.TrackerConstants]:
    """Return name and constants of a preset; with overrides the name is `custom from PRESET`. InputError if invalid."""
    changes = {name: value for name, value in overrides.items() if value is not None}
    base = presets.PRESETS[preset]
    try:
        custom = dataclasses.replace(base, **changes)
    except ValueError as error:
        raise InputError(f"invalid constants of the tracker: {error}") from error
    return (preset if custom == base else f"custom from {preset}"), custom


def _constants(params: Track) -> tuple[str, presets.TrackerConstants]:
    return constants(
        params.preset,
        step_size=params.step_size,
        regulariser_weight=params.regulariser,
        min_events=params.min_events,
    )


def _recipe(
    preset: str,
    tracker_constants: presets.TrackerConstants,
    dot_radius_px: float,
    contrast_over_threshold: float | None,
    grid: str,
    recording: Header,
) -> Recipe:
    parameters = {
        "preset": preset,
        "constants": dataclasses.asdict(
            tracker_constants
        ),  # of the preset, before scaling, so that they are the same for all sensors
        "dot_radius_px": dot_radius_px,
        "contrast_over_threshold": contrast_over_threshold,
        "grid": grid,
    }
    return Recipe(OUTPUT, METHOD, parameters, parents=(recording,))


def run(job: Job, params: Track, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Track the dots of a recording through all slices."""
    if params.rgb:
        from evetac_cli.stages import track_rgb

        return track_rgb.run(job, params, force=force, progress=progress)
    name, tracker_constants = _constants(params)
    with open_recording(job.inputs[0]) as recording:
        calibration = _calibration(recording, params.calibration)
        known = recording.sensitivity.known() | calibration.sensitivity.known()
        of_dots = calibration.dot_radius_px, known.get("contrast_over_threshold")
        recipe = _recipe(name, tracker_constants, *of_dots, calibration.digest(), recording.header)
        simulated = recording.header["simulated"]
        if up_to_date(job.output, recipe, force=force):
            return outcome(job, made=False, simulated=simulated)
        from evetac_cli.kernels.slip import features
        from evetac_cli.kernels.tracking import tracker

        rows, columns = calibration.dot_xy_px.shape[:2]
        try:
            fitting = tracker_constants.for_dots(*of_dots)
            state = tracker.start(calibration.dot_xy_px.reshape(-1, 2), fitting, frame_px=recording.frame_px)
        except ValueError as error:
            raise InputError(f"the dots cannot be tracked: {error}", where=str(recording.path)) from error
        slices, dots = len(recording), rows * columns
        arrays = {
            "sensor/frame_px": recording.read("sensor/frame_px"),
            "sensor/name": recording.read("sensor/name"),
            **calibration.arrays(),
        }
        farthest_px = np.float32(np.nan if slices and dots else 0.0)

        def tracked() -> Iterator[dict[str, NDArray[Any]]]:
            nonlocal farthest_px
            for block in _tracked(recording, state, progress):
                moved = features.displacement(block.dot_xy_px, state.rest_xy_px)
                farthest_px = np.fmax(farthest_px, np.fmax.reduce(moved, axis=None, initial=np.nan))
                yield block._asdict()

        columns = tracker.Tracks._fields
        made = (
            write_stage(job.output, recipe, arrays, tracked(), dict.fromkeys(columns, slices), force=force) is not None
        )
    return outcome(
        job,
        made=made,
        simulated=simulated,
        slices=slices,
        dots=dots,
        max_displacement_px=float(farthest_px),
        dots_lost=int(state.lost.sum()) if slices else 0,
    )


def _tracked(recording: Recording, state: "TrackerState", progress: Progress) -> Iterator["Tracks"]:
    """Yield the tracked dots in blocks of slices, updating the tracker's state.

    Times are not read, since the tracker does not depend on the order of events within a slice.
    """
    from evetac_cli.kernels.tracking import tracker

    slices = len(recording)
    columns = "xyp" if state.constants.fit else "xy"
    for first, stop in row_blocks(slices):
        progress(first, slices)
        starts = recording.starts[first : stop + 1]
        x, y, *p = (recording.read(f"events/{name}", int(starts[0]), int(starts[-1])) for name in columns)
        yield tracker.fold(state, x, y, p[0] if p else None, starts - starts[0])


def _calibration(recording: Recording, path: Path | None) -> Calibration:
    """Return the dot grid given by a flag, or the one in the recording."""
    if path is not None:
        return read_calibration(path, recording.frame_px)
    if recording.dot_xy_px is None:
        raise InputError("the recording has no dot grid", where=str(recording.path), hint=MAKE_GRID)
    return stored_calibration(recording)


STAGE = Stage(jobs, run)
