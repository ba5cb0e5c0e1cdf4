"""The camera's image in log brightness: dark dots with soft rims on the gel, and an object's texture in the window.

Levels are natural logarithms of brightness relative to bare gel, which is 0. Both images are tables that are computed
once: a dot's brightness over the distance from its centre, and a periodic texture that moves with the object. They are
looked up for millions of pixels per second, hence single precision and loops that a compiler can vectorise.

Dots may differ (`DotShapes`): each has its own radius and contrast; the softness of their rims is the same.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import check_range
from evetac_cli.kernels.compiled import njit

LOG_CONTRAST = 1.61  # ln(gel / dot), brightness 5 : 1
EDGE_SIGMA_PX = 1.2
# The rim ends where the error function is within 0.0011 log units of its limit, half a percent of a threshold of 0.2;
# each further sigma/2 would add 8 % to the pixels to visit. The logarithm has the longer tail on the dark side.
INNER_SIGMAS = 3.5
OUTER_SIGMAS = 3.0
PROFILE_STEPS = 1024  # entries of a dot's profile
LEVEL_BINS = 4096  # entries of the index by level
# The edge's formula never reaches its limits, ink and bare gel, but the table does. Levels this close to a limit, far
# more than rounding, count as the limit. Otherwise a returning dot would end with an event that no edge causes.
LIMIT_MARGIN = 1e-5
# Upper bound of single precision's error of a level, relative to 1 + threshold + reference.
LEVEL_ROUNDING = 3e-5


# Result of `texture_place`: column, row, and four weights.
TexturePlace = tuple[int, int, np.float32, np.float32, np.float32, np.float32]


class DotProfile(NamedTuple):
    """Log brightness over the distance from a dot's centre, in equal steps from `inner_px` to `outer_px`.

    Up to `inner_px` (negative for a small dot) the level is exactly that of ink, and from `outer_px` exactly 0. So the
    ring is finite: a pixel outside it cannot change and may be left out. The last entry of `level` is repeated.
    """

    inner_px: float
    outer_px: float
    steps_per_px: float
    level: NDArray[np.float32]


def dot_profile(radius_px: float, sigma_px: float = EDGE_SIGMA_PX, log_contrast: float = LOG_CONTRAST) -> DotProfile:
    """Return the table of L(rho) = ln(I_dot + (I_gel - I_dot) Phi((rho - radius) / sigma)), a dark disc on bright gel.

    `sigma_px` is the blur of the rim, `log_contrast` is ln(I_gel / I_dot). ValueError unless all are positive and
    finite.
    """
    for name, value in (("radius_px", radius_px), ("sigma_px", sigma_px), ("log_contrast", log_contrast)):
        check_range(name, value, above=True)
    sigmas = np.linspace(-INNER_SIGMAS, OUTER_SIGMAS, PROFILE_STEPS + 1)
    ink = math.exp(-log_contrast)
    lit = np.array([0.5 * (1.0 + math.erf(sigma / math.sqrt(2.0))) for sigma in sigmas])
    level = np.log(ink + (1.0 - ink) * lit)
    level[0] = -log_contrast
    level[-1] = 0.0
    return DotProfile(
        inner_px=radius_px - INNER_SIGMAS * sigma_px,
        outer_px=radius_px + OUTER_SIGMAS * sigma_px,
        steps_per_px=PROFILE_STEPS / ((INNER_SIGMAS + OUTER_SIGMAS) * sigma_px),
        level=np.append(level, level[-1]).astype(np.float32),
    )


@njit(cache=True, _nrt=False)
def profile_position(distance2_px2: np.float32, inner_px: np.float32, steps_per_px: np.float32) -> np.float32:
    """Return the position of a squared distance from the dot's centre in a profile's table, 0 to PROFILE_STEPS."""
    position = (np.sqrt(distance2_px2) - inner_px) * steps_per_px
    return min(max(position, np.float32(0.0)), np.float32(PROFILE_STEPS))


@njit(cache=True, _nrt=False)
def profile_level(position: np.float32, level: NDArray[np.float32]) -> np.float32:
    """Return the log brightness at a position in a profile's table, linear between its entries."""
    index = np.int32(position)
    entry = np.uint32(index)  # a signed index may count from the end, which prevents vectorised loops
    below = level[entry]
    return below + (position - np.float32(index)) * (level[entry + np.uint32(1)] - below)  # type: ignore[no-any-return]


