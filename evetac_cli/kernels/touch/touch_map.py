"""Touch maps, slice by slice: patch, shear and pressure on it, forces and torsion, from the tracked dots of a gel.

`start`, then `step` with each slice's dots. Every RENEWAL_SLICES slices, the patch and its gain are estimated again.
This takes some milliseconds and is split into parts, one per slice. In between, a slice is one product with the gain. A
program that must answer every millisecond starts with `renews=False` and calls `renew`, or `renew_part`, when it has
time.

The layer model is linear: it does not describe indentation by millimetres or creep. Shear finer than two pitches of the
dots is not resolved.
"""

import math
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Floats, Singles
from evetac_cli.errors import check_range
from evetac_cli.kernels.touch import patch, wrong_dots
from evetac_cli.kernels.touch.dot_motion import (
    CELL_MM,
    KINDS,
    PRESSURE,
    CellGrid,
    DotModes,
    DotNoise,
    GelLayer,
    cells_about,
    dot_motion,
    modes_of,
)
from evetac_cli.kernels.touch.patch import FORCE_X, FORCE_Y, MOMENT_X, NORMAL, OF_SHEAR, TORSION, PatchFit, fit

LEAST_DOTS = 4  # tracked dots: with fewer, the reading is unknown
RENEWAL_SLICES = 20
# A touch begins if the dots move relative to their mean by BEGINS times their own error (rms), and ends below ENDS
# times it. By judgement: 0.2 and 0.125 px; 1 N moves dots by 0.4 px or more.
BEGINS, ENDS = 4.0, 2.5
# Uniform pressure moves no dots, so the normal force follows from the gel around a patch. If no dots show that gel, a
# uniform pressure of EVEN_PA may be present or not: 35 to 57 kPa in simulated grips and presses. Its sd is scaled by
# the third power of the share of the surrounding gel that is not shown. Shear has a relative sd of SHEAR_BEYOND in the
# same case, because it is overestimated by a factor of 1.3 if the edges of the gel are not given. From faces, discs and
# objects as wide as the view, seeds 100-102 and 6001.
EVEN_PA, SHEAR_BEYOND = 50e3, 0.3
RING_CELLS = 3  # width of the ring around a patch that counts as its surroundings
MOST_CELLS = 4000  # of a grid
MOST_DOTS = 1024
MOST_COMPARED = 80  # dots: comparing takes 4 ms and grows with the cube of their number


class TouchReading(NamedTuple):
    """Estimates from the dots of one slice; x and y as in the image, pressure into the gel, `sd`: standard deviation.

    Without a touch, patch, tractions and forces are 0, and positions and deviations are NaN. With fewer than 4 tracked
    dots, `known` is false and all numbers are NaN. Before `TouchMap.hold`, everything with `since` is NaN. Deviations
    are valid for contacts like those they were fitted to (docs/touch-maps.md). Grids have (rows, columns); the centres
    of their cells are `TouchMap.x_mm` and `y_mm`.

    >>> import math
    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     touch = evetac.TouchMap(recording, mm_per_px=0.0329)
    >>> reading = touch.step(touch.rest_xy_px)      # dots at rest: nothing touches
    >>> reading.known, reading.touches, float(reading.normal_n), math.isnan(reading.normal_sd_n)
    (True, False, 0.0, True)
    """

    known: bool
    touches: bool
    patch: Flags  # (rows, columns)
    area_mm2: float
    area_sd_mm2: float
    centre_mm: Floats  # (2,), centre of pressure, from the middle of the image
    centre_sd_mm: Floats
    shear_pa: Floats  # (2, rows, columns)
    shear_sd_pa: Floats
    pressure_pa: Floats  # (rows, columns)
    pressure_sd_pa: Floats
    shear_n: Floats  # (2,), net shear
    shear_sd_n: Floats
    normal_n: float
    normal_sd_n: float
    torsion_n_mm: float  # about centre_mm, from x towards y
    torsion_sd_n_mm: float
    # (2, rows, columns), since `hold`: needs no pressure estimate as long as the pressure stays constant
    shear_since_pa: Floats
    shear_since_sd_pa: Floats
    shear_since_n: Floats  # (2,)
    shear_since_sd_n: Floats


class DotsInUse(NamedTuple):
    """A subset of the dots (those that are `used`, of all), and the constants for patches and fits from them."""

    used: Flags
    modes: DotModes
    finder: patch.PatchFinder


class Fitted(NamedTuple):
    """A fit, its dots, and additional sd for gel that no dots show: of shear, relative, and of the normal force."""

    dots: DotsInUse
    fit: PatchFit
    shear_beyond: float
    normal_beyond_n: float


