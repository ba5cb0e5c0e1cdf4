"""Lines in the image that are not dots: the edges of an object that indents the gel, and the edge of a cut gel.

Both add to the log brightness of a pixel. An object is an image that is drawn once, because it only moves and fades; it
adds strength * picture(pixel - corner), bilinear. The cut edge is a dark line whose position in every row is given. It
moves with the gel and covers pixels of the gel and of the window alike.

The camera tracks how much these levels have changed since its last comparison, and adds the change with the opposite
sign to its references. It then needs only the image of its dots. So lines at rest cost nothing, and only pixels whose
level can have changed are visited: in a row of the outline those before and after its flat middle.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evetac_cli.arrays import Floats
from evetac_cli.errors import check_range
from evetac_cli.kernels.compiled import njit

# An object's edge ends where the error function is within 0.02 % of its limits; it is scaled to reach the limits there.
EDGE_SIGMAS = 3.5
# Pixels are compared again once a level can have changed by this, a fortieth of a threshold.
LEVEL_RESOLUTION = 0.005
# A line (1 - (d / h)^2)^2 is half as deep at d = 0.541 h, and steepest where (d / h)^2 = 1 / 3.
HALF_DEPTH = math.sqrt(1.0 - math.sqrt(0.5))
STEEPEST = 8.0 / (3.0 * math.sqrt(3.0))  # largest slope of that line, per contrast and h
FARTHEST_PX = 1e6
NONE = 1 << 40  # for a row without any pixel to visit: beyond every column


class Outline(NamedTuple):
    """Log brightness of an object that indents the gel (rows, columns), drawn once; 0 on its border.

    `runs` (rows, 4) are the pixels of a row that differ from a neighbour: from the first column up to the second, and
    from the third up to the fourth. `slope` is the steepest slope, per px, `height` the highest level.
    """

    picture: NDArray[np.float32]
    runs: NDArray[np.int64]
    slope: float
    height: float


class EdgePlace(NamedTuple):
    """Position of the lines at one time.

    `corner_px` (x, y): position of the outline's first pixel in the frame. `strength`: 0 (invisible) to 1. `cut_x_px`
    (height,): position of the cut edge in each row, empty without a cut edge.
    """

    corner_px: Floats
    strength: float
    cut_x_px: Floats


NOWHERE = EdgePlace(np.zeros(2), 0.0, np.zeros(0))


class LineMotion(NamedTuple):
    """Lines that move in a slice: their positions at start and end, their shapes, and the camera's last view of them.

    `outline` to `cut_half_px` and `seen_corner` to `seen_cut_level` are those of `ContactEdges`.
    """

    start: EdgePlace
    end: EdgePlace
    outline: Outline
    cut_contrast: float
    cut_half_px: float
    seen_corner: Floats
    seen_cut_x: Floats
    seen_level: NDArray[np.float32]
    seen_cut_level: NDArray[np.float32]


@dataclass
class ContactEdges:
    """The lines in view of one camera, and the camera's last view of them; a camera's `step` changes it in place.

    `seen_level` and `seen_cut_level` (height, width) are the levels that outline and cut edge add at `seen_corner`
    (x, y, strength) and `seen_cut_x`. `events` counts the events of the last slice that no moving dot and no texture
    caused. `rested` is the position at which all lines were compared and stayed for a whole slice: nothing is left to
    do there. `placed` is the end of the last slice, as given and as checked.
    """

    frame_px: tuple[int, int]
    outline: Outline
    cut_contrast: float
    cut_half_px: float
    seen_corner: Floats
    seen_cut_x: Floats
    seen_level: NDArray[np.float32]
    seen_cut_level: NDArray[np.float32]
    rested: EdgePlace | None = None
    placed: tuple[EdgePlace | None, EdgePlace] = (None, NOWHERE)
    events: int = 0

    def still(self, start: EdgePlace, end: EdgePlace, cut_px: float = 0.0) -> bool:
        """Return whether nothing moves or has moved since it was last seen; the cut edge may have moved by `cut_px`."""
        x, y, strength = self.seen_corner
        outline_still = start.strength == end.strength == strength and (
            strength == 0.0 or (start.corner_px == (x, y)).all() and (end.corner_px == (x, y)).all()
        )
        if not outline_still:
            return False
        return all(bool(farthest(place.cut_x_px, self.seen_cut_x) <= cut_px) for place in (start, end))

    def motion(self, start: EdgePlace, end: EdgePlace) -> LineMotion:
        """Return the lines and the last view of them, moving between two positions."""
        return LineMotion(
            start,
            end,
            self.outline,
            self.cut_contrast,
            self.cut_half_px,
            self.seen_corner,
            self.seen_cut_x,
            self.seen_level,
            self.seen_cut_level,
        )

    @property
    def cut_resolution_px(self) -> float:
        """Return how far the cut edge may move before a level has changed by LEVEL_RESOLUTION."""
        return LEVEL_RESOLUTION * self.cut_half_px / (self.cut_contrast * STEEPEST) if self.cut_contrast else 0.0


def start(
    frame_px: tuple[int, int],
    place: EdgePlace,
    outline: Outline | None = None,
    cut_contrast: float = 0.0,
    cut_width_px: float = 3.0,
) -> ContactEdges:
    """Return lines that are already fully visible when the camera starts.

    The cut edge is a line `cut_contrast` log units darker than the gel and `cut_width_px` wide at half its depth.
    """
    width, height = frame_px
    if outline is None:
        outline = Outline(np.zeros((0, 0), np.float32), np.empty((0, 4), np.int64), 0.0, 0.0)
    cut = len(place.cut_x_px) > 0
    contact_edges = ContactEdges(
        frame_px=(width, height),
        outline=outline,
        cut_contrast=float(cut_contrast),
        cut_half_px=0.5 * cut_width_px / HALF_DEPTH,
        seen_corner=np.zeros(3),
        seen_cut_x=np.empty(height if cut else 0),
        seen_level=np.zeros((height, width) if outline.picture.size else (0, 0), np.float32),
        seen_cut_level=np.zeros((height, width) if cut else (0, 0), np.float32),
    )
    checked = check_place("place", contact_edges, place)
    contact_edges.seen_corner[:] = *checked.corner_px, checked.strength
    contact_edges.seen_cut_x[:] = checked.cut_x_px
    for y in range(len(contact_edges.seen_level)):
        sample_row(outline.picture, *checked.corner_px, checked.strength, y, 0, width, contact_edges.seen_level[y])
    for y in range(len(contact_edges.seen_cut_level)):
        sample_cut(
            contact_edges.cut_contrast,
            contact_edges.cut_half_px,
            checked.cut_x_px[y],
            0,
            width,
            contact_edges.seen_cut_level[y],
        )
    return contact_edges


def check_place(name: str, contact_edges: ContactEdges, place: EdgePlace) -> EdgePlace:
    """Return the position as arrays of the right type; ValueError if values are not finite."""
    corner = np.ascontiguousarray(place.corner_px, np.float64)
    cut_x = np.ascontiguousarray(place.cut_x_px, np.float64)
    assert corner.shape == (2,) and cut_x.shape == contact_edges.seen_cut_x.shape
    if not (_all_within(corner, FARTHEST_PX) and _all_within(cut_x, FARTHEST_PX)):
        raise ValueError(f"{name}: expected finite positions within {FARTHEST_PX:g} px")
    assert 0.0 <= place.strength <= 1.0
    return EdgePlace(corner, float(place.strength), cut_x)


@njit(cache=True, _nrt=False)
def _all_within(places: Floats, limit: float) -> bool:
    within = True
    for place in places:
        within &= abs(place) <= limit  # false for NaN
    return within


@njit(cache=True, _nrt=False)
def farthest(places: Floats, others: Floats) -> float:
    """Return the largest distance between two arrays of positions; 0 for empty arrays."""
    farthest = 0.0
    for k in range(len(places)):
        farthest = max(farthest, abs(places[k] - others[k]))
    return farthest


def ellipse(size_px: ArrayLike, level: float, width_px: float, thick_px: float | None = None) -> Outline:
    """Return the outline of an ellipse of size (x, y): L = level * Phi(d / width), d the depth inside the edge.

    With `thick_px` it is a ring with a second edge that far inside the first: L = level * (Phi(d_outer / width) -
    Phi(d_inner / width)). ValueError unless level and width are positive and a ring has a hole.
    """
    size = np.asarray(size_px, np.float64)
    assert size.shape == (2,) and np.isfinite(size).all() and (size > 0).all()
    check_range("level", level, above=True)
    check_range("width_px", width_px, above=True)
    if thick_px is not None:
        check_range("thick_px", thick_px, 0.0, 0.5 * size.min(), above=True, below=True)
    half = np.ceil(0.5 * size + EDGE_SIGMAS * width_px) + 2
    x, y = np.meshgrid(np.arange(-half[0], half[0] + 1), np.arange(-half[1], half[1] + 1))
    shade = _edge(_depth(x, y, 0.5 * size) / width_px)
    if thick_px is not None:
        shade -= _edge(_depth(x, y, 0.5 * size - thick_px) / width_px)
    picture = (level * shade).astype(np.float32)
    down, across = np.gradient(picture)
    slope = float(np.hypot(down, across).max())
    return Outline(np.ascontiguousarray(picture), _runs(picture), slope, float(picture.max()))


def _depth(x: Floats, y: Floats, half: Floats) -> Floats:
    """Return the distance of points to an ellipse about the origin, positive inside.

    The nearest point on the ellipse is (a^2 x / (t + a^2), b^2 y / (t + b^2)). The t that puts it on the ellipse is
    found by bisection (Eberly, Distance from a Point to an Ellipse).
    """
    turned = half[0] < half[1]
    long, short = (half[1], half[0]) if turned else (half[0], half[1])
    across, down = (np.abs(y), np.abs(x)) if turned else (np.abs(x), np.abs(y))
    down = np.maximum(down, 1e-9)  # avoids the long axis, whose points may be nearest to another point: a limit instead
    low = short * down - short**2
    high = np.hypot(long * across, short * down) - short**2
    for _ in range(60):
        middle = 0.5 * (low + high)
        outside = (long * across / (middle + long**2)) ** 2 + (short * down / (middle + short**2)) ** 2 > 1.0
        low = np.where(outside, middle, low)
        high = np.where(outside, high, middle)
    near_x = long**2 * across / (high + long**2)
    near_y = short**2 * down / (high + short**2)
    inside = (across / long) ** 2 + (down / short) ** 2 < 1.0
    depth: Floats = np.where(inside, 1.0, -1.0) * np.hypot(across - near_x, down - near_y)
    return depth


def _edge(sigmas: Floats) -> Floats:
    """Return Phi, scaled to reach 0 and 1 at EDGE_SIGMAS on either side."""
    places = np.linspace(-EDGE_SIGMAS, EDGE_SIGMAS, 2049)
    lit = np.array([0.5 * math.erfc(-place / math.sqrt(2.0)) for place in places])
    shade: Floats = np.interp(sigmas, places, (lit - lit[0]) / (lit[-1] - lit[0]))
    return shade


def _runs(picture: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the first and last pixels of each row that differ from a neighbour, without the longest gap between."""
    rows, columns = picture.shape
    padded = np.pad(picture, 1)
    around = np.stack([padded[r : r + rows, c : c + columns] for r in range(3) for c in range(3)])
    differs = around.max(axis=0) != around.min(axis=0)
    runs = np.tile(np.array([NONE, -NONE, NONE, -NONE], np.int64), (rows, 1))
    for row in range(rows):
        columns_at = np.flatnonzero(differs[row])
        if len(columns_at):
            gaps = np.diff(columns_at)
            widest = int(np.argmax(gaps)) if len(gaps) else 0
            second = min(widest + 1, len(columns_at) - 1)
            runs[row] = columns_at[0], columns_at[widest] + 1, columns_at[second], columns_at[-1] + 1
    return runs


