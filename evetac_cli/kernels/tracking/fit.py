"""Solve for the motion of all dots in a slice, from the events of their rims: the preset `stable` of the tracker.

An event in a dot's ring, at distance d from the centre in direction n, is evidence of three things:
- The rim is at the event. beyond = d - rim is the distance that the dot must move along n. This is a least-squares
  problem over all of the dot's events (Gauss-Newton on the paper's data term), damped by 1 / (2 step_size) so that few
  events move a dot as the paper's step would.
- The event is on the leading or the trailing rim. A moving dark dot has OFF events (darker) on its leading rim and ON
  events (brighter) on its trailing rim. So the sum of +n and -n points along the motion and grows with it: each event
  counts as `event_px` of motion, times what it shows (see below). This sum is called the motion seen. Both rims agree
  if the dot itself moves.
- The event came late. A pixel has an event after its level has changed by the contrast threshold, so either rim is
  seen `rim_lag_px` behind the motion. Since the side is known, this lag is subtracted.

What an event shows: a pixel sends an event when its brightness has changed by the threshold since its last event. If it
goes on in the same direction, its next event shows one threshold. If it turns, it must first go back, so that the event
shows more than two; a pixel's first event shows one and a half, since the level at which it starts is unknown
(buckets.py). Counted alike, a dot under a load that comes and goes appears to move by half. A pixel has one event per
scan, however far its brightness goes meanwhile, so fast motion makes fewer events: a share of `unseen_per_px` for every
px per slice. This and the sensor's contrast over threshold, if known, make the motion seen right by itself. The rims
then correct it.

Noise shows no motion: of the ring events of a dot and its neighbours within the last 30 ms, those that the camera's
noise makes anyhow are left out, as a share of all. So dots at rest stay where they are, instead of walking away by a
tenth of a px in a minute, while the slowest load still makes more events than noise.

Events are spread evenly over the slice, so the rims are seen where they were half way through. With H = sum w n n^T,
s = sum w beyond n and the motion seen f, the correction c to f solves H c = s - H f / 2.

Reasons:
- Neighbours share the correction, not the motion. Next to a gel that slips, a dot without events stays in place because
  it has seen no motion; still, eight dots together find what the few events of one leave undetermined.
- H and s are scaled down to `most_events`, so that neighbours that have seen nothing outvote a flood of 10,000 events
  on one dot. A dot that moves 2 px in a slice causes 600 events, and all of them must count: f underestimates such a
  jump, because a pixel has one event per scan. (With a limit of 200, dots that swing at 498 Hz, 2 px per slice, were
  off by 2 px.)
- An object's edge that slides over the gel is brighter or darker than what it covers, so its events have one polarity.
  A moving dot causes as many events of both. So the part that one rim shows beyond the other, and beyond chance, is not
  motion of the dot. The more a dot's events have one polarity, the less they show of its rim, and H and s are scaled
  down accordingly. Otherwise every edge that rubs over a dot would drag it along by some tenths of a pixel. (This does
  not work for a camera that has sent only one polarity so far.)
- The weight w = (1 - (beyond / half ring)^2)^2 falls to zero at the sides of the ring, so that events that fit the rim
  badly count little.
- The result is bounded for any finite constants: every sweep takes a mean of bounded values with non-negative weights,
  or a damped solution of a positive definite system. The step is finally limited to `trust_px`.
- No divisor can be zero, so numba need not test for it (error_model="numpy"). This saves 0.6 us per slice.

Tested on simulated slip, shear and rubbing edges. The paper's preset does not move a dot with fewer than 11 events per
slice.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.calibration.grid import MAX_NEIGHBOURS
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.tracking import buckets
from evetac_cli.kernels.tracking.buckets import RING_EVENT, UNITS

SIDE = 4
# Per dot: w beyond n (2), w n n^T (xx, xy); of OFF events w, w n (2), counts; the same of ON events.
SUMS = 3 * SIDE
DARKER = SIDE
BRIGHTER = 2 * SIDE
COUNTS = 3  # index of the counts (buckets.py) among the four numbers of either polarity
SYSTEM = 8  # numbers per dot: inverse matrix (xx, xy, yy), right side (2), correction (2), weight of a neighbour
CHANCE = 1.0  # both rims may differ by this many standard deviations, each the square root of the sum of w
SHOWN_BY_ONE = 4.0  # what the rims show may differ by this in addition: slow motion has one event in many slices
MOST_UNSEEN = 0.6  # most of a slice's motion that is taken to have no events
UNLIMITED = 1e12  # ... this many explain every difference
LEAST_SHARE = 0.01  # with a smaller share of one polarity, the camera is taken to send only the other
LIGHT_DOTS = 0.75  # the light changes, and nothing moves, if this share of the dots has events of one polarity,
LIGHT_AHEAD = 0.6  # ... and it exceeds the other polarity by this share of all events
LIGHT_SLICES = 50.0  # time constant, in slices, of the count of such slices
# The rate of noise is the lowest share of dots that have any event in a slice, as a mean over NOISE_SLICES. It is known
# after the first NOISE_KNOWN_SLICES, and forgotten in NOISE_KEPT_SLICES.
NOISE_SLICES, NOISE_KNOWN_SLICES, NOISE_KEPT_SLICES = 1000.0, 100.0, 20_000.0
MOST_NOISE = 0.1  # ring events of a dot and slice: a recording may begin with motion, which is not noise
RATE_SLICES = 30.0  # time constant of a dot's rate
LEAST_DAMPING = 1e-9  # of the matrix: with less, rounding would decide
MOST_WEIGHT = 1e12  # of neighbours: beyond this, they move as one body to the last bit


@njit(cache=True)
def measure_rims(
    state: np.void,
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    any_hot: bool,
    sums: NDArray[np.int64],
) -> None:
    """Add every event to the sums of the dots it is near: the rim position that it shows, and counts.

    state: tracker.STATE; sums: (dots + 1, SUMS), initially zero.
    """
    if x.shape[0] == 0:
        return
    half_ring_px = state["ring_outer_px"] - state["radius_px"]
    constants = state["radius_px"], half_ring_px, state["rim_lag_px"], state["count_radius_px"]
    room = buckets.BLOCK + state["dots"] + 1
    bucket = np.empty(buckets.BLOCK, np.uint16)
    near_dot = np.empty(room, np.uint32)
    near_px = np.empty((3, room))
    near_event = np.empty(room, np.int64)
    near_p = np.empty(room, np.uint8)
    shows = np.empty(x.shape[0])
    buckets.motion_shown(x, y, p, buckets.pixel_counts(state), shows)
    terms = np.empty((2 * SIDE, room), np.int64)
    for begin in range(0, x.shape[0], buckets.BLOCK):
        end = min(begin + buckets.BLOCK, x.shape[0])
        xs = x[begin:end]
        ys = y[begin:end]
        several = buckets.nearby_dot(state, xs, ys, any_hot, bucket, near_dot, near_px)
        near_px[2, : end - begin] = shows[begin:end]
        _add_rims(end - begin, near_dot, near_px, p[begin:end], constants, terms, sums)
        k = 0 if several else len(xs)
        while k < len(xs):
            k, pairs = buckets.nearby_dots(state, xs, ys, k, bucket, near_dot, near_px, near_event)
            for pair in range(pairs):
                near_p[pair] = p[begin + near_event[pair]]
                near_px[2, pair] = shows[begin + near_event[pair]]
            _add_rims(pairs, near_dot, near_px, near_p, constants, terms, sums)


@njit(cache=True)
def _add_rims(
    pairs: int,
    near_dot: NDArray[np.uint32],
    near_px: NDArray[np.float64],
    near_p: NDArray[np.uint8],
    constants: tuple[float, float, float, float],
    terms: NDArray[np.int64],
    sums: NDArray[np.int64],
) -> None:
    """Add pairs of an event and a dot to the dots' sums; terms is workspace.

    near_px: (3, pairs) the way from the dot to the event, and the motion that the event shows (buckets.py).
    """
    radius_px, half_ring_px, rim_lag_px, count_radius_px = constants
    per_half_ring = 1.0 / half_ring_px
    count_radius_px2 = count_radius_px * count_radius_px
    for k in range(pairs):
        dx = near_px[0, k]
        dy = near_px[1, k]
        # A leading rim makes OFF events (p = 0), a trailing rim ON events, both late.
        leading = 1.0 if near_p[k] == 0 else -1.0
        rim_px = radius_px - leading * rim_lag_px
        distance_px2 = max(dx * dx + dy * dy, 1e-12)
        distance_px = sqrt(distance_px2)
        beyond_px = distance_px - rim_px
        off = beyond_px * per_half_ring
        shape = max(1.0 - off * off, 0.0)
        weight = shape * shape * UNITS
        nx = dx / distance_px
        ny = dy / distance_px
        terms[0, k] = int(weight * beyond_px * nx)
        terms[1, k] = int(weight * beyond_px * ny)
        terms[2, k] = int(weight * nx * nx)
        terms[3, k] = int(weight * nx * ny)
        terms[4, k] = int(weight)
        shown = (shape > 0.0) * near_px[2, k] * UNITS
        terms[5, k] = int(shown * nx)
        terms[6, k] = int(shown * ny)
        terms[DARKER + COUNTS, k] = (shape > 0.0) * RING_EVENT + (distance_px2 < count_radius_px2)
    for k in range(pairs):
        i = np.uint64(near_dot[k])
        side = np.uint64(DARKER + SIDE * (near_p[k] != 0))  # no branch: the processor could not predict it
        sums[i, 0] += terms[0, k]
        sums[i, 1] += terms[1, k]
        sums[i, 2] += terms[2, k]
        sums[i, 3] += terms[3, k]
        sums[i, side] += terms[4, k]
        sums[i, side + np.uint64(1)] += terms[5, k]
        sums[i, side + np.uint64(2)] += terms[6, k]
        sums[i, side + np.uint64(COUNTS)] += terms[DARKER + COUNTS, k]


@njit(cache=True, error_model="numpy")
def solve(
    state: np.void, sums: NDArray[np.int64], ring_events: NDArray[np.int32], shift_px: NDArray[np.float64]
) -> bool:
    """Fill shift_px (dots, 2) with every dot's motion if a dot has more than min_events events; return whether one has.

    state: tracker.STATE.
    """
    dots = state["dots"]
    neighbours, neighbour_count = state["neighbours"][:dots], state["neighbour_count"][:dots]
    polarity_weight = state["polarity_weight"][:]
    moves = False
    for i in range(dots):
        moves |= ring_events[i] > state["min_events"]
    _measure_rates(state, ring_events)
    if not moves:
        return False
    for i in range(dots):
        polarity_weight[0] += sums[i, DARKER] / UNITS
        polarity_weight[1] += sums[i, BRIGHTER] / UNITS
    both = polarity_weight[0] + polarity_weight[1]
    chance = CHANCE if min(polarity_weight[0], polarity_weight[1]) > LEAST_SHARE * both else UNLIMITED
    state["light_slices"] *= 1.0 - 1.0 / LIGHT_SLICES
    state["light_slices"] += chance == CHANCE and _light_changes(dots, sums)
    damping = 0.5 / state["step_size"]
    of_motion = state["trust_px"], state["event_px"], state["unseen_per_px"]
    system = np.empty((dots, SYSTEM))
    one_rim_px, too_far = state["one_rim_px"][:dots], state["too_far"][:dots]
    for i in range(dots):
        constants = damping, state["regulariser_weight"], state["most_events"], chance, *of_motion, _not_noise(state, i)
        _set_up(i, sums, neighbour_count[i], constants, system, shift_px, one_rim_px, too_far)
    for _ in range(state["sweeps"]):
        for i in range(dots):
            right_x = system[i, 3]
            right_y = system[i, 4]
            weight = system[i, 7]
            for entry in range(neighbour_count[i]):
                j = np.uint64(neighbours[i, entry])
                right_x += weight * system[j, 5]
                right_y += weight * system[j, 6]
            system[i, 5] = system[i, 0] * right_x + system[i, 1] * right_y
            system[i, 6] = system[i, 1] * right_x + system[i, 2] * right_y
    for i in range(dots):
        correction_x, correction_y = _limited(system[i, 5], system[i, 6], state["trust_px"])
        shift_px[i, 0] += correction_x
        shift_px[i, 1] += correction_y
    return True


@njit(cache=True, error_model="numpy")
def _measure_rates(state: np.void, ring_events: NDArray[np.int32]) -> None:
    """Update the recent rate of every dot's ring events, and the rate of noise: the lowest of all dots so far."""
    dots = state["dots"]
    ring_rate = state["ring_rate"][:dots]
    busy = 0.0
    for i in range(dots):
        ring_rate[i] += (ring_events[i] - ring_rate[i]) / RATE_SLICES
        busy += ring_events[i] > 0
    slices = state["slices"] + 1.0
    state["busy_share"] += (busy / dots - state["busy_share"]) / min(slices, NOISE_SLICES)
    if slices >= NOISE_KNOWN_SLICES:
        lowest = state["noise_rate"] * (1.0 + 1.0 / NOISE_KEPT_SLICES) if state["noise_rate"] > 0.0 else MOST_NOISE
        state["noise_rate"] = min(lowest, state["busy_share"], MOST_NOISE)


