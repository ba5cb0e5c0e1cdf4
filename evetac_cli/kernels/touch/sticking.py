"""Share of a contact that sticks, and the direction in which the rest slips, from tracked dots, slice by slice.

`start`, then `step` with each slice's dots. Every 5 ms a small network evaluates four fields: the displacement at the
reference, the change since then, and the changes within the last 20 and 100 ms. They are on a lattice in mm, which
makes the network independent of the grid of dots. All are divided by the present displacement. The reference is the
field when it last came to rest (rest.py), or at first touch. The training data of the network are listed next to its
weights (data/models/sticking.json).

Reason for a network: a push on a firmly held object moves dots as far as a push on an object that is about to slip. The
difference is in which dots stay behind, and that depends on the shape of the contact.

At each position of the lattice, the value is that of a plane fitted to the displacements of the dots around it, with
more weight for nearer dots. Where no dot is near (next to a cut gel, between lost dots), the value is 0.
"""

import math
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Floats, Singles
from evetac_cli.kernels.calibration import grid
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.touch import rest
from evetac_cli.kernels.touch.dot_motion import DotNoise
from evetac_cli.kernels.touch.rest import RestState

X_MM = np.array([-8.4, -6.0, -3.6, -1.2, 1.2, 3.6, 6.0, 8.4])
Y_MM = np.array([-6.0, -3.6, -1.2, 1.2, 3.6, 6.0])
LATTICE_MM: Floats = np.stack(np.meshgrid(X_MM, Y_MM), axis=-1).reshape(-1, 2)  # from the centre of the view
WIDTH_MM = 1.7  # standard deviation of the weight over distance: about a pitch of the paper's dots
WIDTH_PITCHES = 0.85  # ... for wider grids: in pitches
REACH_WIDTHS = 1.25  # a position has no value if its nearest dot is farther than this many widths
LEAST_DOTS = 6  # fewer dots do not determine a field


def lattice_weights(rest_mm: Floats) -> Floats:
    """Return weights (positions, dots) that give the displacement at each lattice position from dots at (dots, 2)."""
    apart = rest_mm[None] - LATTICE_MM[:, None]
    distance = np.linalg.norm(apart, axis=2)
    width = max(WIDTH_MM, WIDTH_PITCHES * grid.pitch(rest_mm))
    nearer = np.exp(-0.5 * (distance / width) ** 2)
    terms = np.concatenate([np.ones_like(apart[..., :1]), apart], axis=2)
    squares = np.einsum("ld,ldi,ldj->lij", nearer, terms, terms)
    inverse = np.linalg.pinv(squares, rcond=1e-6, hermitian=True)
    weights: Floats = np.einsum("lj,ldj,ld->ld", inverse[:, 0], terms, nearer)
    weights[distance.min(axis=1) > REACH_WIDTHS * width] = 0.0
    return weights


LOOKS_BACK = (4, 20)  # changes over 20 and 100 ms, in blocks of 5 ms
KEPT_LOOKS = LOOKS_BACK[-1] + 1  # a "look" is one evaluation of the network, one per block
FIELDS = 2 + len(LOOKS_BACK)
INPUTS = FIELDS * 2 * len(LATTICE_MM) + 1  # the last one is the log of the displacement
SMALLEST_MM = 0.01  # lower bound of the displacement that the fields are divided by
USUAL_MM = 0.1  # unit of the displacement in the last input
MOST_LOG_ODDS = 30.0  # bound on log odds
MOST_MASKS = 8  # sets of tracked dots whose weights are cached
ALL_STICKS = 0.95  # at or above this sticking share there is no direction of slip
# An alarm: the probability that slip has begun is at least ALARM in PATIENCE consecutive looks. Chosen on objects 4, 7
# and 17, seeds 2000 to 2003: 22 of 24 ramps are detected 20 ms ahead, with 1.4 false alarms per minute. With an ALARM
# of 0.9, 20 of 24 are, with 1.1 false alarms per minute.
ALARM, PATIENCE = 0.85, 3


class StickingNetwork(NamedTuple):
    """Contiguous weights as (in, out), and the standard deviation of the estimated sticking share over its value.

    The last layer returns log odds: of the share that slips, and that slip has begun.
    """

    first: Singles
    first_bias: Singles
    second: Singles
    second_bias: Singles
    third: Singles
    third_bias: Singles
    share_sd: Singles  # at evenly spaced shares from 0 to 1


