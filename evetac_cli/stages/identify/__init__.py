"""identify: estimate a sensor from its recordings, as a TOML file for `--sensor`, each key with its interval.

The noise of the camera is estimated from the longest rest in the recordings, dots and optics from the recording with
the most moving dots, gripper and gel from recordings with rows of a gripper. Parameters that no recording determines
keep the value of the sensor given by `--like`.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.identify import Identify
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX
from evetac_cli.jobs import Job, Outcome, Progress, Stage, outcome, silent
from evetac_cli.sim.setup import plan, sensor_file
from evetac_cli.sim.setup.sensor import Sensor
from evetac_cli.sim.setup.sensor_file import FOR_EACH_TRIAL
from evetac_cli.stages import output_in
from evetac_cli.stages.identify.sensor_text import NOT_ESTIMATED, Entry, EstimateRow, sensor_text
from evetac_cli.store.files import stem
from evetac_cli.store.hdf5.disk import Recheck, taking_the_place_of
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.store.recordings.read import UNKNOWN_SENSOR, open_recording

OUTPUT = "sensor"
METHOD = 5


def jobs(files: list[Path], params: Identify, out: Path | None) -> list[Job]:
    """Return the job of one sensor from all recordings, `<first recording's name>.sensor.toml`."""
    if params.like.endswith(sensor_file.SUFFIX) or params.like in FOR_EACH_TRIAL:
        expected = "a named sensor, e.g. evetac or randomized:7"
        raise InputError("not the name of one sensor", where="--like", expected=expected, found=params.like)
    plan.one_sensor(params.like)
    sensor_file.check_name(params.name, "--name")
    name = f"{stem(files[0])}.{OUTPUT}.toml"
    return [Job(tuple(files), output_in(out, files[0].parent, name, sensor_file.SUFFIX))]


def run(job: Job, params: Identify, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Estimate the sensor from the recordings, return the estimates as rows, and write the sensor's file."""
    recipe = Recipe(OUTPUT, METHOD, recipe_of(params), parents=_headers(job.inputs))
    if _up_to_date(job.output, recipe, force=force):
        return outcome(job, made=False, simulated=recipe.simulated)
    from evetac_cli.stages.identify import gripped, gripper_rows, pressed

    like = plan.one_sensor(params.like)
    mm_per_px = like.mm_per_px if params.pixel_mm is None else params.pixel_mm
    printed_xy = _printed(like)
    rests, grips, others = [], [], []
    steps = 2 * len(job.inputs)
    for number, path in enumerate(job.inputs):
        noise_rng, press_rng, servo_rng = np.random.default_rng([params.seed, number]).spawn(3)
        with open_recording(path) as recording:
            if recording.has("gripper/t_us"):  # while the gripper holds still, the gel creeps, so it is not at rest
                grips.append(gripped.find(recording, mm_per_px, servo_rng))
            else:
                rests.append(pressed.longest_rest(recording, noise_rng))
                others.append((path, press_rng))
        progress(number + 1, steps)
    rest = max((one for one in rests if one), key=lambda one: one[0].duration_s, default=None)
    noise_hz = rest[0].noise_hz.value if rest else 0.0
    presses, no_press = [], {}
    for number, (path, press_rng) in enumerate(others):
        with open_recording(path) as recording:
            try:
                presses.append(pressed.find(recording, like.log_contrast, printed_xy, noise_hz, press_rng))
            except ValueError as error:
                no_press[recording.event_count] = f"{path.name}: {error}"
        progress(len(job.inputs) + number + 1, steps)
    progress(steps, steps)
    rows, values = pressed.rest_rows(rest)
    best = max(presses, key=lambda one: one.dots, default=None)
    why_none = no_press[max(no_press)] if no_press else ""  # of the recording with most events, as a press has
    more_rows, more = pressed.rows(best, like, why_none)
    rows, values = rows + more_rows, more | values
    more_rows, more = gripper_rows.rows([one for one in grips if one is not None], params, like)
    rows, values = rows + more_rows, values | more
    if params.pixel_mm is not None:
        values["mm_per_px"] = Entry(mm_per_px, None, "as given")
    text = sensor_text(params.name, params.like, values, recipe, [path.name for path in job.inputs])
    recheck = Recheck(partial(_up_to_date, job.output, recipe, force=force))
    with taking_the_place_of(job.output, sensor_file.SUFFIX, recheck) as temporary:
        temporary.write_text(text)
        try:
            sensor_file.read(temporary, plan.one_sensor)  # a sensor that record would refuse is not written
        except InputError as error:
            message = f"the estimated sensor cannot be simulated: {error.message}"
            where = ", ".join(map(str, job.inputs))
            raise InputError(message, where=where, expected=error.expected, found=error.found) from None
    status = "made" if recheck.made else "up to date"
    summary = {"sensor": str(job.output), "status": status, "all_other_keys": f"as in {params.like}; {NOT_ESTIMATED}"}
    if unused := _unused(job.inputs, rows):
        summary["nothing_is_taken_from"] = ", ".join(unused)
    return Outcome(table(rows), recipe.simulated, summary, made=recheck.made)