@njit(cache=True, error_model="numpy")
def _not_noise(state: np.void, i: int) -> float:
    """Return the share of the recent ring events of dot i and its neighbours that are more than the camera's noise."""
    rate = state["ring_rate"][i]
    count = state["neighbour_count"][i]
    for entry in range(count):
        rate += state["ring_rate"][state["neighbours"][i, entry]]
    share: float = max(1.0 - state["noise_rate"] * (count + 1) / max(rate, 1e-12), 0.0)
    return share


@njit(cache=True, error_model="numpy")
def _light_changes(dots: int, sums: NDArray[np.int64]) -> bool:
    """Whether the events of nearly all dots have one polarity at once, which a change of light causes, not motion."""
    darker = 0
    brighter = 0
    only_darker = 0
    only_brighter = 0
    for i in range(dots):
        darker += sums[i, DARKER]
        brighter += sums[i, BRIGHTER]
        only_darker += sums[i, DARKER] > 4 * sums[i, BRIGHTER]
        only_brighter += sums[i, BRIGHTER] > 4 * sums[i, DARKER]
    ahead = abs(darker - brighter)
    return max(only_darker, only_brighter) >= LIGHT_DOTS * dots and ahead > LIGHT_AHEAD * (darker + brighter)


@njit(cache=True, error_model="numpy")
def _set_up(
    i: int,
    sums: NDArray[np.int64],
    neighbour_count: int,
    constants: tuple[float, float, float, float, float, float, float, float],
    system: NDArray[np.float64],
    shift_px: NDArray[np.float64],
    one_rim_px: NDArray[np.float64],
    too_far: NDArray[np.uint8],
) -> None:
    """Set shift_px of dot i to the motion seen, and fill its row of the system for the correction, which starts at 0.

    Motion shown by one rim alone is added to one_rim_px; too_far is set if the rims show more than a slice may follow.
    """
    damping, regulariser_weight, most_events, chance, trust_px, event_px, unseen_per_px, not_noise = constants
    xx = sums[i, 2] / UNITS
    xy = sums[i, 3] / UNITS
    total = (sums[i, DARKER] + sums[i, BRIGHTER]) / UNITS
    yy = total - xx  # n is a unit vector
    by_chance = chance * sqrt(total)
    both_x, both_y, alone_x, alone_y = _both_rims(i, sums, by_chance + SHOWN_BY_ONE)
    one_rim_px[i, 0] += event_px * alone_x
    one_rim_px[i, 1] += event_px * alone_y
    shown_x = event_px * (both_x + alone_x)
    shown_y = event_px * (both_y + alone_y)
    too_far[i] = shown_x * shown_x + shown_y * shown_y > 4.0 * trust_px * trust_px
    unseen = unseen_per_px * event_px * sqrt(both_x * both_x + both_y * both_y)
    moved_px = not_noise * event_px / max(1.0 - unseen, 1.0 - MOST_UNSEEN)
    seen_x, seen_y = _limited(moved_px * both_x, moved_px * both_y, trust_px)
    of_one_polarity = max(abs(sums[i, DARKER] - sums[i, BRIGHTER]) / UNITS - by_chance, 0.0)
    scale = min(1.0, most_events / max(total, 1e-12)) * (1.0 - of_one_polarity / max(total, 1e-12)) * not_noise
    damping += LEAST_DAMPING * (1.0 + scale * total)
    weight = MAX_NEIGHBOURS * min(regulariser_weight, MOST_WEIGHT) / max(neighbour_count, 1)
    a = scale * xx + damping + weight * neighbour_count
    b = scale * xy
    c = scale * yy + damping + weight * neighbour_count
    # Divided by a instead of the determinant, which overflows for huge numbers.
    rest = c - b * (b / a)
    system[i, 2] = 1.0 / rest
    system[i, 1] = -(b / a) / rest
    system[i, 0] = 1.0 / a + (b / a) * (b / a) / rest
    system[i, 3] = scale * (sums[i, 0] / UNITS - 0.5 * (xx * seen_x + xy * seen_y))
    system[i, 4] = scale * (sums[i, 1] / UNITS - 0.5 * (xy * seen_x + yy * seen_y))
    system[i, 5] = 0.0
    system[i, 6] = 0.0
    system[i, 7] = weight
    shift_px[i, 0] = seen_x
    shift_px[i, 1] = seen_y