class StickingReading(NamedTuple):
    """Result of a slice: NaN and -1 without a touch.

    sticking_share: 0 to 1, with its standard deviation. slip_direction_rad: from x towards y, NaN while all sticks.
    reference_slice: slice of the reference. alarm: slip was judged to have begun in several consecutive looks.
    """

    sticking_share: float
    sticking_share_sd: float
    slip_direction_rad: float
    reference_slice: int
    alarm: bool


NO_TOUCH = StickingReading(math.nan, math.nan, math.nan, -1, False)


class StickingState:
    """State after the slices so far; `step` changes it.

    rest: state of the rest detection. reference_mm: (dots, 2), origin of the changes, taken at reference_slice.
    inputs: network inputs of the last look. has_begun: probability of slip from that look.
    """

    def __init__(self, rest_mm: Floats, network: StickingNetwork, noise: DotNoise) -> None:
        """For dots at rest (dots, 2) from the middle of the image, NaN for a missing one."""
        self.network = network
        self.there: Flags = np.asarray(np.isfinite(rest_mm).all(axis=1))
        self.at_mm = np.where(self.there[:, None], rest_mm, 0.0)
        self.rest: RestState = rest.start(rest_mm, noise)
        self.reference_mm = self.at_mm.copy()
        self.reference_slice = -1
        self.inputs = np.zeros(INPUTS, np.float32)
        self.has_begun = math.nan
        self.reading = NO_TOUCH
        self._looks_mm = np.repeat(self.at_mm[None], KEPT_LOOKS, axis=0)  # a ring buffer
        self._looks = 0
        self._seen_slipping = 0  # consecutive looks
        self._weights: dict[bytes, tuple[Singles, int]] = {}


def start(
    rest_mm: Floats,
    network: StickingNetwork,
    noise: DotNoise = DotNoise(),  # noqa: B008 - it is constant
) -> StickingState:
    """Start with dots at rest (dots, 2) in mm from the middle of the image, NaN for a missing one.

    network: for example the pretrained one (stages/touch/touch_fold.py). LEAST_DOTS must be there.
    """
    rest_mm = np.asarray(rest_mm, np.float64)
    assert rest_mm.shape[1:] == (2,) and np.isfinite(rest_mm).all(axis=1).sum() >= LEAST_DOTS
    return StickingState(rest_mm, network, noise)


def step(state: StickingState, dot_mm: Floats, lost: Flags, touches: bool) -> StickingReading:
    """Process the dots (dots, 2) of the next slice, of which some are lost (dots,), and whether anything touches.

    Between looks, every BLOCK_MS slices, the last reading is returned. ValueError for another number of dots.
    """
    ended = rest.step(state.rest, dot_mm, lost)
    if ended:
        state._looks_mm[state._looks % KEPT_LOOKS] = state.rest.block_mm
        state._looks += 1
        if state._looks == 1:
            state._looks_mm[:] = state.rest.block_mm
    if not touches:
        state.reference_slice, state._seen_slipping, state.reading = -1, 0, NO_TOUCH
        return NO_TOUCH
    if state.reference_slice < 0:
        state.reference_slice = state.rest.slices - 1
        state.reference_mm[:] = state.rest.block_mm
        state.reading = state.reading._replace(reference_slice=state.reference_slice)
    if ended:
        if state.rest.rests and state.rest.rested == state.rest.slices - 1:
            state.reference_slice = state.rest.rested
            state.reference_mm[:] = state.rest.rest_mm
        state.reading = _look(state)
    return state.reading


def _look(state: StickingState) -> StickingReading:
    """Return the network's result for the last block if enough dots are tracked; else the previous result."""
    tracked = state.rest.tracked & state.there
    weights_and_places = _weights_of(state, tracked)
    if weights_and_places is None:
        return state.reading._replace(reference_slice=state.reference_slice)
    weights, places = weights_and_places
    last = state._looks - 1
    short, long = ((last - back) % KEPT_LOOKS for back in LOOKS_BACK)
    looks = state._looks_mm
    places_mm = (state.at_mm, state.reference_mm, state.rest.block_mm, looks[short], looks[long])
    x, y = _fields(places_mm, weights, places, state.inputs)
    slips, state.has_begun = slip_estimate(state.network, state.inputs)
    sticks = 1.0 - slips
    state._seen_slipping = state._seen_slipping + 1 if state.has_begun >= ALARM else 0
    return StickingReading(
        sticks,
        _deviation(state.network.share_sd, sticks),
        math.atan2(y, x) if sticks < ALL_STICKS else math.nan,
        state.reference_slice,
        state._seen_slipping >= PATIENCE,
    )


