"""By what a recording from devices is known, and whether it belongs to a series."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.devices import Rig
from evetac_cli.errors import InputError
from evetac_cli.params import Record
from evetac_cli.stages import Job
from evetac_cli.stages.handling import Hold
from evetac_cli.store.files import StageFile
from evetac_cli.store.provenance import Recipe, first_difference

OUTPUT = "recording"
METHOD = 1  # of recordings from devices
OF_A_TRIAL = ("trial", "trajectory", "object", "object_row", "individual_row")  # may differ within a series


def recipe_of(
    job: Job,
    params: Record,
    rig: Rig,
    hold: Hold | None,
    sensor: Mapping[str, Any],
    trajectory: Mapping[str, Any],
) -> Recipe:
    """What is known of a recording beforehand; its content stands in for the rest."""
    calibrated = {name: np.asarray(value).tolist() for name, value in sensor.items() if name.startswith("sensor/")}
    parameters = {
        **job.choice.get("plan", {}),
        **trajectory,
        "trial": job.choice["trial"],
        "setup": dict(rig.setup),
        "sensor": without_nan(calibrated),
        "handling": None if hold is None else asdict(hold),
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