def level_index(profile: DotProfile) -> NDArray[np.int16]:
    """Return an index of a profile: entry k is the last position at or below the k-th of LEVEL_BINS + 1 levels.

    The levels are equally spaced from ink to gel. The index saves most of the bisection in `squared_radius`.
    """
    ink = np.float64(profile.level[0])
    levels = ink * (1.0 - np.arange(LEVEL_BINS + 1) / LEVEL_BINS)
    index = np.searchsorted(profile.level[: PROFILE_STEPS + 1].astype(np.float64), levels, side="right") - 1
    return index.astype(np.int16)


@njit(cache=True, _nrt=False)
def squared_radius(
    target: float, inner_px: float, steps_per_px: float, level: NDArray[np.float32], index: NDArray[np.int16]
) -> float:
    """Return the squared distance at which a dot has the level `target`: the exact inverse of the table.

    -1 if the dot is brighter even at its centre or the target is ink; infinite if bare gel is darker or is the target.
    `index` is from `level_index`.
    """
    ink = np.float64(level[0])
    if target < ink + LIMIT_MARGIN:
        return -1.0
    if target > -LIMIT_MARGIN:
        return np.inf
    if math.isnan(target):
        return np.nan
    guess = min(int((target - ink) / -ink * LEVEL_BINS), LEVEL_BINS - 1)
    first = index[guess]
    last = min(index[guess + 1] + 1, PROFILE_STEPS)
    while first > 0 and level[first] > target:
        first -= 1
    while last < PROFILE_STEPS and level[last] <= target:
        last += 1
    while last - first > 1:
        middle = (first + last) // 2
        if level[middle] <= target:
            first = middle
        else:
            last = middle
    below = np.float64(level[first])
    rise = np.float64(level[last]) - below
    part = min(max((target - below) / rise, 0.0), 1.0) if rise > 0.0 else 0.0
    radius = inner_px + (first + part) / steps_per_px
    return radius * radius if radius >= 0.0 else -1.0


@njit(cache=True, _nrt=False)
def quiet_radii(
    reference: float,
    threshold: float,
    inner_px: float,
    outer_px: float,
    steps_per_px: float,
    level: NDArray[np.float32],
    index: NDArray[np.int16],
) -> tuple[float, float]:
    """Return the squares of two distances between which a dot's level is certainly within a threshold of a reference.

    Compared with `squared_radius`, a margin covers the error of single precision. If the first is infinite there are no
    such distances.
    """
    if threshold == np.inf:
        return 0.0, np.inf
    rounding_px = 1e-5 * outer_px + 1e-3 / steps_per_px
    within = threshold - LEVEL_ROUNDING * (1.0 + threshold + abs(reference))
    lower2 = squared_radius(reference - within, inner_px, steps_per_px, level, index)
    upper2 = squared_radius(reference + within, inner_px, steps_per_px, level, index)
    lower = math.sqrt(max(lower2, 0.0)) + rounding_px
    if upper2 > 0.0:
        upper = max(math.sqrt(upper2) - rounding_px, 0.0)
        upper2 = upper * upper
    return lower * lower, upper2


def gel_level(frame_px: tuple[int, int], dot_xy_px: NDArray[np.float64], profile: DotProfile) -> NDArray[np.float32]:
    """Return the log brightness of the frame, (height, width), for dots (dots, 2); the nearest dot counts."""
    width, height = frame_px
    picture = np.zeros((height, width), np.float32)
    draw_dots(picture, dot_xy_px, *profile)
    return picture


