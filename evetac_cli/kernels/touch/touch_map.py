"""Touch maps, slice by slice: patch, shear and pressure on it, forces and torsion, from the tracked dots of a gel.

`start`, then `step` with each slice's dots. A patch and its gain are found anew every RENEWAL_SLICES slices, which
takes some milliseconds and is done in parts, one per slice; in between a slice is a product with the gain. A program
that must answer each millisecond starts with `renews=False` and calls `renew`, or `renew_part`, where it has the time.

The layer is linear: it neither sinks in by millimetres nor creeps. Shear finer than two pitches of the dots is gone.
"""

import math
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Floats, Singles
from evetac_cli.checks import check_range
from evetac_cli.kernels.touch import patch, wrong_dots
from evetac_cli.kernels.touch.dot_modes import DotModes, DotNoise, modes_of
from evetac_cli.kernels.touch.dot_motion import CELL_MM, KINDS, PRESSURE, CellGrid, GelLayer, cells_about, dot_motion
from evetac_cli.kernels.touch.patch_fit import (
    FORCE_X,
    FORCE_Y,
    MOMENT_X,
    NORMAL,
    OF_SHEAR,
    TORSION,
    PatchFit,
    fit,
)

LEAST_DOTS = 4  # that are tracked: with fewer nothing is told
RENEWAL_SLICES = 20
# Dots that move otherwise than all together by so many times their own error (rms) are touched, and no longer. Between
# the two, a touch that lasts goes on and none begins. Judgement: 0.2 and 0.125 px; 1 N moves dots by 0.4 px or more.
BEGINS, ENDS = 4.0, 2.5
# The gel about a patch tells its normal force, as even pressure moves no dot. Where no dots show that gel, an even
# pressure of this size may be there or not: that of simulated grips and presses, 35 to 57 kPa. The sd goes with the
# third power of the share that is not shown. Of shear, where the gel's edges are not told, 1.3 times too much is told
# then. By faces, discs and objects as wide as the view, of seeds 100-102 and 6001.
EVEN_PA, SHEAR_BEYOND = 50e3, 0.3
RING_CELLS = 3
MOST_CELLS = 4000  # of a grid
MOST_DOTS = 1024
MOST_COMPARED = 80  # dots, which takes 4 ms, and grows with their cube


