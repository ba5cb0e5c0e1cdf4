"""Assign events to dots: buckets of 16 x 16 px list the dots within reach, and events are processed in blocks.

The lists allow for MARGIN_PX of motion and are rebuilt only when a dot has left that margin, so a slice without motion
does not rebuild them. Most buckets list one dot or none. `first_dot` stores that dot, or that several dots share the
bucket; only then is the list read. (A loop over a list of one entry costs more than everything else here.)

Reasons:
- Events are processed in blocks that stay in the processor's first-level cache. The terms of a whole block are computed
  at once, several events per instruction, and added to the dots afterwards.
- An event near no dot, from a hot pixel or outside the frame is assigned to the dummy dot: the last row of the dots'
  arrays, far away from all pixels. So every event runs through the same instructions, without mispredicted branches.
- Terms are summed as integers of 2**-36. Integer sums do not depend on the order of their terms, so the positions are
  bit-identical for any order of the events in a slice. Truncating a term loses less than 1.5e-11.
- The number of events of a dot and the number in its ring share one integer: the first in the low 32 bits, the second
  above. Counting then costs one addition per event. An array of another type would keep numba from computing several
  terms per instruction (3.5 ns per event instead of 6.4).

The events of hot pixels are ignored. A hot pixel in the ring of a dot would pull it for ever; a DVXplorer has hundreds,
some above 1000 events/s. So the events of every pixel are counted, and a pixel with far more than all of its neighbours
is ignored. The counts decay: row after row is halved, so that each halves every 1.9 s, in a frame of any height. Edges
are not mistaken for hot pixels, even if they vibrate: along an edge, neighbouring pixels have about as many events.

Reason for a separate loop: counting in the loop that assigns events to dots costs more, because its accesses to pixels
all over the frame would wait for each other. While no pixel is hot, the counts are not read again.
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.calibration.grid import MOST_FRAME_PX
from evetac_cli.kernels.compiled import njit

HOT_RATIO = 4  # a hot pixel has at least this many times the events of each neighbour
FADE_SLICES = 1920  # slices in which every row is halved once
HOT = np.uint16(0x8000)  # flag of a hot pixel in its entry pixel_events[y + 1, x + 1]
_COUNT = np.uint16(0x1FFF)  # ... the bits of its recent events,
_POLARITY = np.uint16(0x6000)  # ... and those of the polarities of its last slice with events: OFF, then ON
_OFF_BIT = 13
_ONE = np.uint64(1)
_ROW_BITS = np.uint32(16)  # bit position of the row in an entry of `at_limit`, above the column


@njit(cache=True)
def pixel_counts(state: np.void) -> NDArray[np.uint16]:
    """Return a state's pixel_events as (height + 2, width + 2), with a border of zeros; state: tracker.STATE."""
    width, height = state["frame_px"][0] + 2, state["frame_px"][1] + 2
    pixels: NDArray[np.uint16] = state["pixel_events"]
    return pixels[: width * height].reshape((height, width))


@njit(cache=True)
def _fade(pixel_events: NDArray[np.uint16], halved_row: int, limit: int) -> None:
    """Halve the counts of one row of pixel_events, and find its hot pixels again."""
    busiest = np.uint16(0)
    row = pixel_events[halved_row]
    for column in range(row.shape[0]):
        count = (row[column] & _COUNT) >> np.uint16(1)
        row[column] = (row[column] & _POLARITY) | count
        busiest = max(busiest, count)
    if busiest > limit:
        for column in range(1, row.shape[0] - 1):
            if _is_hot(pixel_events, np.uint64(halved_row), np.uint64(column), limit):
                row[column] |= HOT


