"""Touch maps applied to the tracks of a recording, block by block: forces and position in every slice, and some maps.

A touch map is computed with the expected modulus of the gel. `GelWeights` has the factors by which its forces are
multiplied, with their uncertainty, for a gel with creep or one adapted to known forces.

`StickingShare` is an additional input for slip detectors: the sticking share of a contact in each slice. It uses the
network of touch maps without the map itself, which takes milliseconds to compute, and assumes the expected scale of a
frame (known_gel.py). `featurize` applies it to tracks, and a detector trained with it to the dots that it tracks; both
give identical bits. The network is loaded from a file of named arrays, which contains no code.
"""

import functools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags, Floats
from evetac_cli.errors import InputError
from evetac_cli.kernels.force import gel_forces
from evetac_cli.kernels.force.gel_forces import CreepMemory, Forces
from evetac_cli.kernels.touch import rest, sticking, touch_map
from evetac_cli.kernels.touch.dot_motion import DotNoise
from evetac_cli.kernels.touch.sticking import StickingNetwork, StickingReading, StickingState
from evetac_cli.kernels.touch.touch_map import BEGINS, ENDS, TouchState, apart_rms
from evetac_cli.kernels.touch.touch_map import LEAST_DOTS as LEAST_TOUCHED
from evetac_cli.resources import STICKING_MODEL
from evetac_cli.stages import row_blocks
from evetac_cli.stages.touch.known_gel import DRIFT_PX, TRACKER_PX, GelWeights, at_window, expected_mm_per_px
from evetac_cli.store.files import StageFile


@functools.cache
def shipped_network() -> StickingNetwork:
    """Return the pretrained network."""
    with np.load(STICKING_MODEL, allow_pickle=False) as arrays:
        return StickingNetwork(**{name: arrays[name] for name in StickingNetwork._fields})


class StickingShare:
    """The sticking share after the slices so far, and the probability that slip has begun: `share` and `begun`.

    Both are NaN without contact or with too few known dots.
    """

    def __init__(self, rest_xy_px: NDArray[np.floating], frame_px: Sequence[int] | NDArray[np.integer]) -> None:
        """Start with the dots at rest, (dots, 2), NaN for missing ones, in a frame (width, height)."""
        self.share = self.begun = math.nan
        self._middle_px, self._scale = np.array(frame_px) / 2, expected_mm_per_px(frame_px)
        self._rest_mm: Floats = (np.asarray(rest_xy_px, np.float64) - self._middle_px) * self._scale
        noise = DotNoise(TRACKER_PX * self._scale, DRIFT_PX * self._scale)
        self._own_mm = noise.own_mm
        self._touches = False
        self._slices = 0
        self._state: StickingState | None = None
        if np.count_nonzero(np.isfinite(self._rest_mm).all(axis=1)) >= sticking.LEAST_DOTS:
            self._state = sticking.start(self._rest_mm, shipped_network(), noise)

    def step(self, dot_xy_px: NDArray[np.floating], lost: NDArray[np.bool_] | NDArray[np.uint8]) -> float:
        """Process one slice, with its dots (dots, 2) and which of them are lost (dots,), and return the share."""
        if self._state is None:
            return self.share
        # float32 as in tracks files, so that live dots and dots from a file are identical
        dot_mm = (np.asarray(dot_xy_px, np.float32) - self._middle_px) * self._scale
        gone: Flags = np.asarray(lost) != 0
        self._slices += 1
        if self._slices % rest.BLOCK_MS == 0:  # the interval of the network
            self._touches = self._is_touched(dot_mm, gone)
        self.share = sticking.step(self._state, dot_mm, gone, self._touches).sticking_share
        self.begun = math.nan if math.isnan(self.share) else self._state.has_begun
        return self.share

    def _is_touched(self, dot_mm: Floats, lost: Flags) -> bool:
        moved = dot_mm - self._rest_mm
        trusted = np.isfinite(moved[:, 0]) & np.isfinite(moved[:, 1]) & ~lost
        if np.count_nonzero(trusted) < LEAST_TOUCHED:
            return False
        return apart_rms(moved[trusted]) > (ENDS if self._touches else BEGINS) * self._own_mm