class TouchReading(NamedTuple):
    """What the dots of one slice tell; x and y as in the image, pressure into the gel, `sd`: standard deviation.

    Where nothing touches, patch, tractions and forces are 0 and places and deviations NaN; where fewer than 4 dots are
    tracked, `known` is false and all numbers are NaN. Without `TouchMap.hold` all that is `since` it is NaN. Deviations
    hold for contacts like those that they were fitted to (docs/touch-maps.md). Grids have (rows, columns); the middles
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
    centre_mm: Floats  # (2,), of pressure, from the middle of the image
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
    shear_since_pa: Floats  # (2, rows, columns), since `hold`: needs no pressure, as long as it stays
    shear_since_sd_pa: Floats
    shear_since_n: Floats  # (2,)
    shear_since_sd_n: Floats


class DotsInUse(NamedTuple):
    """Some of the dots (those that are `used`, of all), and what finding patches and fits needs of them."""

    used: Flags
    modes: DotModes
    finder: patch.PatchFinder


class Fitted(NamedTuple):
    """A fit, the dots that it is for, and further sd for what no dots show: of shear, relative, and of normal force."""

    dots: DotsInUse
    fit: PatchFit
    shear_beyond: float
    normal_beyond_n: float


class TouchState:
    """What a touch map knows after the slices so far; `step` changes it, `copy.deepcopy` and pickle keep it.

    cells: of the grid. moved_mm: (dots, 2), where each dot has last been seen, from its rest. trusted: (dots,), whether
    it was in the last slice.
    """

    def __init__(
        self, rest_mm: Floats, layer: GelLayer, noise: DotNoise, stiffness_error: float, renews: bool, compares: bool
    ) -> None:
        """For dots (n, 2) from the axis; NaN where one is missing."""
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
        self.dots = self._in_use(self.there)
        self.found_pa: Floats | None = None
        self.now: Fitted | None = None
        self.held: Fitted | None = None

    def _in_use(self, used: Flags) -> DotsInUse:
        """What is needed of some of the dots."""
        modes = modes_of(self.motion[used])
        below_mm = self.layer.height_mm - self.layer.print_depth_mm
        return DotsInUse(
            used.copy(), modes, patch.finder(modes, self.cells.shape, below_mm / self.layer.shear_modulus_pa)
        )

    def use(self, used: Flags) -> None:
        """Take these dots for patches and fits from now on."""
        self.dots = self._in_use(used)


def start(
    rest_mm: Floats,
    layer: GelLayer = GelLayer(),  # noqa: B008 - it is constant
    noise: DotNoise = DotNoise(),  # noqa: B008
    stiffness_error: float = 0.0,
    renews: bool = True,
    compares: bool = False,
) -> TouchState:
    """Begin a touch map of dots at rest.

    rest_mm: (n, 2) from the axis of the lens, at least 4, a row of NaN is a missing dot. stiffness_error: relative
    sd of the layer's shear modulus, which all forces share. renews: whether `step` renews the patch itself.
    compares: leave out dots that moved otherwise than the others allow (wrong_dots.py), which helps after minutes
    of pushes and costs some accuracy before: now and then the dots that move most are thought wrong. ValueError for
    dots or numbers that cannot be, and for more than MOST_COMPARED dots to compare. Takes about a millisecond per
    dot.
    """
    rest = np.array(rest_mm, np.float64)
    if rest.ndim != 2 or rest.shape[1] != 2:
        raise ValueError(f"rest_mm: expected shape (dots, 2), found {rest.shape}")
    if np.isinf(rest).any() or (np.isnan(rest[:, 0]) != np.isnan(rest[:, 1])).any():
        raise ValueError("rest_mm: expected two finite numbers per dot, or two NaN for a missing one")
    there = int(np.isfinite(rest).all(axis=1).sum())
    if not LEAST_DOTS <= there <= MOST_DOTS:
        raise ValueError(f"rest_mm: expected {LEAST_DOTS} to {MOST_DOTS} dots that are not missing, found {there}")
    check_range("own_mm", noise.own_mm, 0.0, 1.0, "mm", above=True)
    check_range("common_mm", noise.common_mm, 0.0, 10.0, "mm")
    check_range("model_share", noise.model_share, 0.0, 1.0)
    check_range("stiffness_error", stiffness_error, 0.0, 2.0)
    if compares and len(rest) > MOST_COMPARED:
        raise ValueError(f"rest_mm: expected up to {MOST_COMPARED} dots to compare, found {len(rest)}")
    patch.patch_of(np.zeros((KINDS, 1, 1)), 0.0)  # what it loads is then there at the first touch
    return TouchState(rest, layer, noise, stiffness_error, renews, compares)


def step(state: TouchState, dot_mm: Floats, lost: Flags | None = None) -> TouchReading:
    """What the dots of one more slice tell: dot_mm (n, 2) as `rest_mm`, lost (n,) those not to be trusted.

    A dot that is lost, or not finite, keeps the motion that it was last seen with until the patch is renewed, and is
    left out of the next patch. ValueError for other numbers of dots.
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
    """Count what is `since` from the dots as they are now, for instance when a grip has closed.

    Before the first, and until the patch is next renewed, nothing is told of it.
    """
    state.held_mm = state.moved_mm.copy()


def renew(state: TouchState) -> None:
    """Find the patch anew from the dots of the last slice, and its gain; nothing where nothing touches."""
    state.next_part = 0
    while not renew_part(state):
        pass


def renew_part(state: TouchState) -> bool:
    """The next part of a renewal, some milliseconds each, and whether it was the last, or nothing touches.

    In turn: the dots that are tracked now and not wrong, where they are others; the patch; its fit; and that of what
    changed since `hold`. Until a part is done, what was found before is used.
    """
    state.next_part = _PARTS[state.next_part](state) if state.touches else 0
    return state.next_part == 0


def _renew_dots(state: TouchState) -> int:
    """Take the dots that are tracked now, but for those that are wrong; the number of the part that is next."""
    used = state.trusted
    if state.now is not None and state.compared is not None:
        used = used & ~wrong_dots.wrong(state.compared, state.moved_mm, used, state.now.fit.patch)
    if (used == state.dots.used).all():
        return _renew_patch(state)
    state.use(used)
    return _PARTS.index(_renew_patch)


def _renew_patch(state: TouchState) -> int:
    """Find the patch."""
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
    """Fit to the patch."""
    state.now = _fitted(state, state.moved_mm, KINDS)
    state.renewed_at = state.slices
    return 0 if state.held_mm is None else _PARTS.index(_renew_held)


def _renew_held(state: TouchState) -> int:
    """Fit what changed since `hold`, shear alone, to the patch."""
    if state.held_mm is not None:
        state.held = _fitted(state, state.moved_mm - state.held_mm, OF_SHEAR - 1)
    return 0


_PARTS = (_renew_dots, _renew_patch, _renew_fit, _renew_held)


