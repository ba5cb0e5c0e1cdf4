"""Make the recording of dots that another simulator moved: their events, and as truth what the file has.

The camera is that of a simulated sensor (sim/simulated_camera.py), so that all later stages work as on evetac's own
scenes. Truth between the file's times is interpolated linearly; slip is that of the time before.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from evetac_cli.commands.record import Record
from evetac_cli.events import SLICES_PER_S
from evetac_cli.formats.read.dot_motion import DotMotion, read_motion
from evetac_cli.jobs import Job, Outcome, Progress, outcome
from evetac_cli.sim.setup.tables import as_table
from evetac_cli.store.files import up_to_date
from evetac_cli.store.layout.provenance import ContentDigest, Recipe
from evetac_cli.store.recordings.trial_writer import TrialWriter
from evetac_cli.trials.trial import OUTPUT

if TYPE_CHECKING:  # imports numba
    from evetac_cli.sim.simulated_camera import SeenSlice, SimulatedCamera

METHOD = 1
PROGRESS_TIMES = 50  # of the file, after which progress is shown


@dataclass(frozen=True)
class GivenDots(Job):
    """One recording to make from a file of moving dots, its only input."""


def run(job: GivenDots, params: Record, *, force: bool, progress: Progress) -> Outcome:
    """Play the motion in front of the sensor's camera, and write the recording."""
    from evetac_cli.devices.simulated import described  # imports numba, as the next does
    from evetac_cli.sim.simulated_camera import SimulatedCamera

    motion = read_motion(job.inputs[0])
    rng = np.random.default_rng([params.seed])
    camera = SimulatedCamera(motion.dot_xy[0], params.sensor, rng=rng, unit=motion.unit)
    recipe = _recipe(job, params, motion, camera)
    if up_to_date(job.output, recipe, force=force):
        return outcome(job, made=False, simulated=True)
    datasets: dict[str, Any] = {
        **described(camera.name, camera.sensor, camera.gel_camera),
        "t_offset": np.int64(0),
        "truth/sampled_parameters": "{}",
    }
    written = event_count = 0
    with TrialWriter(job.output, datasets, force=force) as writer:
        for number, seen in enumerate(_played(camera, motion)):
            for one in seen:
                written += 1
                event_count += one.events.size
                writer.append(one.events, {"truth/dot_xy_px": one.dot_xy_px, **_truth(motion, written)})
            if number % PROGRESS_TIMES == 0:
                progress(number, len(motion.t_s))
        made = writer.finish(recipe)
    return outcome(job, made=made, simulated=True, slices=written, events=event_count)


def _played(camera: "SimulatedCamera", motion: DotMotion) -> Iterator[tuple["SeenSlice", ...]]:
    """Yield the slices that each time of the file makes known, and the last ones."""
    for t_s, places in zip(motion.t_s, motion.dot_xy, strict=True):
        yield camera.step(float(t_s), places)
    yield camera.finish()


def _truth(motion: DotMotion, slices: int) -> dict[str, Any]:
    """Return the rows of the truth at the end of a slice."""
    at_s = motion.t_s[0] + slices / SLICES_PER_S
    rows: dict[str, Any] = {}
    for name, values in motion.truth.items():
        columns = values.reshape(len(values), -1).T
        row = np.array([np.interp(at_s, motion.t_s, column) for column in columns])
        rows[f"truth/{name}"] = row if values.ndim == 2 else row[0]
    if "slip" in motion.truth:  # as it was last said to be
        last = np.searchsorted(motion.t_s, at_s + 1e-9, side="right") - 1
        rows["truth/slip"] = motion.truth["slip"][last] > 0
    if "slip_share" in motion.truth:
        rows["truth/visible_slip_share"] = rows["truth/slip_share"]
    return rows


def _recipe(job: GivenDots, params: Record, motion: DotMotion, camera: "SimulatedCamera") -> Recipe:
    digest = ContentDigest()
    digest.update_all({"t_s": motion.t_s, "dot_xy": motion.dot_xy, **motion.truth})
    parameters = {
        "source": job.inputs[0].name,
        "unit": motion.unit,
        "sensor": camera.name,
        "sensor_row": as_table(camera.sensor),
    }
    return Recipe(OUTPUT, METHOD, parameters, seed=params.seed, content=digest.hexdigest(), simulated_source=True)