@njit(cache=True, _nrt=False)
def outline_moved(
    outline_slope: float, outline_height: float, seen: Floats, x: float, y: float, strength: float
) -> bool:
    """Return whether an outline has moved or faded so much that a level can have changed by LEVEL_RESOLUTION."""
    if strength == 0.0 and seen[2] == 0.0:
        return False
    faded = abs(strength - seen[2]) * outline_height
    moved = math.hypot(x - seen[0], y - seen[1]) * outline_slope * max(strength, seen[2])
    gone = strength == 0.0
    return gone or faded + moved >= LEVEL_RESOLUTION


@njit(cache=True, _nrt=False)
def outline_rows(rows: int, height: int, y_a: float, y_b: float) -> tuple[int, int]:
    """Return the rows of a frame, from and up to, that an outline touches with its corner at y_a or y_b."""
    first = max(0, math.floor(min(y_a, y_b)) - 1)
    end = min(height, math.ceil(max(y_a, y_b)) + rows + 1)
    return first, max(first, end)


@njit(cache=True, _nrt=False)
def outline_runs(
    runs: NDArray[np.int64],
    columns: int,
    width: int,
    y: int,
    x_a: float,
    y_a: float,
    x_b: float,
    y_b: float,
    faded: bool,
) -> tuple[int, int, int, int]:
    """Return the pixels of row y whose level can differ while an outline's corner moves from (x_a, y_a) to (x_b, y_b).

    The pixels are those from the first column up to the second, and from the third up to the fourth, within the frame.
    If the outline has also `faded`, they include its flat middle.
    """
    left = NONE
    left_end = -NONE
    right = NONE
    right_end = -NONE
    low = max(0, math.floor(y - max(y_a, y_b)) - 1)
    high = min(len(runs) - 1, math.ceil(y - min(y_a, y_b)) + 1)
    for row in range(low, high + 1):
        left = min(left, runs[row, 0])
        left_end = max(left_end, runs[row, 1])
        right = min(right, runs[row, 2])
        right_end = max(right_end, runs[row, 3])
    if left >= right_end:
        return 0, 0, 0, 0
    before = math.floor(min(x_a, x_b)) - 1
    beyond = math.ceil(max(x_a, x_b)) + 1
    left = min(max(left + before, 0), width)
    right_end = min(max(right_end + beyond, left), width)
    left_end = min(max(left_end + beyond, left), right_end)
    right = min(max(right + before, left), right_end)
    if faded or left_end >= right:
        return left, right_end, right_end, right_end
    return left, left_end, right, right_end