FLAGS = ("known", "touches")
SUMS = ("shear_n", "shear_sd_n", "normal_n", "normal_sd_n", "torsion_n_mm", "torsion_sd_n_mm")
PLACES = ("centre_mm", "centre_sd_mm", "area_mm2", "area_sd_mm2")
SINCE = ("shear_since_n", "shear_since_sd_n")
OF_READING = (*FLAGS, *SUMS, *PLACES, *SINCE)
PAIRS = ("shear_n", "shear_sd_n", "centre_mm", "centre_sd_mm", *SINCE)  # x and y
OF_MAP = ("patch", "shear_pa", "shear_sd_pa", "pressure_pa", "pressure_sd_pa")
STICKING = ("sticking_share", "sticking_share_sd", "slip_direction_rad")
COLUMNS = (*OF_READING, "reference_slice", *STICKING)

Columns = dict[str, NDArray[Any]]


class Slices(NamedTuple):
    """Forces over modulus, in mm2, from the dots of each slice, with standard deviations, and whether there is touch.

    shear_mm2, shear_sd_mm2: (slices, 2); normal_mm2, normal_sd_mm2, touches: (slices,). Without touch, forces are 0 and
    their standard deviations NaN; with too few dots, all are NaN.
    """

    shear_mm2: Floats
    shear_sd_mm2: Floats
    normal_mm2: Floats
    normal_sd_mm2: Floats
    touches: Flags


class Factor(NamedTuple):
    """A factor for the forces of a map, its relative sd, and the factor by which the map's own sd is increased."""

    value: Floats
    relative_sd: Floats
    times: float

    def applied(self, value: Floats, sd: Floats) -> tuple[Floats, Floats]:
        """Return a force or traction and its sd after applying the factor."""
        after = value * self.value
        return after, np.hypot(self.times * self.value * sd, self.relative_sd * after)


def start(
    gel: GelWeights,
    rest_px: Floats,
    frame_px: Sequence[int],
    window_px: Sequence[int] | None,
    *,
    renews: bool = True,
    compares: bool = False,
) -> TouchState:
    """Start a touch map from dots at rest (n, 2) of a gel, which may be cut; ValueError if the dots are unsuitable."""
    scale = gel.mm_per_px
    rest_mm = (rest_px - np.array(frame_px) / 2) * scale
    shape = at_window(gel.shape, window_px, frame_px, scale, rest_mm)
    noise = DotNoise(TRACKER_PX * scale, DRIFT_PX * scale)
    return touch_map.start(rest_mm, shape.layer(gel.modulus_pa), noise, renews=renews, compares=compares)


def of_tracks(gel: GelWeights, tracks: StageFile, *, compares: bool = False) -> TouchState:
    """Start a touch map from the dots of a tracks file; InputError if the dots are unsuitable.

    compares: leave out dots whose motion is inconsistent with the others.
    """
    window_px = tracks.read("sensor/window_px").tolist() if tracks.has("sensor/window_px") else None
    try:
        rest_px = tracks.read("sensor/dot_xy_px").reshape(-1, 2)
        return start(gel, rest_px, tracks.read("sensor/frame_px").tolist(), window_px, compares=compares)
    except ValueError as error:
        raise InputError(f"no touch can be estimated from these dots: {error}", where=str(tracks.path)) from error