class TouchState:
    """State of a touch map after the slices so far; `step` changes it, `copy.deepcopy` and pickle preserve it.

    cells: of the grid. moved_mm: (dots, 2), last displacement of each dot from rest. trusted: (dots,), whether the dot
    was tracked in the last slice.
    """

    def __init__(
        self, rest_mm: Floats, layer: GelLayer, noise: DotNoise, stiffness_error: float, renews: bool, compares: bool
    ) -> None:
        """For dots (n, 2) from the axis; NaN for a missing one."""
        self.rest_mm, self.layer, self.noise = rest_mm, layer, noise
        self.stiffness_error, self.renews = stiffness_error, renews
        self.there: Flags = np.asarray(np.isfinite(rest_mm).all(axis=1))
        self.cells: CellGrid = cells_about(rest_mm[self.there], layer.height_mm, layer.edges_mm)
        self.cell_mm = self.cells.middle_mm
        if len(self.cell_mm) > MOST_CELLS:
            raise ValueError(f"dots span {len(self.cell_mm)} mm2 with their margin: expected up to {MOST_CELLS}")
        self.motion = np.full((len(rest_mm), 2, KINDS, len(self.cell_mm)), np.nan)
        self.motion[self.there] = dot_motion(layer, self.cells, rest_mm[self.there])
        self.compared = wrong_dots.start(self.motion, self.cells.shape) if compares else None
        self.moved_mm = np.zeros_like(rest_mm)
        self.trusted: Flags = self.there.copy()
        self.held_mm: Floats | None = None
        unknown, two = np.full((2, *self.cells.shape), np.nan), np.full(2, np.nan)
        self.no_since = unknown, unknown, two, two  # of readings before `hold`
        self.slices = 0
        self.renewed_at = 0
        self.touches = False
        self.next_part = 0  # of a renewal, see `renew_part`
        self.dots = self.in_use(self.there)
        self.found_pa: Floats | None = None
        self.now: Fitted | None = None
        self.held_fit: Fitted | None = None

    def in_use(self, used: Flags) -> DotsInUse:
        """Return the constants for a subset of the dots."""
        modes = modes_of(self.motion[used])
        below_mm = self.layer.height_mm - self.layer.print_depth_mm
        return DotsInUse(
            used.copy(), modes, patch.finder(modes, self.cells.shape, below_mm / self.layer.shear_modulus_pa)
        )


def start(
    rest_mm: Floats,
    layer: GelLayer = GelLayer(),  # noqa: B008 - it is constant
    noise: DotNoise = DotNoise(),  # noqa: B008
    stiffness_error: float = 0.0,
    renews: bool = True,
    compares: bool = False,
) -> TouchState:
    """Start a touch map from dots at rest; takes about a millisecond per dot.

    `rest_mm`: (n, 2) from the axis of the lens, at least 4, a row of NaN is a missing dot. `stiffness_error`: relative
    sd of the layer's shear modulus, which affects all forces alike. `renews`: `step` renews the patch itself.
    `compares`: leave out dots whose motion contradicts the others (wrong_dots.py). This helps after minutes of pushes,
    and costs some accuracy before: sometimes the dots that move most are rejected. ValueError for impossible dots or
    numbers, and for more than MOST_COMPARED dots to compare.
    """
    rest = np.array(rest_mm, np.float64)
    assert rest.ndim == 2 and rest.shape[1] == 2 and not np.isinf(rest).any()
    there = int(np.isfinite(rest).all(axis=1).sum())
    if not LEAST_DOTS <= there <= MOST_DOTS:
        raise ValueError(f"rest_mm: expected {LEAST_DOTS} to {MOST_DOTS} dots that are not missing, found {there}")
    check_range("stiffness_error", stiffness_error, 0.0, 2.0)
    if compares and len(rest) > MOST_COMPARED:
        raise ValueError(f"rest_mm: expected up to {MOST_COMPARED} dots to compare, found {len(rest)}")
    patch.patch_of(np.zeros((KINDS, 1, 1)), 0.0)  # loads scipy.ndimage before the first touch
    return TouchState(rest, layer, noise, stiffness_error, renews, compares)


