"""Prior knowledge of a sensor's gel: values from a sensor's file, and expected values for an unknown gel.

Force-model files of touch maps are written by `train-force --method touch` and read by `predict-touch --model`.
"""

from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.force import gel_forces
from evetac_cli.kernels.force.gel_forces import CREEP_ARMS, ForceErrorModel, Scale, Stiffness
from evetac_cli.kernels.touch.dot_motion import ENDLESS_MM, GelLayer
from evetac_cli.sim.setup import sensor_file
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.sim.setup.sensor import GelCreep, Sensor
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.provenance import Header
from evetac_cli.text_files import read_toml

# Expected values of an unknown gel: medians and spreads of 2000 sensors drawn from `randomized` (data/sensors.toml),
# whose ranges are wider than published values of gels, because those ranges were guessed.
SHEAR_MODULUS_PA, SHEAR_LOG_SD = 121e3, 0.53
MM_PER_PX, MM_LOG_SD = 0.0315, 0.046
CREEP_SHARE, CREEP_SD, CREEP_TIME_S = (0.05, 0.05), (0.029, 0.029), (0.32, 4.4)
LENGTHS_IN_FORCE = 3  # powers of mm_per_px in force over modulus: one from the dots' motion, two from the patch's area
TRACKER_PX, DRIFT_PX = 0.05, 0.2  # sd of each tracked dot's error, and of the common error of all dots, see DotNoise


class KnownGel(NamedTuple):
    """Values of a gel from `--sensor`; None if not given. For a gel without creep, the arms are empty."""

    shear_modulus_pa: float | None = None
    mm_per_px: float | None = None
    creep: tuple[tuple[float, ...], tuple[float, ...]] | None = None  # share and time, in s, of its arms
    edges_mm: tuple[float, float, float, float] | None = None  # edges of the gel, see GelLayer

    def for_recipe(self) -> dict[str, Any]:
        """Return the known values for a recipe."""
        values = {name: value for name, value in self._asdict().items() if value is not None}
        if self.creep is not None:
            values["creep"] = dict(zip(("share", "time_s"), map(list, self.creep), strict=True))
        return values


class GelShape(NamedTuple):
    """A gel's thickness, depth of its dots, distance to the lens and edges, which a touch map assumes."""

    height_mm: float = 4.0
    print_depth_mm: float = 0.0
    lens_mm: float = 25.0
    edges_mm: tuple[float, float, float, float] = ENDLESS_MM

    @classmethod
    def of(cls, params: PredictTouch | TrainForce, gel_values: KnownGel) -> Self:
        """Return the shape from flags; edges that the flags do not set are the known ones."""
        edges = _typed_edges(params.gel_mm) if params.gel_mm else gel_values.edges_mm or ENDLESS_MM
        return cls(params.height_mm, params.print_depth_mm, params.lens_mm, edges)

    def layer(self, modulus_pa: float) -> GelLayer:
        """Return the elastic layer with this shape."""
        return GelLayer(self.height_mm, modulus_pa, 0.5, self.print_depth_mm, self.lens_mm, self.edges_mm)


class GelWeights(NamedTuple):
    """All values that convert the dots of one sensor to forces.

    modulus_pa: modulus with which touch maps are computed. scale: weights of force over this modulus. mm_log_sd: sd of
    the logarithm of mm_per_px; its effect on forces is part of the scale's covariance.
    """

    modulus_pa: float
    shape: GelShape
    mm_per_px: float
    mm_log_sd: float
    scale: Scale
    creep_time_s: Floats
    errors: ForceErrorModel


def gel_of(gel_values: KnownGel, stiffness_error: float, shape: GelShape | None = None) -> GelWeights:
    """Return the weights for a sensor with this prior knowledge.

    stiffness_error: sd of the logarithm of a known modulus. An unknown scale makes forces less certain.
    """
    shape = GelShape(edges_mm=gel_values.edges_mm or ENDLESS_MM) if shape is None else shape
    mm_per_px, mm_log_sd = (MM_PER_PX, MM_LOG_SD) if gel_values.mm_per_px is None else (gel_values.mm_per_px, 0.0)
    modulus_pa, log_sd = SHEAR_MODULUS_PA, SHEAR_LOG_SD
    if gel_values.shear_modulus_pa is not None:
        modulus_pa, log_sd = gel_values.shear_modulus_pa, stiffness_error
    share, sd, time_s = map(np.array, (CREEP_SHARE, CREEP_SD, CREEP_TIME_S))
    if gel_values.creep is not None:
        arms = gel_forces.CREEP_ARMS
        share, sd = np.array(_padded(gel_values.creep[0], arms, 0.0)), np.zeros(arms)
        time_s = np.array(_padded(gel_values.creep[1], arms, 1.0))
    stiffness = Stiffness(modulus_pa * 1e-6, float(np.hypot(log_sd, LENGTHS_IN_FORCE * mm_log_sd)), share, sd, time_s)
    scale = gel_forces.scale_of(stiffness)
    return GelWeights(modulus_pa, shape, mm_per_px, mm_log_sd, scale, time_s, ForceErrorModel())


