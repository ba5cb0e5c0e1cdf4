"""featurize: the inputs of slip detectors for each slice (paper, "Evetac Touch Features").

It reads the recording, its tracks and, if present, its labels. These are next to the recording unless a flag names
files or a folder. If the recording has a gripper, its position and goals are added for each slice.

Further data are added only on request. Event images are needed only by the image baselines and take half of the file.
The events themselves are for plug-in networks, which make images from them. The sticking share of the contact is for
load-path, and the true slipping share of a simulation for `train --learn-true-slip-share`.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX
from evetac_cli.jobs import Job, Outcome, Progress, Stage, outcome, silent
from evetac_cli.kernels.slip.architectures import GEL_PX
from evetac_cli.stages import row_blocks
from evetac_cli.stages.model_files import TRUE_SLIP_SHARE
from evetac_cli.stages.related_files import check_made_from, no_truth
from evetac_cli.store.files import StageFile, output_path, up_to_date, write_stage
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.store.recordings.onset import ABSTAINED, abstains
from evetac_cli.store.recordings.read import Recording, open_recording

OUTPUT = "features"
METHOD = 7
COLUMNS = ("displacement_px", "displacement_xy_px", "events_per_dot", "events_outside")  # one row per slice


def jobs(files: list[Path], params: Featurize, out: Path | None) -> list[Job]:
    """Return a job for every recording, from its tracks and, if present, its labels."""
    new_jobs = []
    for file in files:
        tracks = output_path(file, "tracks", params.tracks)
        labels = output_path(file, "labels", params.labels)
        inputs = (file, tracks, labels) if params.labels or labels.exists() else (file, tracks)
        new_jobs.append(Job(inputs, output_path(file, OUTPUT, out)))
    return new_jobs


def _recipe(params: Featurize, parents: Sequence[Header], frame_px: Sequence[int]) -> Recipe:
    """Return the recipe; only the sticking share depends on the frame, and only on another one than an Evetac's."""
    options: dict[str, Any] = {name: True for name in ("sticking_share", "events") if getattr(params, name)}
    if params.sticking_share and tuple(frame_px) != FRAME_PX:
        options["frame_px"] = list(frame_px)
    return Recipe(OUTPUT, METHOD, recipe_of(params) | options, parents=tuple(parents))


