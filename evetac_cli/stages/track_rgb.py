"""track-rgb: dots as an RGB sensor at 25 Hz would track them (paper, "Dot-based Shear Force Reconstruction").

The gel of a simulated recording is rendered as frames from its true motion, and its dots are followed by optical flow.
The files are like tracks from events; between two frames dots stay where the last frame showed them.

Without `-o` they go to the folder `rgb` beside the recording, because tracks from its events have the same name.
"""

import dataclasses
from pathlib import Path

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, outcome, silent
from evetac_cli.kernels.tracking import frame_tracker
from evetac_cli.params import TrackRgb, recipe_of
from evetac_cli.sim.camera.rgb import RgbCamera, frame
from evetac_cli.stages import per_file
from evetac_cli.store.files import up_to_date, write_stage
from evetac_cli.store.provenance import Recipe
from evetac_cli.store.read import open_recording

OUTPUT = "tracks"
METHOD = 1
PRESET = "rgb"
SENSOR = ("sensor/frame_px", "sensor/name", "sensor/dot_xy_px", "sensor/dot_radius_px", "sensor/window_px")


def jobs(files: list[Path], params: TrackRgb, out: Path | None) -> list[Job]:
    """One tracks file for every recording."""
    if out is None:
        return [job for file in files for job in per_file([file], OUTPUT, file.parent / PRESET)]
    return per_file(files, OUTPUT, out)


def run(job: Job, params: TrackRgb, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Render the frames of a recording and follow the dots in them."""
    camera = RgbCamera()
    with open_recording(job.inputs[0]) as recording:
        parameters = {"preset": PRESET, "camera": dataclasses.asdict(camera), **recipe_of(params)}
        recipe = Recipe(OUTPUT, METHOD, parameters, seed=params.seed, parents=(recording.header,))
        if not recording.has("truth"):
            raise InputError(
                "no frames can be rendered: only a simulation knows where the gel is",
                where=str(recording.path),
                hint="give a simulated recording",
            )
        if up_to_date(job.output, recipe, force=force):
            return outcome(job, made=False, simulated=True)
        true_px = recording.read("truth/dot_xy_px").astype(float)
        arrays = {name: recording.read(name) for name in SENSOR if recording.has(name)}
    slices, dots = true_px.shape[:2]
    scale = np.array(camera.frame_px) / arrays["sensor/frame_px"]
    radius_px = float(arrays["sensor/dot_radius_px"]) * float(scale.mean())
    rng = np.random.default_rng([params.seed, int(recipe.parents[0]["id"][:8], 16)])

    def render(dot_xy_px: np.ndarray) -> np.ndarray:  # pixels are counted from their centres
        return frame(camera, (dot_xy_px + 0.5) * scale - 0.5, radius_px, rng)

    rest_px = arrays["sensor/dot_xy_px"].reshape(-1, 2)
    followed = np.empty((slices, dots, 2), np.float32)
    lost = np.empty((slices, dots), np.uint8)
    state = frame_tracker.start(render(rest_px), (rest_px + 0.5) * scale - 0.5)
    for first in range(0, slices, camera.frame_ms):
        frame_tracker.step(state, render(true_px[first]))
        shown = slice(first, first + camera.frame_ms)
        followed[shown] = (state.dot_xy_px + 0.5) / scale - 0.5
        lost[shown] = state.lost
        progress(first // camera.frame_ms, -(-slices // camera.frame_ms))
    arrays |= {"dot_xy_px": followed, "events_per_dot": np.zeros((slices, dots), np.int32), "lost": lost}
    write_stage(job.output, recipe, arrays)
    moved = np.linalg.norm(followed - rest_px.astype(np.float32), axis=2)
    return outcome(
        job,
        made=True,
        simulated=True,
        frames=-(-slices // camera.frame_ms),
        dots=dots,
        max_displacement_px=float(moved.max(initial=0.0)),
        dots_lost=int(lost[-1].sum()) if slices else 0,
    )
