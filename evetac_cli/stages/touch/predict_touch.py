"""predict-touch: forces, position, torsion and maps of a touch in each slice, from tracks."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.commands.parameter import recipe_of, refuse_unused
from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.errors import InputError
from evetac_cli.events import SLICES_PER_S
from evetac_cli.jobs import Job, Outcome, Progress, Stage, outcome, silent
from evetac_cli.names import TouchOption
from evetac_cli.stages import per_file, row_blocks
from evetac_cli.stages.touch import known_gel
from evetac_cli.stages.touch.known_gel import GelShape, KnownGel
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.store.recordings.read import UNKNOWN_SENSOR

OUTPUT = "touch"
METHOD = 1
SHAPE_FLAGS = {"height_mm", "print_depth_mm", "lens_mm", "gel_mm"}  # stored in a model


def jobs(files: list[Path], params: PredictTouch, out: Path | None) -> list[Job]:
    """Return a job for every tracks file."""
    has = [TouchOption.OF_NO_MODEL] if params.model is None else []
    has += [] if params.sensor is None else [TouchOption.SENSOR]
    refuse_unused(params, has, "--model" if params.model is not None else "no --sensor", never=[TouchOption.TOUCH])
    of_model = () if params.model is None else (params.model,)
    return [Job((*job.inputs, *of_model), job.output) for job in per_file(files, OUTPUT, out)]


def run(job: Job, params: PredictTouch, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Apply the touch map to the tracks, slice by slice, and store a row for every slice, and some maps."""
    path, *models = job.inputs
    gel_values = known_gel.known_of(params.sensor)
    own = known_gel.read_own(models[0]) if models else None
    with StageFile(path, "tracks") as tracks:
        if own is None:
            known_gel.check_scale(tracks, gel_values)
            gel = known_gel.gel_of(gel_values, params.stiffness_error, GelShape.of(params, gel_values))
        else:
            _check_sensor(tracks, own[1], models[0])
            gel = own[2]
        recipe = _recipe(params, gel_values, tracks.header, None if own is None else own[0])
        if up_to_date(job.output, recipe, force=force):
            return outcome(job, made=False, simulated=recipe.simulated)
        from evetac_cli.stages.touch import touch_fold  # brings scipy

        slices, summary = tracks.length("dot_xy_px"), _Summary()
        fold = touch_fold.TouchFold(gel, tracks, params.map_every, compares=params.leave_out_wrong)
        cells = fold.state.cells
        arrays = {"map/x_mm": cells.x_mm, "map/y_mm": cells.y_mm} if params.map_every else {}
        lengths = dict.fromkeys(touch_fold.COLUMNS, slices)
        if params.map_every:
            maps = ("slice", *touch_fold.OF_MAP)
            lengths |= dict.fromkeys((f"map/{name}" for name in maps), -(-slices // params.map_every))

        def blocks() -> Iterator[dict[str, Any]]:
            for first, stop in row_blocks(slices):
                columns = fold.block(first, stop)
                summary.add(columns)
                yield columns
                progress(stop, slices)

        made = write_stage(job.output, recipe, arrays, blocks(), lengths, force=force) is not None
    modulus = "adapted" if own is not None else "unknown" if gel_values.shear_modulus_pa is None else "known"
    return outcome(job, made=made, simulated=recipe.simulated, shear_modulus=modulus, **summary.row())


def _recipe(params: PredictTouch, gel_values: KnownGel, tracks: Header, own: Header | None) -> Recipe:
    """Return the recipe, without parameters that have no effect: error of an unknown sensor, shape with a model."""
    unused = set() if params.sensor is not None else {"stiffness_error"}
    unused |= set() if own is None else SHAPE_FLAGS
    parameters: dict[str, Any] = {name: value for name, value in recipe_of(params).items() if name not in unused}
    parameters |= {"known": gel_values.for_recipe()} if params.sensor is not None else {}
    return Recipe(OUTPUT, METHOD, parameters, parents=(tracks,) if own is None else (tracks, own))


def _check_sensor(tracks: StageFile, adapted_to: str, model: Path) -> None:
    """Raise InputError if the tracks are not from the sensor to which the model was adapted."""
    name = str(tracks.read("sensor/name"))
    if len({name, adapted_to} - {UNKNOWN_SENSOR}) > 1:
        message, expected = (
            "not the tracks of the sensor to which the model was adapted",
            f"{adapted_to}, as in {model}",
        )
        raise InputError(message, where=str(tracks.path), expected=expected, found=name)


class _Summary:
    """Collects the figures for a file's row, block by block."""

    def __init__(self) -> None:
        self.slices = self.maps = self.touched = 0
        self.unknown = 0
        self.most: dict[str, tuple[float, float]] = {}

    def add(self, columns: dict[str, Any]) -> None:
        """Add the columns of one block."""
        self.slices += len(columns["known"])
        self.maps += len(columns.get("map/slice", ()))
        self.touched += int(columns["touches"].sum())
        self.unknown += int((columns["known"] == 0).sum())
        shear = np.linalg.norm(columns["shear_n"], axis=1)
        self._most("shear_n", shear, columns["shear_sd_n"].max(axis=1, initial=0.0))
        self._most("normal_n", columns["normal_n"], columns["normal_sd_n"])
        self._most("torsion_n_mm", np.abs(columns["torsion_n_mm"]), columns["torsion_sd_n_mm"])

    def _most(self, name: str, value: Floats, sd: Floats) -> None:
        touched = np.isfinite(value) & np.isfinite(sd)
        if touched.any():
            at = int(np.argmax(np.where(touched, value, -np.inf)))
            self.most[name] = max(self.most.get(name, (-np.inf, np.nan)), (float(value[at]), float(sd[at])))

    def row(self) -> dict[str, Any]:
        """Return the row; maxima are None for a recording without touch."""
        most: dict[str, float | None] = {}
        for name in ("shear_n", "normal_n", "torsion_n_mm"):
            value, sd = self.most.get(name, (None, None))
            most |= {f"max_{name}": value, f"max_{name}_sd": sd}
        times = {"touched_s": self.touched / SLICES_PER_S, "unknown_s": self.unknown / SLICES_PER_S}
        return {"slices": self.slices, "maps": self.maps, **times, **most}


STAGE = Stage(jobs, run)
