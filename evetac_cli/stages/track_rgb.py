"""track --rgb: dot tracks of an RGB sensor at 25 Hz (paper, "Dot-based Shear Force Reconstruction").

The gel of a simulated recording is rendered as frames from its true motion, and its dots are tracked by optical flow.
The files are like tracks from events; between two frames the dots keep their position in the last frame.

Without `-o` the files go to the folder `rgb` next to the recording, because tracks from its events have the same name.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.track import Track
from evetac_cli.jobs import Job, Outcome, Progress, outcome, silent
from evetac_cli.sim.camera.rgb_sensor import RgbCamera, frame, start_tracker, track
from evetac_cli.sim.setup.object_file import seed_of
from evetac_cli.stages import per_file, row_blocks
from evetac_cli.stages.related_files import no_truth
from evetac_cli.store.files import up_to_date, write_stage
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.store.recordings.read import open_recording

OUTPUT = "tracks"
COLUMNS = ("dot_xy_px", "events_per_dot", "lost")  # one row per slice
METHOD = 2
PRESET = "rgb"
FRAMES = 25  # frames whose ground truth is read together
NOISE_SEED = 32452843  # separates the noise of frames from the random numbers of the recording
SENSOR = ("sensor/frame_px", "sensor/name", "sensor/dot_xy_px", "sensor/dot_radius_px", "sensor/window_px")


def jobs(files: list[Path], params: Track, out: Path | None) -> list[Job]:
    """Return a job for every recording."""
    if out is None:
        return [job for file in files for job in per_file([file], OUTPUT, file.parent / PRESET)]
    return per_file(files, OUTPUT, out)


def noise_seeds(seed: int, header: Header) -> list[int]:
    """Return the seeds of the frames' noise for the recording with this header: numbers that identify its trial.

    Different trials have different noise. The recording's recipe id would also identify the trial, but it changes with
    the name of any parameter, and the noise would change with it.
    """
    parameters = header["parameters"]
    tone_mhz = round(1000 * parameters.get("tone_hz", 0.0))
    from_ms = parameters.get("trimmed", {}).get("from_ms", 0)
    return [
        NOISE_SEED,
        seed,
        header["seed"] or 0,
        seed_of(parameters.get("object")),
        parameters.get("trial", 0),
        tone_mhz,
        from_ms,
    ]


def run(job: Job, params: Track, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Render the frames of a recording and track the dots in them."""
    camera = RgbCamera()
    with open_recording(job.inputs[0]) as recording:
        parameters = {"preset": PRESET, "camera": dataclasses.asdict(camera), "seed": params.seed}
        recipe = Recipe(OUTPUT, METHOD, parameters, seed=params.seed, parents=(recording.header,))
        if not recording.has("truth"):
            raise no_truth(recording.path)
        if up_to_date(job.output, recipe, force=force):
            return outcome(job, made=False, simulated=True)
        arrays = {name: recording.read(name) for name in SENSOR if recording.has(name)}
        slices, dots = len(recording), arrays["sensor/dot_xy_px"].size // 2
        scale = np.array(camera.frame_px) / arrays["sensor/frame_px"]
        radius_px = float(arrays["sensor/dot_radius_px"]) * float(scale.mean())
        rng = np.random.default_rng(noise_seeds(params.seed, recipe.parents[0]))

        def render(dot_xy_px: NDArray[Any]) -> NDArray[Any]:  # pixels are counted from their centres
            return frame(camera, (dot_xy_px + 0.5) * scale - 0.5, radius_px, rng)

        rest_px = arrays["sensor/dot_xy_px"].reshape(-1, 2)
        state = start_tracker(render(rest_px), (rest_px + 0.5) * scale - 0.5)
        farthest_px = 0.0

        def followed() -> Iterator[dict[str, NDArray[Any]]]:
            nonlocal farthest_px
            for first, stop in row_blocks(slices, FRAMES * camera.frame_ms):
                true_px = recording.read("truth/dot_xy_px", first, stop).astype(float)
                dot_xy_px = np.empty((stop - first, dots, 2), np.float32)
                lost = np.empty((stop - first, dots), np.uint8)
                for at in range(0, stop - first, camera.frame_ms):
                    track(state, render(true_px[at]))
                    dot_xy_px[at : at + camera.frame_ms] = (state.dot_xy_px + 0.5) / scale - 0.5
                    lost[at : at + camera.frame_ms] = state.lost
                    progress((first + at) // camera.frame_ms, -(-slices // camera.frame_ms))
                moved = np.linalg.norm(dot_xy_px - rest_px.astype(np.float32), axis=2)
                farthest_px = float(moved.max(initial=farthest_px))
                yield {
                    "dot_xy_px": dot_xy_px,
                    "events_per_dot": np.zeros((stop - first, dots), np.int32),
                    "lost": lost,
                }

        made = (
            write_stage(job.output, recipe, arrays, followed(), dict.fromkeys(COLUMNS, slices), force=force) is not None
        )
    return outcome(
        job,
        made=made,
        simulated=True,
        frames=-(-slices // camera.frame_ms),
        dots=dots,
        max_displacement_px=farthest_px,
        dots_lost=int(state.lost.sum()) if slices else 0,
    )