@njit(cache=True, error_model="numpy")
def _both_rims(i: int, sums: NDArray[np.int64], by_chance: float) -> tuple[float, float, float, float]:
    """Return the sum of +n (leading rim) and -n (trailing rim), as far as they agree within chance; and the rest."""
    leading_x = sums[i, DARKER + 1] / UNITS
    leading_y = sums[i, DARKER + 2] / UNITS
    trailing_x = -sums[i, BRIGHTER + 1] / UNITS
    trailing_y = -sums[i, BRIGHTER + 2] / UNITS
    off_x = leading_x - trailing_x
    off_y = leading_y - trailing_y
    off2 = off_x * off_x + off_y * off_y
    both_x = leading_x + trailing_x
    both_y = leading_y + trailing_y
    if off2 <= by_chance * by_chance:
        return both_x, both_y, 0.0, 0.0
    # Subtract the excess of the stronger rim, but never so much that the sum begins to grow again.
    louder = (both_x * off_x + both_y * off_y) / off2  # > 0: the leading rim is stronger
    beyond_chance = 1.0 - by_chance / sqrt(off2)
    share = min(max(louder, -beyond_chance), beyond_chance)
    return both_x - share * off_x, both_y - share * off_y, share * off_x, share * off_y


@njit(cache=True, error_model="numpy")
def _limited(x: float, y: float, most: float) -> tuple[float, float]:
    """Return a vector, shortened to the length `most` if it is longer."""
    length = sqrt(x * x + y * y)
    if length <= most:
        return x, y
    return x * (most / length), y * (most / length)