class TouchFold:
    """Applies a touch map to the slices of a tracks file in order; map_every: slices between maps, 0 for none.

    Quantities named `since` are measured from the last state in which the field of dots came to rest.
    """

    def __init__(self, gel: GelWeights, tracks: StageFile, map_every: int, *, compares: bool = False) -> None:
        self.gel, self.map_every = gel, map_every
        self.state = of_tracks(gel, tracks, compares=compares)
        self._sticking = sticking_of(self.state)
        self._tracks = tracks
        self._memory = CreepMemory()
        self._reference = -1

    def block(self, first: int, stop: int) -> Columns:
        """Return the columns of a touch file, and its maps, for the next slices [first, stop)."""
        readings: list[tuple[Any, ...]] = []
        sticks: list[StickingReading] = []
        maps: list[tuple[Any, ...]] = []
        slices = _slices(self._tracks, self.gel.mm_per_px, first, stop)
        for number, (dot_mm, lost) in enumerate(slices, start=first):
            reading = touch_map.step(self.state, dot_mm, lost)
            sticks.append(self._step_sticking(dot_mm, lost, reading.touches))
            readings.append(tuple(getattr(reading, name) for name in OF_READING))
            if self.map_every and number % self.map_every == 0:
                maps.append((number, *(getattr(reading, name) for name in OF_MAP)))
        estimates = {
            name: np.array([row[place] for row in readings]).reshape(-1, *((2,) if name in PAIRS else ()))
            for place, name in enumerate(OF_READING)
        }
        reference = np.array([one.reference_slice for one in sticks], np.int64)
        columns = self._scaled(estimates, reference)
        columns |= {name: np.array([getattr(one, name) for one in sticks], np.float32) for name in STICKING}
        return columns | (self._maps(maps) if self.map_every else {})

    def _step_sticking(self, dot_mm: Floats, lost: Flags, touches: bool) -> StickingReading:
        """Return the sticking share of one slice; if its reference changed, the touch map uses the new one too."""
        if self._sticking is None:
            return sticking.NO_TOUCH
        reading = sticking.step(self._sticking, dot_mm, lost, touches)
        if reading.reference_slice not in (-1, self._reference):
            touch_map.hold(self.state)
        self._reference = reading.reference_slice
        return reading

    def _scaled(self, estimates: Columns, reference: NDArray[np.int64]) -> Columns:
        """Return the columns of a block with the weights of the gel; `since` is NaN before there is a reference.

        An unknown scale of the image affects positions and areas, and torsion with one more power than forces.
        """
        gel, touches = self.gel, np.asarray(estimates["touches"], np.bool_)
        forces = forces_of(gel, _over_modulus(gel, estimates), self._memory)
        of_shear, unsure = shear_factor(gel), gel.mm_log_sd
        relative_sd = np.hypot(of_shear.relative_sd.mean(), unsure)
        of_torsion = Factor(of_shear.value.mean(), relative_sd, of_shear.times)
        torsion = of_torsion.applied(estimates["torsion_n_mm"], estimates["torsion_sd_n_mm"])
        since = of_shear.applied(estimates["shear_since_n"], estimates["shear_since_sd_n"])
        counts = (touches & (reference >= 0))[:, None]
        singles = {
            **forces._asdict(),
            **dict(zip(("torsion_n_mm", "torsion_sd_n_mm"), torsion, strict=True)),
            "centre_mm": estimates["centre_mm"],
            "centre_sd_mm": np.hypot(estimates["centre_sd_mm"], unsure * estimates["centre_mm"]),
            "area_mm2": estimates["area_mm2"],
            "area_sd_mm2": np.hypot(estimates["area_sd_mm2"], 2 * unsure * estimates["area_mm2"]),
            **{name: np.where(counts, values, np.nan) for name, values in zip(SINCE, since, strict=True)},
        }
        return {
            **{name: estimates[name].astype(np.uint8) for name in FLAGS},
            **{name: values.astype(np.float32) for name, values in singles.items()},
            "reference_slice": reference,
        }

    def _maps(self, maps: list[tuple[Any, ...]]) -> Columns:
        """Return the maps of some slices, with the weights of the gel."""
        cells = self.state.cells.shape
        sizes = {"patch": cells, "shear_pa": (2, *cells), "pressure_pa": cells}
        estimates = {
            name: np.array([row[1 + place] for row in maps]).reshape(-1, *sizes[name.replace("_sd", "")])
            for place, name in enumerate(OF_MAP)
        }
        of_shear = shear_factor(self.gel)
        on_grid = of_shear._replace(
            value=of_shear.value[:, None, None], relative_sd=of_shear.relative_sd[:, None, None]
        )
        shear = on_grid.applied(estimates["shear_pa"], estimates["shear_sd_pa"])
        pressure = normal_factor(self.gel).applied(estimates["pressure_pa"], estimates["pressure_sd_pa"])
        return {
            "map/slice": np.array([row[0] for row in maps], np.int64),
            "map/patch": estimates["patch"].astype(np.uint8),
            **{
                f"map/{name}": field.astype(np.float32)
                for name, field in zip(OF_MAP[1:], (*shear, *pressure), strict=True)
            },
        }