@njit(cache=True, _nrt=False)
def draw_dots(
    picture: NDArray[np.float32],
    dot_xy_px: NDArray[np.float64],
    inner_px: float,
    outer_px: float,
    steps_per_px: float,
    level: NDArray[np.float32],
) -> None:
    """Draw dots (dots, 2) into an image (height, width) of levels; the darkest counts."""
    height, width = picture.shape
    for dot in range(len(dot_xy_px)):
        dot_x = dot_xy_px[dot, 0]
        dot_y = dot_xy_px[dot, 1]
        for y in range(max(0, math.ceil(dot_y - outer_px)), min(height, math.floor(dot_y + outer_px) + 1)):
            down = np.float32(y - dot_y)
            for x in range(max(0, math.ceil(dot_x - outer_px)), min(width, math.floor(dot_x + outer_px) + 1)):
                across = np.float32(x - dot_x)
                distance2 = across * across + down * down
                position = profile_position(distance2, np.float32(inner_px), np.float32(steps_per_px))
                picture[y, x] = min(picture[y, x], profile_level(position, level))


@njit(cache=True, _nrt=False)
def dot_row(
    dot_xy_px: NDArray[np.float64],
    inner_px: float,
    outer_px: float,
    steps_per_px: float,
    level: NDArray[np.float32],
    own_inner_px: NDArray[np.float64],
    own_outer_px: NDArray[np.float64],
    own_level: NDArray[np.float32],
    y: int,
    first: int,
    end: int,
    line: NDArray[np.float32],
) -> None:
    """Fill line[: end - first] with the log brightness of pixels first to end of row y; the darkest dot counts.

    The profile of a dot is the common one, or its own if dots differ (see DotShapes; empty if not).
    """
    line[: end - first] = 0.0
    for dot in range(len(dot_xy_px)):
        if len(own_inner_px):
            inner_px, outer_px, level = own_inner_px[dot], own_outer_px[dot], own_level[dot]
        down = y - dot_xy_px[dot, 1]
        if abs(down) > outer_px:
            continue
        dot_x = dot_xy_px[dot, 0]
        half = math.sqrt(outer_px * outer_px - down * down)
        down2 = np.float32(down) * np.float32(down)
        for x in range(max(first, math.ceil(dot_x - half)), min(end, math.floor(dot_x + half) + 1)):
            across = np.float32(x - dot_x)
            position = profile_position(across * across + down2, np.float32(inner_px), np.float32(steps_per_px))
            line[x - first] = min(line[x - first], profile_level(position, level))


def texture(
    rng: np.random.Generator, shape: tuple[int, int], half_correlation_px: float, log_sd: float
) -> NDArray[np.float32]:
    """Return an object's log brightness: a periodic Gaussian field of mean 0 and standard deviation `log_sd`.

    White noise is smoothed by a Gaussian in the Fourier domain, so the autocorrelation is 2^-(r / h)^2, one half at
    r = h = `half_correlation_px`. `shape` is (rows, columns), powers of two. ValueError if h exceeds an eighth of
    the field (it would overlap itself around the period), or for a negative or non-finite deviation.
    """
    rows, columns = shape
    assert all(8 <= size <= 8192 and not size & (size - 1) for size in shape)
    longest_px = min(shape) / 8
    check_range("half_correlation_px", half_correlation_px, 0.0, longest_px, above=True)
    check_range("log_sd", log_sd)
    kernel_sigma_px = half_correlation_px / (2.0 * math.sqrt(math.log(2.0)))
    frequency2 = np.fft.fftfreq(rows)[:, None] ** 2 + np.fft.rfftfreq(columns)[None, :] ** 2
    spectrum = np.fft.rfft2(rng.standard_normal(shape))
    spectrum *= np.exp(-2.0 * math.pi**2 * kernel_sigma_px**2 * frequency2)
    spectrum[0, 0] = 0.0
    field = np.fft.irfft2(spectrum, shape)
    scaled: NDArray[np.float32] = (field * (log_sd / field.std())).astype(np.float32)
    return scaled


@njit(cache=True, _nrt=False)
def texture_place(
    texture: NDArray[np.float32],
    first_x: int,
    first_y: int,
    object_x_px: float,
    object_y_px: float,
    contrast: float,
) -> TexturePlace:
    """Return the texel (column, row) of a moved object at pixel (first_x, first_y), and the weights of four texels.

    The four texels are upper left, upper right, lower left and lower right.
    """
    texture_rows, texture_columns = texture.shape
    # Reduced to one period while still floats, so that no displacement is too large.
    source_x = (first_x - object_x_px) % texture_columns
    source_y = (first_y - object_y_px) % texture_rows
    whole_x = int(source_x)
    whole_y = int(source_y)
    part_x = source_x - whole_x
    part_y = source_y - whole_y
    return (
        whole_x,
        whole_y,
        np.float32(contrast * (1.0 - part_y) * (1.0 - part_x)),
        np.float32(contrast * (1.0 - part_y) * part_x),
        np.float32(contrast * part_y * (1.0 - part_x)),
        np.float32(contrast * part_y * part_x),
    )