def step(state: TouchState, dot_mm: Floats, lost: Flags | None = None) -> TouchReading:
    """Return the reading of the next slice: dot_mm (n, 2) as `rest_mm`, lost (n,) dots that must not be trusted.

    A dot that is lost or not finite keeps its last displacement until the patch is renewed, and is left out of the next
    patch. ValueError for another number of dots.
    """
    if dot_mm.shape != state.rest_mm.shape:
        raise ValueError(f"dot_mm: expected shape {state.rest_mm.shape}, found {dot_mm.shape}")
    state.slices += 1
    moved = dot_mm - state.rest_mm
    trusted: Flags = np.isfinite(moved[:, 0]) & np.isfinite(moved[:, 1])
    if lost is not None:
        trusted &= ~lost
    state.trusted = trusted
    np.copyto(state.moved_mm, moved, where=trusted[:, None])
    if np.count_nonzero(trusted) < LEAST_DOTS:
        _let_go(state)
        return _nothing(state, np.nan)
    other_mm = apart_rms(state.moved_mm[trusted])
    state.touches = other_mm > (ENDS if state.touches else BEGINS) * state.noise.own_mm
    if not state.touches:
        _let_go(state)
        return _nothing(state, 0.0)
    if state.renews and state.now is None:
        renew(state)
    elif state.renews and (state.next_part or state.slices - state.renewed_at >= RENEWAL_SLICES):
        renew_part(state)
    return _reading(state, state.now) if state.now is not None else _nothing(state, 0.0)


def hold(state: TouchState) -> None:
    """Start measuring changes (`since`) from the present dots, for example when a grip has closed.

    Before the first call, and until the patch is next renewed, these changes are NaN.
    """
    state.held_mm = state.moved_mm.copy()


def renew(state: TouchState) -> None:
    """Estimate the patch and its gain again from the dots of the last slice; does nothing without a touch."""
    state.next_part = 0
    while not renew_part(state):
        pass


def renew_part(state: TouchState) -> bool:
    """Do the next part of a renewal, some milliseconds each; return True after the last part or without a touch.

    The parts: select the dots that are tracked and not wrong; find the patch; fit it; fit the changes since `hold`.
    Until a part is done, the previous result is used.
    """
    state.next_part = _PARTS[state.next_part](state) if state.touches else 0
    return state.next_part == 0


def _renew_dots(state: TouchState) -> int:
    """Use the tracked dots without those that are wrong; return the number of the next part."""
    used = state.trusted
    if state.now is not None and state.compared is not None:
        used = used & ~wrong_dots.wrong(state.compared, state.moved_mm, used, state.now.fit.patch)
    if (used == state.dots.used).all():
        return _renew_patch(state)
    state.dots = state.in_use(used)
    return _PARTS.index(_renew_patch)


def _renew_patch(state: TouchState) -> int:
    """Find the patch; return the number of the next part."""
    dots = state.dots
    moved = state.moved_mm[dots.used]
    variance, rms_mm = dots.modes.variance_mm2(state.noise, moved), float(np.sqrt(np.mean(moved**2)))
    found = patch.tractions(dots.finder, dots.modes.of(moved), variance, rms_mm, state.found_pa)
    if not found[PRESSURE].any():
        _let_go(state)
        return 0
    state.found_pa = found
    return _PARTS.index(_renew_fit)


def _renew_fit(state: TouchState) -> int:
    """Fit the patch; return the number of the next part, 0 for none."""
    state.now = _fitted(state, state.moved_mm, KINDS)
    state.renewed_at = state.slices
    return 0 if state.held_mm is None else _PARTS.index(_renew_held)


def _renew_held(state: TouchState) -> int:
    """Fit the changes since `hold`, shear alone, to the patch."""
    if state.held_mm is not None:
        state.held_fit = _fitted(state, state.moved_mm - state.held_mm, OF_SHEAR - 1)
    return 0


_PARTS = (_renew_dots, _renew_patch, _renew_fit, _renew_held)


def _fitted(state: TouchState, moved_mm: Floats, kinds: int) -> Fitted:
    """Return the fit to the present patch, for displacements of all dots."""
    assert state.found_pa is not None
    dots, moved = state.dots, moved_mm[state.dots.used]
    variance = dots.modes.variance_mm2(state.noise, moved)
    result = fit(dots.modes, state.cell_mm, state.found_pa, dots.modes.of(moved), variance, kinds)
    hidden, shear = _shares_beyond(state, result.patch)
    return Fitted(dots, result, SHEAR_BEYOND * shear**3, EVEN_PA * result.area_mm2 * 1e-6 * hidden**3)


def _shares_beyond(state: TouchState, touched: Flags) -> tuple[float, float]:
    """Return the share of a patch's ring, RING_CELLS wide, that no dots show, and that share of its part in the gel."""
    from scipy import ndimage  # here: it takes 0.2 s to load, and commands that only open files load this module

    around = np.pad(touched, RING_CELLS)
    rows, columns = np.nonzero(ndimage.binary_dilation(around, iterations=RING_CELLS) & ~around)
    (x_mm, y_mm), dots = state.cells, state.rest_mm[state.dots.used]
    ring = np.stack([x_mm[0] + (columns - RING_CELLS) * CELL_MM, y_mm[0] + (rows - RING_CELLS) * CELL_MM], axis=1)
    hidden = ((ring < dots.min(axis=0) - CELL_MM) | (ring > dots.max(axis=0) + CELL_MM)).any(axis=1)
    edges = np.array(state.layer.edges_mm)
    gel = ((ring > edges[:2]) & (ring < edges[2:])).all(axis=1)
    return float(hidden.mean()) if len(ring) else 1.0, float((hidden & gel).sum()) / max(int(gel.sum()), 1)