def _padded(values: Sequence[float], size: int, by: float) -> list[float]:
    return [*map(float, values), *[by] * size][:size]


def known_of(sensor: str | None) -> KnownGel:
    """Return the values of a gel from `--sensor`: from a file only the keys that it sets, from a named sensor all."""
    if sensor is None:
        return KnownGel()
    if not sensor.endswith(sensor_file.SUFFIX):
        return _values_of(one_sensor(sensor), KnownGel._fields)
    _, own = sensor_file.read(Path(sensor), one_sensor)
    return _values_of(own, read_toml(Path(sensor)))


def _values_of(sensor: Sensor, keys: Container[str]) -> KnownGel:
    """Return the values of a sensor's gel for these keys; the gel creeps only if the sensor has creep."""
    arms = sensor.creep or GelCreep(share=(), time_s=())
    whole = KnownGel(sensor.shear_modulus_pa, sensor.mm_per_px, (arms.share, arms.time_s), edges_of(sensor))
    return KnownGel(**{name: value for name, value in whole._asdict().items() if name in keys})


def expected_mm_per_px(frame_px: Sequence[int] | NDArray[np.integer]) -> float:
    """Return the expected scale of a frame (width, height), which shows as much of a gel as an Evetac's, lengthwise."""
    return MM_PER_PX * (max(FRAME_PX) / max(frame_px))


def edges_of(sensor: Sensor) -> tuple[float, float, float, float]:
    """Return the edges of a simulated sensor's gel before it is cut, in mm from the middle of the frame."""
    x0, y0, x1, y1 = (round(1e3 * edge, 6) for edge in sensor.pad_m(cut=False))
    return x0, y0, x1, y1


def _typed_edges(text: str) -> tuple[float, float, float, float]:
    """Return the edges of a gel from the flag, four numbers; InputError for anything else."""
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError:
        x0 = y0 = x1 = y1 = np.nan
    if not (x0 < x1 and y0 < y1):
        expected = "left, top, right and bottom edge in mm from the middle of the frame, e.g. -12.8,-7.5,10.5,7.5"
        raise InputError("not the edges of a gel", where="--gel-mm", expected=expected, found=text)
    return x0, y0, x1, y1


def at_window(
    shape: GelShape, window_px: Sequence[int] | None, frame_px: Sequence[int], mm_per_px: float, dot_mm: Floats
) -> GelShape:
    """Return the shape of a cut gel: it ends at its window (x0, y0, x1, y1) if that is a strip next to its dots."""
    if window_px is None:
        return shape
    middle = np.array(frame_px) / 2
    starts, ends = (np.array(window_px[:2]) - middle) * mm_per_px, (np.array(window_px[2:]) - middle) * mm_per_px
    edges = np.array(shape.edges_mm)
    for axis in (0, 1):
        if np.nanmax(dot_mm[:, axis]) < starts[axis]:
            edges[2 + axis] = min(edges[2 + axis], starts[axis])
        elif np.nanmin(dot_mm[:, axis]) > ends[axis]:
            edges[axis] = max(edges[axis], ends[axis])
    x0, y0, x1, y1 = (float(edge) for edge in edges)
    return shape._replace(edges_mm=(x0, y0, x1, y1))


def check_scale(tracks: StageFile, gel_values: KnownGel) -> None:
    """Raise InputError if the frame is not that of an Evetac, unless the size of a pixel on the gel is known.

    Otherwise displacements in mm would be wrong by the ratio of the scales, and forces by its third power.
    """
    width, height = (int(size) for size in tracks.read("sensor/frame_px"))
    if (width, height) == FRAME_PX or gel_values.mm_per_px is not None:
        return
    message, expected = "the scale of this frame is unknown", "{} x {} px, or --sensor with mm_per_px".format(*FRAME_PX)
    hint = 'measure mm_per_px with a ruler on the gel, and write it with like = "evetac" into a file for --sensor'
    raise InputError(message, where=str(tracks.path), expected=expected, found=f"{width} x {height} px", hint=hint)


KIND = "force-model"
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
            expected = "a model of train-force --method touch"
            raise InputError("the force model is of the paper's method", where=str(path), expected=expected)
        shapes = {name: shape for name, (_, shape) in file.contents().items() if name in SHAPES}
        if shapes != SHAPES:
            hint = "train it again"
            raise InputError(
                "arrays of another shape", where=str(path), expected=str(SHAPES), found=str(shapes), hint=hint
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
