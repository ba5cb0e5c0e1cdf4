"""Force-model files of touch maps: written by `train-force --method touch`, read by `predict-touch --model`."""

from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.kernels.force.gel_forces import CREEP_ARMS, ForceErrorModel, Scale
from evetac_cli.kernels.touch.dot_motion import ENDLESS_MM
from evetac_cli.stages.touch.known_gel import GelShape, GelWeights
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.provenance import Header

KIND = "force-model"
MADE = "a model of train-force --method touch"
SHAPE = ("height_mm", "print_depth_mm", "lens_mm")  # numbers of a GelShape
SHAPES = {  # shapes that the schema leaves open
    "adapted/shear_covariance": (2, CREEP_ARMS + 2, CREEP_ARMS + 2),
    "adapted/normal": (3,),
    "adapted/normal_covariance": (3, 3),
    "adapted/creep_time_s": (CREEP_ARMS,),
    "adapted/edges_mm": (4,),
    "adapted/errors": (len(ForceErrorModel._fields),),
}


def arrays_of(gel: GelWeights) -> dict[str, Any]:
    """Return the datasets of an adapted scale."""
    return {
        **{f"adapted/{name}": values for name, values in gel.scale._asdict().items()},
        **{f"adapted/{name}": np.float64(getattr(gel.shape, name)) for name in SHAPE},
        "adapted/edges_mm": np.where(np.isfinite(gel.shape.edges_mm), gel.shape.edges_mm, np.nan),
        "adapted/modulus_pa": np.float64(gel.modulus_pa),
        "adapted/mm_per_px": np.float64(gel.mm_per_px),
        "adapted/mm_log_sd": np.float64(gel.mm_log_sd),
        "adapted/creep_time_s": gel.creep_time_s,
        "adapted/errors": np.array(gel.errors),
    }


def read_own(path: Path) -> tuple[Header, str, GelWeights]:
    """Return header, sensor name and weights of an adapted model; InputError for a model of the paper's method."""
    with StageFile(path, KIND) as file:
        if not file.has("adapted"):
            raise InputError(
                "the force model is of the paper's method, which only `evetac evaluate force` uses",
                where=str(path),
                expected=MADE,
                hint="leave out --model, which predict-touch does not need",
            )
        stored = file.contents()
        for name, shape in SHAPES.items():
            if stored[name][1] != shape:
                raise InputError(
                    f"{name} has a different shape than in this version of evetac",
                    where=str(path),
                    expected=str(shape),
                    found=str(stored[name][1]),
                    hint="train it again",
                )
        return file.header, str(file.read("sensor_name")), _weights(file)


def _weights(file: StageFile) -> GelWeights:
    def number(name: str) -> float:
        return float(file.read(f"adapted/{name}"))

    return GelWeights(
        number("modulus_pa"),
        GelShape(number("height_mm"), number("print_depth_mm"), number("lens_mm"), _edges(file)),
        number("mm_per_px"),
        number("mm_log_sd"),
        Scale(*(file.read(f"adapted/{name}") for name in Scale._fields)),
        file.read("adapted/creep_time_s"),
        ForceErrorModel(*file.read("adapted/errors").tolist()),
    )


def _edges(file: StageFile) -> tuple[float, float, float, float]:
    """Return the edges of a gel; NaN in the file marks an edge that is far away."""
    stored = file.read("adapted/edges_mm")
    x0, y0, x1, y1 = (float(edge) for edge in np.where(np.isnan(stored), ENDLESS_MM, stored))
    return x0, y0, x1, y1