def run(job: Job, params: Featurize, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Write displacement and events of every dot, events outside the window, and labels if present."""
    recording_path, tracks_path, *labels_path = job.inputs
    with ExitStack() as opened:
        recording = opened.enter_context(open_recording(recording_path))
        if not tracks_path.exists():
            hint = f"evetac track {recording_path}"
            raise InputError("its tracks are missing", where=str(recording_path), expected=str(tracks_path), hint=hint)
        parents = [recording.header]
        arrays: dict[str, Any] = {}
        tracks = opened.enter_context(StageFile(tracks_path, "tracks"))
        check_made_from(tracks, recording)
        parents.append(tracks.header)
        rest_xy_px = tracks.read("sensor/dot_xy_px")
        window = tracks.read("sensor/window_px") if tracks.has("sensor/window_px") else recording.window_px
        sensor_values = recording.sensitivity.known() | tracks.sensitivity.known()
        arrays |= {f"sensor/{name}": np.float64(value) for name, value in sensor_values.items()}
        if params.true_slip_share:
            arrays[TRUE_SLIP_SHARE] = _true_slip_share(recording)
        for path in labels_path:
            with StageFile(path, "labels") as labels:
                check_made_from(labels, recording)
                parents.append(labels.header)
                arrays["label"] = labels.read("label")
                arrays["onset_slice"] = labels.read("onset_slice")
                arrays[ABSTAINED] = np.uint8(abstains(labels))
        recipe = _recipe(params, parents, recording.frame_px)
        simulated = recording.header["simulated"]
        if up_to_date(job.output, recipe, force=force):
            return outcome(job, made=False, simulated=simulated)
        slices = len(recording)
        arrays |= _gripper(recording)
        if params.sticking_share:
            arrays |= _sticking(tracks)
        arrays["events_total"] = np.diff(recording.starts).astype(np.int32)
        arrays["dot_shape"] = np.array(rest_xy_px.shape[:2], np.int32)
        blocks = _blocks(recording, tracks, rest_xy_px.reshape(-1, 2), window, params, progress)
        lengths = dict.fromkeys(COLUMNS, slices) | ({"image/start": slices + 1} if params.images else {})
        lengths |= {"gel_events/start": slices + 1} if params.events else {}
        made = write_stage(job.output, recipe, arrays, blocks, lengths, force=force) is not None
    onset = int(arrays.get("onset_slice", -1))  # a slice is a millisecond
    return outcome(
        job,
        made=made,
        simulated=simulated,
        slices=slices,
        labelled="label" in arrays,
        gripper="gripper_position_ticks" in arrays,
        onset_ms=onset if onset >= 0 else None,
        abstained=bool(arrays.get(ABSTAINED, 0)),
    )


def _gripper(recording: Recording) -> dict[str, NDArray[np.float32]]:
    """Return the gripper's position and commands at the start of each slice; nothing without a gripper.

    The goal current is NaN in position mode; the goal position is NaN if no controller wrote one.
    """
    from evetac_cli.kernels.slip.inputs import known_at_start

    if not recording.has("gripper") or not recording.length("gripper/t_us"):
        return {}
    slices, t_us = len(recording), recording.read("gripper/t_us")
    in_current_mode = ~np.isnan(recording.read("gripper/current_target_ma"))
    goal_ma = np.where(in_current_mode, recording.read("gripper/current_written_ma"), np.nan)
    columns = {
        "gripper_position_ticks": known_at_start(t_us, recording.read("gripper/position_ticks"), slices),
        "gripper_goal_ma": known_at_start(t_us, goal_ma, slices),
    }
    if recording.has("control") and recording.length("control/t_us"):
        steps = recording.read("control/t_us"), recording.read("control/goal_ticks")
        columns["gripper_goal_ticks"] = known_at_start(*steps, slices)
    return columns


def _sticking(tracks: StageFile) -> dict[str, NDArray[np.float32]]:
    """Return the sticking share and the probability that slip has begun, (slices,) each.

    They are known at the start of each slice: from the dots after the previous one.
    """
    from evetac_cli.stages.touch.touch_fold import StickingShare

    sticks = StickingShare(tracks.read("sensor/dot_xy_px").reshape(-1, 2), tracks.read("sensor/frame_px"))
    slices = tracks.length("dot_xy_px")
    share, begun = np.full((2, slices + 1), np.nan, np.float32)
    for first, stop in row_blocks(slices):
        dots = zip(tracks.read("dot_xy_px", first, stop), tracks.read("lost", first, stop), strict=True)
        for number, (dot_xy_px, lost) in enumerate(dots, first):
            share[number + 1] = sticks.step(dot_xy_px, lost)
            begun[number + 1] = sticks.begun
    return {"sticking_share": share[:-1], "slip_begun": begun[:-1]}


def _true_slip_share(recording: Recording) -> NDArray[np.float32]:
    """Return the slipping share of the visible contact, (slices,); InputError for a recording without it."""
    if not recording.has(TRUE_SLIP_SHARE):
        raise no_truth(recording.path, "leave out --true-slip-share")
    share: NDArray[np.float32] = recording.read(TRUE_SLIP_SHARE)
    return share


def _blocks(
    recording: Recording,
    tracks: StageFile,
    rest_xy_px: NDArray[Any],
    window: Any,
    params: Featurize,
    progress: Progress,
) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the features in blocks of slices; the size of images depends on the number of pixels with events."""
    from evetac_cli.kernels.slip import features

    slices = len(recording)
    blank = np.zeros(GEL_PX[::-1], np.int8)
    pixels = events = 0
    for first, stop in row_blocks(slices):
        progress(first, slices)
        dot_xy_px = tracks.read("dot_xy_px", first, stop)
        starts = recording.starts[first : stop + 1]
        x, y = (recording.read(f"events/{name}", int(starts[0]), int(starts[-1])) for name in "xy")
        starts = starts - starts[0]
        block = {
            "displacement_px": features.displacement(dot_xy_px, rest_xy_px),
            "displacement_xy_px": features.displacement_xy(dot_xy_px, rest_xy_px),
            "events_per_dot": tracks.read("events_per_dot", first, stop),
            "events_outside": features.events_outside(x, y, starts, window),
        }
        if params.events:
            whole = recording.events(*recording.starts[[first, stop]].tolist())
            of_gel = features.gel_events(whole, starts, window)
            block |= {f"gel_events/{name}": column for name, column in of_gel._asdict().items()}
            block["gel_events/start"] = events + of_gel.start[int(first > 0) :]
            events += len(of_gel.x)
        if params.images:
            p = recording.read("events/p", *recording.starts[[first, stop]].tolist())
            slices_of = zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True)
            images = [features.gel_image(x[i:j], y[i:j], p[i:j], window, blank) for i, j in slices_of]
            ends = pixels + np.cumsum([len(pixel) for pixel, _ in images], dtype=np.int64)
            block |= {
                "image/start": np.concatenate([np.zeros(int(not first), np.int64), ends]),
                "image/pixel": np.concatenate([np.empty(0, np.uint32), *(pixel for pixel, _ in images)]),
                "image/sign": np.concatenate([np.empty(0, np.int8), *(sign for _, sign in images)]),
            }
            pixels += len(block["image/pixel"])
        yield block


STAGE = Stage(jobs, run)
