"""By what a recording from devices is known, whether it belongs to a series, and whether the series may be written."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.devices import Rig
from evetac_cli.errors import InputError
from evetac_cli.jobs import Job
from evetac_cli.params import Record
from evetac_cli.stages.record.current_ramp import Hold
from evetac_cli.store.files import StageFile
from evetac_cli.store.provenance import Recipe, first_difference
from evetac_cli.store.segments import refuse_leftover

OUTPUT = "recording"
METHOD = 1  # of recordings from devices
OF_A_TRIAL = ("trial", "trajectory", "object", "object_row", "sensor_row", "drawn_holding_ma")  # may differ


def as_series(jobs: list[Job]) -> list[Job]:
    """The jobs, each with all outputs of the series, and with those that were taken before its first trial."""
    series = tuple(job.choice.get("outputs", (job.output,)) for job in jobs)
    taken = tuple(output for outputs in series for output in outputs if _is_taken(output))
    return [job._replace(choice={**job.choice, "series": series, "taken": taken}) for job in jobs]


def _is_taken(output: Path) -> bool:
    try:
        refuse_leftover(output)
    except InputError:
        return True
    return output.exists()


def refuse_taken(job: Job, *, again: str, hint: str, force: bool, resume: bool = False) -> None:
    """InputError where an output exists, or what broke off waits for repair: nothing moves for what is refused.

    Of this trial, or, unless the series goes on, of any before the first. again: what cannot be made again.
    """
    outputs: tuple[Path, ...] = job.choice.get("outputs", (job.output,))
    for output in outputs:
        if output.exists() and not force:
            raise InputError(f"the output exists, and {again} cannot be made again", where=str(output), hint=hint)
        refuse_leftover(output)
    if job.choice["taken"] and not (force or resume):
        raise InputError(
            "is not begun, because others of the series are there",
            where=str(job.output),
            found=", ".join(map(str, job.choice["taken"])),
            hint=hint,
        )


def recipe_of(
    job: Job,
    params: Record,
    rig: Rig,
    hold: Hold | None,
    asked_ma: float | None,
    sensor: Mapping[str, Any],
    trajectory: Mapping[str, Any],
) -> Recipe:
    """What is known of a recording beforehand; its content stands in for the rest.

    asked_ma: the holding current as it is set up; None where every trial draws its own, which belongs to the trial.
    """
    drawn = {} if hold is None or asked_ma is not None else {"drawn_holding_ma": hold.holding_ma}
    calibrated = {name: np.asarray(value).tolist() for name, value in sensor.items() if name.startswith("sensor/")}
    parameters = {
        **job.choice.get("plan", {}),
        **trajectory,
        "trial": job.choice["trial"],
        "setup": dict(rig.setup),
        "sensor": without_nan(calibrated),
        "handling": None if hold is None else {**asdict(hold), "holding_ma": asked_ma},
        **drawn,
        "handling_seed": params.seed,
    }
    return Recipe(OUTPUT, METHOD, parameters, parents=rig.parents, simulated_source=rig.simulated)


def without_nan(value: Any) -> Any:
    """JSON has no NaN, which stands for a missing dot."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [without_nan(item) for item in value]
    return None if value != value else value


def header_of(path: Path) -> dict[str, Any]:
    """Header of a recording."""
    with StageFile(path, OUTPUT) as file:
        return file.header


def check_series(others: Iterable[Path], recipe: Recipe) -> None:
    """Refuse to go on with a series, the files of one camera, that was begun with another set-up."""
    for other in others:
        if not other.exists():
            continue
        header = header_of(other)
        same = {name: header["parameters"].get(name) for name in OF_A_TRIAL}
        wanted = {**recipe.parameters, **{name: value for name, value in same.items() if name in recipe.parameters}}
        now = Recipe(OUTPUT, METHOD, wanted, header["seed"], recipe.parents, header["content"], recipe.simulated_source)
        if now.id != header["id"]:
            raise InputError(
                "the series was begun with another set-up",
                where=str(other),
                found=first_difference(now, header),
                hint="set it up as it was, or begin a series of its own with -o",
            )