@njit(cache=True, _nrt=False)
def sample_row(
    picture: NDArray[np.float32],
    corner_x: float,
    corner_y: float,
    strength: float,
    y: int,
    first: int,
    end: int,
    line: NDArray[np.float32],
) -> None:
    """Fill line[: end - first] with the outline's level at pixels first to end of row y; 0 outside its picture."""
    rows, columns = picture.shape
    row = math.floor(y - corner_y)
    column = math.floor(first - corner_x)
    if strength == 0.0 or not 0 <= row < rows - 1:
        line[: end - first] = 0.0
        return
    begin = min(max(-column, 0), end - first)
    stop = max(begin, min(columns - 1 - column, end - first))
    line[:begin] = 0.0
    line[stop : end - first] = 0.0
    part_x = first - corner_x - column
    part_y = y - corner_y - row
    upper_left = np.float32(strength * (1.0 - part_y) * (1.0 - part_x))
    upper_right = np.float32(strength * (1.0 - part_y) * part_x)
    lower_left = np.float32(strength * part_y * (1.0 - part_x))
    lower_right = np.float32(strength * part_y * part_x)
    above = picture[row, column + begin : column + stop + 1]
    below = picture[row + 1, column + begin : column + stop + 1]
    out = line[begin:stop]
    for k in range(stop - begin):
        out[k] = upper_left * above[k] + upper_right * above[k + 1] + lower_left * below[k] + lower_right * below[k + 1]


@njit(cache=True, _nrt=False)
def cut_moved(contrast: float, half: float, seen_x: float, x: float) -> bool:
    """Return whether the cut edge has moved so much in a row that a level can have changed by LEVEL_RESOLUTION."""
    return abs(x - seen_x) * contrast * STEEPEST >= LEVEL_RESOLUTION * half


@njit(cache=True, _nrt=False)
def cut_run(half: float, width: int, x_a: float, x_b: float) -> tuple[int, int]:
    """Return the pixels of a row, from and up to, whose level can differ while the cut edge moves from x_a to x_b."""
    first = min(max(math.ceil(min(x_a, x_b) - half), 0), width)
    end = min(max(math.floor(max(x_a, x_b) + half) + 1, first), width)
    return first, end


@njit(cache=True, _nrt=False)
def sample_cut(contrast: float, half: float, cut_x: float, first: int, end: int, line: NDArray[np.float32]) -> None:
    """Fill line[: end - first] with the cut edge's level at those pixels; it crosses the row at cut_x."""
    for k in range(end - first):
        away = (first + k - cut_x) / half
        depth = max(1.0 - away * away, 0.0)
        line[k] = np.float32(-contrast * depth * depth)