@njit(cache=True)
def _fields(
    places_mm: tuple[Floats, Floats, Floats, Floats, Floats], weights: Singles, places: int, inputs: Singles
) -> tuple[float, float]:
    """Fill the network's inputs, and return the mean displacement, x and y, of the lattice positions with a value.

    places_mm: the dots at rest, at the reference, now, a short and a long time ago, (dots, 2) each. weights: (lattice,
    dots). places: number of lattice positions with any weight.
    """
    at_mm, reference_mm, now_mm, short_mm, long_mm = places_mm
    dots = len(at_mm)
    moved = np.empty((dots, 2 * FIELDS), np.float32)
    for dot in range(dots):
        for axis in range(2):
            now = now_mm[dot, axis]
            moved[dot, axis] = reference_mm[dot, axis] - at_mm[dot, axis]
            moved[dot, 2 + axis] = now - reference_mm[dot, axis]
            moved[dot, 4 + axis] = now - short_mm[dot, axis]
            moved[dot, 6 + axis] = now - long_mm[dot, axis]
    reference_total = total = x = y = 0.0
    sums = np.empty(2 * FIELDS, np.float32)
    for place in range(len(weights)):
        sums[:] = 0.0
        for dot in range(dots):
            weight = weights[place, dot]
            for column in range(2 * FIELDS):
                sums[column] += weight * moved[dot, column]
        reference_total += sums[0] * sums[0] + sums[1] * sums[1]
        x += sums[0] + sums[2]
        y += sums[1] + sums[3]
        total += (sums[0] + sums[2]) ** 2 + (sums[1] + sums[3]) ** 2
        inputs[place * 2 * FIELDS : (place + 1) * 2 * FIELDS] = sums
    size_mm = max(math.sqrt(max(reference_total, total) / places), SMALLEST_MM)
    inputs[:-1] /= np.float32(size_mm)
    inputs[-1] = math.log(size_mm / USUAL_MM)
    return x / places, y / places


@njit(cache=True)
def slip_estimate(network: StickingNetwork, inputs: Singles) -> tuple[float, float]:
    """Return the share that slips and the probability that slip has begun, for inputs (INPUTS,).

    The loops take as long as a single BLAS product.
    """
    wide = network.first_bias.copy()
    for place in range(len(inputs)):
        value = inputs[place]
        for unit in range(len(wide)):
            wide[unit] += value * network.first[place, unit]
    narrow = network.second_bias.copy()
    for place in range(len(wide)):
        value = max(wide[place], np.float32(0.0))
        for unit in range(len(narrow)):
            narrow[unit] += value * network.second[place, unit]
    share, begun = float(network.third_bias[0]), float(network.third_bias[1])
    for place in range(len(narrow)):
        value = max(narrow[place], np.float32(0.0))
        share += value * network.third[place, 0]
        begun += value * network.third[place, 1]
    return _probability(share), _probability(begun)


@njit(cache=True, _nrt=False)
def _probability(odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-min(max(odds, -MOST_LOG_ODDS), MOST_LOG_ODDS)))


def _deviation(share_sd: Singles, sticks: float) -> float:
    """Return the standard deviation of a sticking share, interpolated in a table."""
    at = sticks * (len(share_sd) - 1)
    low = min(int(at), len(share_sd) - 2)
    before, after = float(share_sd[low]), float(share_sd[low + 1])
    return before + (at - low) * (after - before)


def _weights_of(state: StickingState, tracked: Flags) -> tuple[Singles, int] | None:
    """Return weights (positions, dots) of the tracked dots and the number of positions with any; None with few dots."""
    key = tracked.tobytes()
    cached = state._weights.get(key)
    if cached is not None:
        return cached
    if np.count_nonzero(tracked) < LEAST_DOTS:
        return None
    if len(state._weights) >= MOST_MASKS:
        state._weights.clear()
    weights = np.zeros((len(LATTICE_MM), len(tracked)), np.float32)
    weights[:, tracked] = lattice_weights(state.at_mm[tracked])
    state._weights[key] = weights, max(int(np.count_nonzero(weights.any(axis=1))), 1)
    return state._weights[key]