def _let_go(state: TouchState) -> None:
    """Forget the patch, so that the next touch starts without one."""
    state.now = state.held_fit = state.found_pa = None
    state.next_part = 0


def apart_rms(moved_mm: Floats) -> float:
    """Return the motion of dots (n, 2) relative to their mean, rms per axis."""
    x, y = moved_mm.T
    dots = len(x)
    square = float(x @ x + y @ y) / dots - (float(x.sum()) / dots) ** 2 - (float(y.sum()) / dots) ** 2
    return math.sqrt(max(square, 0.0) / 2)


def _on_grid(state: TouchState, of: PatchFit, values: Singles) -> Floats:
    """Return the values (kinds, U) of a fit's cells on the grid, (kinds, rows, columns)."""
    whole = np.zeros((len(values), len(state.cell_mm)))
    whole[:, of.cells] = values
    return whole.reshape(len(values), *state.cells.shape)


def _reading(state: TouchState, fitted: Fitted) -> TouchReading:
    """Return the reading for the present dots and the last patch."""
    dots, now, shear_beyond, normal_beyond_n = fitted
    error = state.stiffness_error
    estimates = now.gain @ dots.modes.of(state.moved_mm[dots.used]).astype(np.float32)
    count = KINDS * len(now.cells)
    field = _on_grid(state, now, estimates[:count].reshape(KINDS, -1))
    sums = estimates[count:].astype(np.float64)
    relative = np.full(len(sums), error)
    relative[:OF_SHEAR] = math.hypot(error, shear_beyond)
    sd = np.hypot(now.sum_sd, relative * sums)
    sd[NORMAL] = math.hypot(float(sd[NORMAL]), normal_beyond_n)
    field_sd = now.traction_sd_pa if not error else np.hypot(now.traction_sd_pa, error * field)
    # From pressures above 0 only, so that the centre is in the patch even if the normal force is poorly determined.
    pushes = np.maximum(estimates[count - len(now.cells) : count], 1e-6)
    away = pushes @ now.away_mm / pushes.sum()
    pressed = max(float(sums[NORMAL]), float(now.sum_sd[NORMAL]))
    since = state.no_since
    if state.held_fit is not None and state.held_mm is not None:
        since = _since(state, state.held_fit, state.moved_mm - state.held_mm)
    return TouchReading(
        True,
        True,
        now.patch,
        now.area_mm2,
        now.area_sd_mm2,
        now.about_mm + away,
        now.sum_sd[MOMENT_X:] / pressed,
        field[:PRESSURE],
        field_sd[:PRESSURE],
        field[PRESSURE],
        field_sd[PRESSURE],
        sums[:2],
        sd[:2],
        float(sums[NORMAL]),
        float(sd[NORMAL]),
        float(sums[TORSION] - (away[0] * sums[FORCE_Y] - away[1] * sums[FORCE_X])),
        float(sd[TORSION]),
        *since,
    )


def _since(state: TouchState, fitted: Fitted, change_mm: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the shear on the grid and net, with deviations, that moved the dots since `hold`."""
    dots, patch_fit, shear_beyond, _ = fitted
    estimates = patch_fit.gain @ dots.modes.of(change_mm[dots.used]).astype(np.float32)
    count = PRESSURE * len(patch_fit.cells)
    field, net = (
        _on_grid(state, patch_fit, estimates[:count].reshape(PRESSURE, -1)),
        estimates[count : count + 2].astype(np.float64),
    )
    error = state.stiffness_error
    field_sd = patch_fit.traction_sd_pa if not error else np.hypot(patch_fit.traction_sd_pa, error * field)
    net_sd = np.hypot(patch_fit.sum_sd[:2], math.hypot(error, shear_beyond) * net)
    return field, field_sd, net, net_sd


def _nothing(state: TouchState, value: float) -> TouchReading:
    """Return the reading without a touch (value 0) or with too few dots (NaN)."""
    shape = state.cells.shape
    unknown, _, two, _ = state.no_since
    none = np.full((2, *shape), value)
    return TouchReading(
        not np.isnan(value),
        False,
        np.zeros(shape, np.bool_),
        value,
        np.nan,
        two,
        two,
        none,
        unknown,
        none[0],
        unknown[0],
        np.full(2, value),
        two,
        value,
        np.nan,
        value,
        np.nan,
        *state.no_since,
    )