def sticking_of(state: TouchState) -> StickingState | None:
    """Start estimating the sticking share from the dots of a touch map; None with too few dots."""
    if np.count_nonzero(state.there) < sticking.LEAST_DOTS:
        return None
    return sticking.start(state.rest_mm, shipped_network(), state.noise)


def _slices(tracks: StageFile, mm_per_px: float, first: int, stop: int) -> Iterator[tuple[Floats, Flags]]:
    """Iterate over slices of a tracks file: the dots (n, 2) in mm, and which of them are lost (n,)."""
    dot_mm = (tracks.read("dot_xy_px", first, stop) - tracks.read("sensor/frame_px") / 2) * mm_per_px
    return zip(dot_mm, tracks.read("lost", first, stop) != 0, strict=True)


def slices_of(gel: GelWeights, tracks: StageFile) -> Slices:
    """Return the forces over modulus in all slices of a tracks file, without a reference and without maps."""
    state = of_tracks(gel, tracks)
    slices = tracks.length("dot_xy_px")
    estimates = {name: np.empty((slices, 2) if name in PAIRS else slices) for name in (*SUMS, "touches")}

    for first, stop in row_blocks(slices):
        for number, (dot_mm, lost) in enumerate(_slices(tracks, gel.mm_per_px, first, stop), start=first):
            reading = touch_map.step(state, dot_mm, lost)
            for name, values in estimates.items():
                values[number] = getattr(reading, name)
    return _over_modulus(gel, estimates)


def _over_modulus(gel: GelWeights, estimates: Columns) -> Slices:
    """Return the forces of readings over the modulus with which their map was made."""
    mpa = gel.modulus_pa * 1e-6
    shear, shear_sd, normal, normal_sd = (estimates[name] / mpa for name in SUMS[:4])
    return Slices(shear, shear_sd, normal, normal_sd, np.asarray(estimates["touches"], np.bool_))


def forces_of(
    gel: GelWeights, over: Slices, memory: CreepMemory | None = None, step_s: float = gel_forces.SLICE_S
) -> Forces:
    """Return the forces of consecutive slices, step_s apart; 0 without touch, NaN if unknown.

    memory: state of the gel's creep from earlier slices.
    """
    shear, normal = terms_of(gel, over, memory, step_s)
    forces = gel_forces.predict(gel.scale, gel.errors, shear, normal, over.shear_sd_mm2, over.normal_sd_mm2)
    nothing = ~over.touches & np.isfinite(over.normal_mm2)
    return forces._replace(
        shear_n=np.where(nothing[:, None], 0.0, forces.shear_n), normal_n=np.where(nothing, 0.0, forces.normal_n)
    )


def terms_of(
    gel: GelWeights, over: Slices, memory: CreepMemory | None = None, step_s: float = gel_forces.SLICE_S
) -> tuple[Floats, Floats]:
    """Return the terms of shear force (slices, 2, 4) and normal force (slices, 2) of consecutive slices."""
    shear = gel_forces.shear_terms(over.shear_mm2, gel.creep_time_s, step_s, memory)
    return shear, gel_forces.normal_terms(over.normal_mm2, over.normal_sd_mm2)


def shear_factor(gel: GelWeights) -> Factor:
    """Return the factor for shear, without creep and offset."""
    weight = gel.scale.shear[:, 0]
    relative_sd = np.sqrt(gel.scale.shear_covariance[:, 0, 0]) / weight
    return Factor(weight / (gel.modulus_pa * 1e-6), relative_sd, gel.errors.shear_times)


def normal_factor(gel: GelWeights) -> Factor:
    """Return the factor for pressure, without offset."""
    weight = gel.scale.normal[0]
    relative_sd = np.sqrt(gel.scale.normal_covariance[0, 0]) / weight
    return Factor(weight / (gel.modulus_pa * 1e-6), relative_sd, gel.errors.normal_times)