def _headers(paths: Sequence[Path]) -> tuple[Header, ...]:
    """Return the headers of the recordings.

    InputError if a recording is given twice, if they are from different sensors, or from one that cannot be simulated.
    An imported recording has no sensor name.
    """
    headers: dict[str, tuple[Path, Header]] = {}
    sensors: dict[tuple[str, bool], Path] = {}
    for path in paths:
        with open_recording(path) as recording:
            header, frame_px, name = recording.header, recording.frame_px, str(recording.read("sensor/name"))
        if frame_px != FRAME_PX:
            expected, found = ("{} x {} px".format(*size) for size in (FRAME_PX, frame_px))
            message = "sensors with this frame size cannot be simulated"
            raise InputError(message, where=str(path), expected=expected, found=found)
        if header["id"] in headers:
            other = f"the same events as {headers[header['id']][0]}"
            raise InputError("a recording is given twice", where=str(path), expected="each once", found=other)
        headers[header["id"]] = path, header
        sensors.setdefault((name, header["simulated"]), path)
    sensor_names = {name for name, _ in sensors} - {UNKNOWN_SENSOR}
    if len(sensor_names) > 1 or len({simulated for _, simulated in sensors}) > 1:
        named = (f"{name}{' (simulated)' * simulated} in {path.name}" for (name, simulated), path in sensors.items())
        raise InputError("recordings of different sensors", where=str(paths[0]), found="; ".join(named))
    return tuple(header for _, header in headers.values())


def _unused(paths: Sequence[Path], rows: Sequence[EstimateRow]) -> list[str]:
    """Return the names of the recordings from which no estimate was made."""
    sources = "".join(f", {row.source}, " for row in rows if row.estimate is not None)
    return [path.name for path in paths if f", {path.name}, " not in sources]


def _printed(sensor: Sensor) -> NDArray[np.float64]:
    """Return the printed positions of the dots, (rows, columns, 2), on the sensor's columns and rows."""
    columns, rows = (np.array(lines, np.float64) for lines in (sensor.dot_columns_px, sensor.dot_rows_px))
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def table(rows: Sequence[EstimateRow]) -> list[dict[str, Any]]:
    """Return flat rows for the table and --json."""
    return [
        {
            "parameter": row.parameter,
            "unit": row.unit or None,
            "estimate": None if row.estimate is None else float(row.estimate.value),
            "low": None if row.estimate is None else float(row.estimate.low),
            "high": None if row.estimate is None else float(row.estimate.high),
            "from": row.source,
        }
        for row in rows
    ]


def _up_to_date(path: Path, recipe: Recipe, *, force: bool) -> bool:
    """Whether the file was made with this recipe; InputError if it was not and must not be replaced."""
    if force or not path.exists():
        return False
    try:
        written = path.read_text(encoding="utf-8").splitlines()[:5]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("cannot be read", where=str(path), found=str(error)) from None
    if f"# recipe {recipe.id}" in written:
        return True
    hint = "--force replaces it, -o NAME writes to another file"
    raise InputError("the file exists and was made with another recipe, or by hand", where=str(path), hint=hint)


STAGE = Stage(jobs, run)