def _fitted(state: TouchState, moved_mm: Floats, kinds: int) -> Fitted:
    """The fit to the patch that was found, of dots (all of them) that moved so far."""
    assert state.found_pa is not None
    dots, moved = state.dots, moved_mm[state.dots.used]
    variance = dots.modes.variance_mm2(state.noise, moved)
    told = fit(dots.modes, state.cell_mm, state.found_pa, dots.modes.of(moved), variance, kinds)
    hidden, shear = _shares_beyond(state, told.patch)
    return Fitted(dots, told, SHEAR_BEYOND * shear**3, EVEN_PA * told.area_mm2 * 1e-6 * hidden**3)


def _shares_beyond(state: TouchState, touched: Flags) -> tuple[float, float]:
    """Share of the ring about a patch, RING_CELLS wide, that no dots show; and of it what is within the gel."""
    around = np.pad(touched, RING_CELLS)
    grown = around.copy()
    for _ in range(RING_CELLS):
        before = grown.copy()
        grown[1:] |= before[:-1]
        grown[:-1] |= before[1:]
        grown[:, 1:] |= before[:, :-1]
        grown[:, :-1] |= before[:, 1:]
    rows, columns = np.nonzero(grown & ~around)
    (x_mm, y_mm), dots = state.cells, state.rest_mm[state.dots.used]
    ring = np.stack([x_mm[0] + (columns - RING_CELLS) * CELL_MM, y_mm[0] + (rows - RING_CELLS) * CELL_MM], axis=1)
    hidden = ((ring < dots.min(axis=0) - CELL_MM) | (ring > dots.max(axis=0) + CELL_MM)).any(axis=1)
    edges = np.array(state.layer.edges_mm)
    gel = ((ring > edges[:2]) & (ring < edges[2:])).all(axis=1)
    return float(hidden.mean()) if len(ring) else 1.0, float((hidden & gel).sum()) / max(int(gel.sum()), 1)


def _let_go(state: TouchState) -> None:
    """Forget the patch: the next touch begins without one."""
    state.now = state.held = state.found_pa = None
    state.next_part = 0


def apart_rms(moved_mm: Floats) -> float:
    """How far dots (n, 2) moved otherwise than all together, rms per axis."""
    x, y = moved_mm.T
    dots = len(x)
    square = float(x @ x + y @ y) / dots - (float(x.sum()) / dots) ** 2 - (float(y.sum()) / dots) ** 2
    return math.sqrt(max(square, 0.0) / 2)


def _on_grid(state: TouchState, of: PatchFit, values: Singles) -> Floats:
    """Values (kinds, U) of a fit's cells on the grid, (kinds, rows, columns)."""
    whole = np.zeros((len(values), len(state.cell_mm)))
    whole[:, of.cells] = values
    return whole.reshape(len(values), *state.cells.shape)


def _reading(state: TouchState, fitted: Fitted) -> TouchReading:
    """What the dots tell with the patch as it was last found."""
    dots, now, shear_beyond, normal_beyond_n = fitted
    error = state.stiffness_error
    told = now.gain @ dots.modes.of(state.moved_mm[dots.used]).astype(np.float32)
    count = KINDS * len(now.cells)
    field = _on_grid(state, now, told[:count].reshape(KINDS, -1))
    sums = told[count:].astype(np.float64)
    relative = np.full(len(sums), error)
    relative[:OF_SHEAR] = math.hypot(error, shear_beyond)
    sd = np.hypot(now.sum_sd, relative * sums)
    sd[NORMAL] = math.hypot(float(sd[NORMAL]), normal_beyond_n)
    field_sd = now.traction_sd_pa if not error else np.hypot(now.traction_sd_pa, error * field)
    # Of the pressure that is above 0, so that it lies in the patch even where dots hardly tell the normal force.
    pushes = np.maximum(told[count - len(now.cells) : count], 1e-6)
    away = pushes @ now.away_mm / pushes.sum()
    pressed = max(float(sums[NORMAL]), float(now.sum_sd[NORMAL]))
    since = state.no_since
    if state.held is not None and state.held_mm is not None:
        since = _since(state, state.held, state.moved_mm - state.held_mm)
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
    """Shear on the grid and net, with deviations, that moved the dots (all of them) since they were held."""
    dots, held, shear_beyond, _ = fitted
    told = held.gain @ dots.modes.of(change_mm[dots.used]).astype(np.float32)
    count = PRESSURE * len(held.cells)
    field, net = _on_grid(state, held, told[:count].reshape(PRESSURE, -1)), told[count : count + 2].astype(np.float64)
    error = state.stiffness_error
    field_sd = held.traction_sd_pa if not error else np.hypot(held.traction_sd_pa, error * field)
    net_sd = np.hypot(held.sum_sd[:2], math.hypot(error, shear_beyond) * net)
    return field, field_sd, net, net_sd


def _nothing(state: TouchState, value: float) -> TouchReading:
    """Where nothing touches (value 0) or nothing is known (NaN)."""
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