@njit(cache=True)
def count_pixels(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    pixel_events: NDArray[np.uint16],
    slices: int,
    limit: int,
) -> bool:
    """Count the events of every pixel into pixel_events; return whether any of them comes from a hot pixel.

    A pixel is checked when its count exceeds the limit, and when its row fades, so nearly every event costs one access.
    The order of events within the slice does not matter: all are counted before any pixel is checked.

    pixel_events: (height + 2, width + 2), the frame with a border of zeros. slices: number of slices before, from 0.
    """
    height, width = pixel_events.shape[0] - 2, pixel_events.shape[1] - 2
    turn = slices % FADE_SLICES
    # Rows r with turn <= r * FADE_SLICES / height < turn + 1.
    for row_y in range(-(-turn * height // FADE_SLICES), -(-(turn + 1) * height // FADE_SLICES)):
        _fade(pixel_events, 1 + row_y, limit)
    seen = np.uint16(0)
    judged = np.uint64(0)
    at_limit = np.empty(x.shape[0], np.uint32)
    for k in range(x.shape[0]):
        if x[k] < width and y[k] < height:
            row = np.uint64(y[k]) + _ONE
            column = np.uint64(x[k]) + _ONE
            before = pixel_events[row, column]
            seen |= before
            events = before & _COUNT
            if events == limit:
                at_limit[judged] = row << np.uint64(_ROW_BITS) | column
                judged += _ONE
            pixel_events[row, column] = before + np.uint16(events != _COUNT)
    for k in range(judged):
        row = np.uint64(at_limit[k] >> _ROW_BITS)
        column = np.uint64(at_limit[k]) & np.uint64(0xFFFF)
        if _is_hot(pixel_events, row, column, limit):
            pixel_events[row, column] |= HOT
            seen |= HOT
    return bool(seen & HOT)


# Motion that an event shows, in the mean, relative to a further event of the same polarity at its pixel, which shows
# one threshold. By what the pixel's last slice with events had: neither polarity (the first event) or both; OFF; ON.
# When a pixel reverses, its brightness first returns to where its last event was, from half a threshold beyond it in
# the mean, and then changes by a threshold: with the half that no event has shown before, two. The values are those
# with the least error of the dots in 24 simulated recordings, seeds 5000 to 5075.
FIRST, REVERSED = 1.5, 2.6
_SHOWS = np.array([[FIRST, 1.0, REVERSED, FIRST], [FIRST, REVERSED, 1.0, FIRST]])  # by polarity, then by those bits


@njit(cache=True)
def motion_shown(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    pixel_events: NDArray[np.uint16],
    shows: NDArray[np.float64],
) -> None:
    """Fill shows (events,) with FIRST, 1 or REVERSED by the last polarity of each event's pixel, and store the new one.

    A slice is taken as one: all events are compared with the slices before, so that their order does not matter.
    pixel_events: as in `count_pixels`.
    """
    height, width = pixel_events.shape[0] - 2, pixel_events.shape[1] - 2
    for k in range(x.shape[0]):
        row = np.uint64(min(y[k], np.uint16(height))) + _ONE
        column = np.uint64(min(x[k], np.uint16(width))) + _ONE
        shows[k] = _SHOWS[min(p[k], 1), (pixel_events[row, column] & _POLARITY) >> np.uint16(_OFF_BIT)]
    for k in range(x.shape[0]):
        row = np.uint64(min(y[k], np.uint16(height))) + _ONE
        column = np.uint64(min(x[k], np.uint16(width))) + _ONE
        pixel_events[row, column] &= ~_POLARITY
    for k in range(x.shape[0]):
        if x[k] < width and y[k] < height:
            pixel_events[np.uint64(y[k]) + _ONE, np.uint64(x[k]) + _ONE] |= np.uint16(1) << np.uint16(
                _OFF_BIT + min(p[k], 1)
            )


@njit(cache=True)
def _is_hot(pixel_events: NDArray[np.uint16], row: int, column: int, limit: int) -> bool:
    """Whether a pixel has more events than the limit and far more than its eight neighbours."""
    events = pixel_events[row, column] & _COUNT
    if events <= limit:
        return False
    for r in range(row - 1, row + 2):
        for c in range(column - 1, column + 2):
            if (r != row or c != column) and HOT_RATIO * (pixel_events[r, c] & _COUNT) > events:
                return False
    return True


MARGIN_PX = 4.0  # motion of a dot after which the lists are rebuilt
BLOCK = 256  # events processed together
UNITS = 2.0**36  # the integer that represents 1 in a sum
DUMMY_DOT_XY_PX = (-1000.0, -1000.0)  # farther from every pixel than the reach of any dot
_BITS = 4  # log2 of the bucket size
SIZE_PX = 1 << _BITS
COLUMNS = MOST_FRAME_PX >> _BITS  # in every frame, because multiplying by a variable takes longer
BUCKETS = COLUMNS**2
OUTSIDE = np.uint16(BUCKETS)  # bucket of events outside the frame

RING_EVENT = np.int64(1) << np.int64(32)  # in a count: one event in the ring
_EVENTS = RING_EVENT - np.int64(1)


def most_entries(dots: int, reach_px: float) -> int:
    """Return the largest number of entries that the lists of this many dots can have."""
    across = int(2 * (reach_px + MARGIN_PX)) // SIZE_PX + 2
    return dots * min(BUCKETS, across**2)


@njit(cache=True)
def split_counts(counts: NDArray[np.int64], events: NDArray[np.int32], ring_events: NDArray[np.int32]) -> None:
    """Split the combined counts (n,), described in the module's docstring, into events and ring events."""
    for i in range(counts.shape[0]):
        events[i] = counts[i] & _EVENTS
        ring_events[i] = counts[i] >> np.int64(32)


@njit(cache=True)
def left_margin(centre_xy_px: NDArray[np.float64], listed_xy_px: NDArray[np.float64]) -> bool:
    """Whether a dot has moved more than the margin since the buckets were filled."""
    for i in range(listed_xy_px.shape[0]):
        if abs(centre_xy_px[i, 0] - listed_xy_px[i, 0]) > MARGIN_PX:
            return True
        if abs(centre_xy_px[i, 1] - listed_xy_px[i, 1]) > MARGIN_PX:
            return True
    return False


@njit(cache=True)
def _within(x_px: float, y_px: float, reach_px: float, rows: int) -> tuple[int, int, int, int]:
    """Return the first and one past the last bucket row, then column, of a square of half width reach_px."""
    first_row = max(0, int(y_px - reach_px) >> _BITS)
    first_column = max(0, int(x_px - reach_px) >> _BITS)
    last_row = min(rows - 1, int(y_px + reach_px) >> _BITS)
    last_column = min(COLUMNS - 1, int(x_px + reach_px) >> _BITS)
    return first_row, last_row + 1, first_column, last_column + 1


@njit(cache=True)
def fill(state: np.void) -> None:
    """List the dots within reach plus the margin of bucket b in bucket_dots[bucket_start[b]:bucket_start[b + 1]].

    listed_xy_px is set to their present positions. first_dot[b] is the only dot, n (the dummy dot) for none, n + 1 for
    several. A missing dot (NaN) is on no list. state: tracker.STATE.
    """
    dots = state["dots"]
    centre_xy_px, listed_xy_px = state["centre_xy_px"][:dots], state["listed_xy_px"][:dots]
    first_dot, bucket_start, bucket_dots = state["first_dot"][:], state["bucket_start"][:], state["bucket_dots"][:]
    rows = (state["frame_px"][1] + SIZE_PX - 1) >> _BITS
    buckets = COLUMNS * rows  # those below the frame are never read
    reach_px = max(state["ring_outer_px"], state["count_radius_px"]) + MARGIN_PX
    bucket_start[: buckets + 1] = 0
    for i in range(dots):
        if np.isnan(centre_xy_px[i, 0]):
            continue
        listed_xy_px[i, 0] = centre_xy_px[i, 0]
        listed_xy_px[i, 1] = centre_xy_px[i, 1]
        row, row_stop, column, column_stop = _within(centre_xy_px[i, 0], centre_xy_px[i, 1], reach_px, rows)
        for r in range(row, row_stop):
            for c in range(column, column_stop):
                bucket_start[r * COLUMNS + c] += 1
    # Turn the counts into the end of every bucket; filling from the end then leaves its beginning.
    total = 0
    for b in range(buckets):
        total += bucket_start[b]
        bucket_start[b] = total
    bucket_start[buckets] = total
    for i in range(dots):
        if np.isnan(centre_xy_px[i, 0]):
            continue
        row, row_stop, column, column_stop = _within(centre_xy_px[i, 0], centre_xy_px[i, 1], reach_px, rows)
        for r in range(row, row_stop):
            for c in range(column, column_stop):
                b = r * COLUMNS + c
                bucket_start[b] -= 1
                bucket_dots[bucket_start[b]] = i
    first_dot[:buckets] = dots
    first_dot[OUTSIDE] = dots
    for b in range(buckets):
        listed = bucket_start[b + 1] - bucket_start[b]
        if listed > 0:
            first_dot[b] = bucket_dots[bucket_start[b]] if listed == 1 else dots + 1


@njit(cache=True)
def nearby_dot(
    state: np.void,
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    any_hot: bool,
    bucket: NDArray[np.uint16],
    near_dot: NDArray[np.uint32],
    near_px: NDArray[np.float64],
) -> bool:
    """Find the dot near each of up to BLOCK events; return whether some of them are in buckets of several dots.

    Fills near_dot, near_px (2, ...) from the dot's centre to the event, and bucket. If `any_hot`, events of hot pixels
    (py) go to the dummy dot. So do events in buckets of several dots, until `nearby_dots` pairs them.
    state: tracker.STATE.
    """
    centre_xy_px, first_dot = state["centre_xy_px"][: state["dots"] + 1], state["first_dot"][:]
    width, height = np.uint16(state["frame_px"][0]), np.uint16(state["frame_px"][1])
    for k in range(x.shape[0]):
        inside = (x[k] < width) & (y[k] < height)
        b = (y[k] >> np.uint16(_BITS)) * np.uint16(COLUMNS) + (x[k] >> np.uint16(_BITS))
        bucket[k] = b if inside else OUTSIDE
    if any_hot:
        pixel_events = pixel_counts(state)
        for k in range(x.shape[0]):
            # Outside the frame any pixel can be read: the bucket is OUTSIDE already.
            row = np.uint64(min(y[k], np.uint16(height - 1))) + _ONE
            column = np.uint64(min(x[k], np.uint16(width - 1))) + _ONE
            bucket[k] = OUTSIDE if pixel_events[row, column] & HOT else bucket[k]
    dummy_dot = np.uint32(centre_xy_px.shape[0] - 1)
    several = False
    for k in range(x.shape[0]):
        # Unsigned, as the buckets are: numba then does not check for negative indices.
        i = first_dot[bucket[k]]
        several |= i > dummy_dot
        i = min(i, dummy_dot)
        near_dot[k] = i
        near_px[0, k] = centre_xy_px[i, 0]
        near_px[1, k] = centre_xy_px[i, 1]
    for k in range(x.shape[0]):
        near_px[0, k] = x[k] - near_px[0, k]
        near_px[1, k] = y[k] - near_px[1, k]
    return several


@njit(cache=True)
def nearby_dots(
    state: np.void,
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    begin: int,
    bucket: NDArray[np.uint16],
    near_dot: NDArray[np.uint32],
    near_px: NDArray[np.float64],
    near_event: NDArray[np.int64],
) -> tuple[int, int]:
    """Pair the events of a block in buckets of several dots, starting at `begin`, with every dot they may belong to.

    Fills near_dot, near_px and near_event, the events' indices. Returns the event to continue at, and the number of
    pairs. There is room for BLOCK pairs plus one per dot. `bucket` comes from `nearby_dot`; state: tracker.STATE.
    """
    centre_xy_px, first_dot = state["centre_xy_px"][: state["dots"] + 1], state["first_dot"][:]
    bucket_start, bucket_dots = state["bucket_start"][:], state["bucket_dots"][:]
    dummy_dot = np.uint32(state["dots"])
    pairs = 0
    k = begin
    while k < x.shape[0] and pairs < BLOCK:
        b = bucket[k]
        if first_dot[b] > dummy_dot:
            for entry in range(bucket_start[b], bucket_start[b + 1]):
                i = bucket_dots[entry]
                near_dot[pairs] = i
                near_px[0, pairs] = x[k] - centre_xy_px[i, 0]
                near_px[1, pairs] = y[k] - centre_xy_px[i, 1]
                near_event[pairs] = k
                pairs += 1
        k += 1
    return k, pairs