@njit(cache=True, _nrt=False)
def sample_texture_run(
    texture: NDArray[np.float32], place: TexturePlace, row: int, first: int, end: int, level: NDArray[np.float32]
) -> None:
    """Fill level[: end - first] with pixels first to end of a row, counted from the pixel of `texture_place`."""
    whole_x, whole_y, upper_left, upper_right, lower_left, lower_right = place
    texture_rows, texture_columns = texture.shape
    # Unsigned indices, as in `profile_level`, and no slices, because creating them takes longer than a short run.
    upper = np.uint64((whole_y + row) & (texture_rows - 1))
    lower = np.uint64((whole_y + row + 1) & (texture_rows - 1))
    one = np.uint64(1)
    columns = end - first
    done = 0
    while done < columns:
        # Up to the seam only: an index that may wrap keeps the loop from being vectorised, too.
        left = (whole_x + first + done) & (texture_columns - 1)
        run = min(columns - done, texture_columns - 1 - left)
        if run == 0:
            level[done] = (
                upper_left * texture[upper, left]
                + upper_right * texture[upper, 0]
                + lower_left * texture[lower, left]
                + lower_right * texture[lower, 0]
            )
            done += 1
            continue
        offset = np.uint64(left - done)  # also below 0: sums of unsigned integers wrap
        for k in range(np.uint64(done), np.uint64(done + run)):
            at = k + offset
            level[k] = (
                upper_left * texture[upper, at]
                + upper_right * texture[upper, at + one]
                + lower_left * texture[lower, at]
                + lower_right * texture[lower, at + one]
            )
        done += run


def texture_slope(texture: NDArray[np.float32]) -> tuple[float, float, float]:
    """Return a texture's steepest change of level per px along x and y, and its largest magnitude, at contrast 1."""
    across, down = (float(np.abs(np.roll(texture, 1, axis) - texture).max()) for axis in (1, 0))
    return across, down, float(np.abs(texture).max())


class DotShapes(NamedTuple):
    """For each dot, the `inner_px`, `outer_px` (dots,) and `level` (dots, entries) of DotProfile.

    `visited_px` (dots, 4) is scratch of the scanning camera. All are empty if dots are alike.
    """

    inner_px: NDArray[np.float64]
    outer_px: NDArray[np.float64]
    level: NDArray[np.float32]
    visited_px: NDArray[np.float64]


def dot_shapes(profile: DotProfile, larger_px: NDArray[np.float64], contrast: NDArray[np.float64]) -> DotShapes:
    """Return dots that are larger than a profile by `larger_px` (dots,), with `contrast` (dots,) times its levels."""
    assert np.isfinite(larger_px).all() and (contrast > 0.0).all()
    return DotShapes(
        profile.inner_px + larger_px,
        profile.outer_px + larger_px,
        (contrast[:, None] * profile.level).astype(np.float32),
        np.full((len(larger_px), 4), np.nan),
    )


def alike() -> DotShapes:
    """Return the shapes for dots that are all alike: empty arrays."""
    return DotShapes(np.empty(0), np.empty(0), np.empty((0, 1), np.float32), np.empty((0, 4)))


def shaped_level(
    frame_px: tuple[int, int], dot_xy_px: NDArray[np.float64], profile: DotProfile, shapes: DotShapes
) -> NDArray[np.float32]:
    """Return the log brightness of the frame, (height, width), for dots (dots, 2); of differing dots the darkest."""
    if not len(shapes.inner_px):
        return gel_level(frame_px, dot_xy_px, profile)
    picture = np.zeros(frame_px[::-1], np.float32)
    for dot in range(len(dot_xy_px)):
        inner, outer, level = shapes.inner_px[dot], shapes.outer_px[dot], shapes.level[dot]
        draw_dots(picture, dot_xy_px[dot : dot + 1], inner, outer, profile.steps_per_px, level)
    return picture
