"""What the camera sees behind the gel, in log brightness: dark dots with soft rims, and an object's texture in the window.

Levels are natural logarithms of brightness against bare gel, which is 0. Both pictures are tables made once and looked
up for every pixel and scan: a rim profile over the signed distance, and a periodic texture that moves with the object.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

LOG_CONTRAST = 1.61  # ln(gel / dot), brightness ratio 5
EDGE_SIGMA_PX = 1.2
# Where the rim ends: there the error function is within 2e-4 log units (a thousandth of a threshold) of its limit.
# A logarithm has the longer tail on the dark side.
INNER_SIGMAS = 4.0
OUTER_SIGMAS = 3.5
PROFILE_STEPS = 1024


class DotProfile(NamedTuple):
    """Log brightness over the signed distance from a dot's rim (negative inside), in equal steps of distance.

    Before the first entry it is exactly that of the dot, after the last exactly 0. This makes a dot's ring finite:
    a pixel outside it cannot change, so leaving it out loses nothing.
    """

    first_px: float
    steps_per_px: float
    level: NDArray[np.float64]

    @property
    def last_px(self) -> float:
        """Signed distance from which on the gel is bare."""
        return self.first_px + PROFILE_STEPS / self.steps_per_px


def dot_profile(sigma_px: float = EDGE_SIGMA_PX, log_contrast: float = LOG_CONTRAST) -> DotProfile:
    """Table of L(d) = ln(I_dot + (I_gel - I_dot) Phi(d / sigma)), a dark disc on bright gel with an erf edge.

    `sigma_px` is the blur of the rim, `log_contrast` ln(I_gel / I_dot). ValueError unless both are finite and positive.
    """
    for name, value, limit in (("sigma_px", sigma_px, 100.0), ("log_contrast", log_contrast, 20.0)):
        if not 0.0 < value <= limit:
            raise ValueError(f"{name}: expected a number in (0, {limit:g}], found {value}")
    first_px = -INNER_SIGMAS * sigma_px
    steps_per_px = PROFILE_STEPS / ((INNER_SIGMAS + OUTER_SIGMAS) * sigma_px)
    distance_px = first_px + np.arange(PROFILE_STEPS + 1) / steps_per_px
    dot = math.exp(-log_contrast)
    bright = np.array([0.5 * (1.0 + math.erf(d / sigma_px / math.sqrt(2.0))) for d in distance_px])
    level = np.log(dot + (1.0 - dot) * bright)
    level[0] = -log_contrast
    level[-1] = 0.0
    return DotProfile(first_px, steps_per_px, level)


@njit(cache=True)
def rim_level(distance_px: float, first_px: float, steps_per_px: float, level: NDArray[np.float64]) -> float:
    """Log brightness at a signed distance from the rim: linear between the entries of a `DotProfile`."""
    position = (distance_px - first_px) * steps_per_px
    if position <= 0.0:
        return level[0]  # type: ignore[no-any-return]
    if position >= len(level) - 1:
        return level[-1]  # type: ignore[no-any-return]
    index = int(position)
    below = level[index]
    return below + (position - index) * (level[index + 1] - below)  # type: ignore[no-any-return]


def gel_level(
    frame_px: tuple[int, int], dot_xy_px: NDArray[np.float64], dot_radius_px: float, profile: DotProfile
) -> NDArray[np.float64]:
    """Log brightness of the whole frame, shape (height, width), for dots (dots, 2); where dots overlap, the nearest counts."""
    width, height = frame_px
    level = np.zeros((height, width))
    _draw_dots(level, dot_xy_px, dot_radius_px, profile.last_px, profile.first_px, profile.steps_per_px, profile.level)
    return level


@njit(cache=True)
def _draw_dots(
    level: NDArray[np.float64],
    dot_xy_px: NDArray[np.float64],
    dot_radius_px: float,
    last_px: float,
    first_px: float,
    steps_per_px: float,
    profile: NDArray[np.float64],
) -> None:
    height, width = level.shape
    reach = dot_radius_px + last_px
    for dot in range(len(dot_xy_px)):
        dot_x = dot_xy_px[dot, 0]
        dot_y = dot_xy_px[dot, 1]
        # Clip as floats: the integer of a far coordinate is undefined.
        first_row = int(max(0.0, math.ceil(dot_y - reach)))
        end_row = int(min(float(height), math.floor(dot_y + reach) + 1.0))
        first_column = int(max(0.0, math.ceil(dot_x - reach)))
        end_column = int(min(float(width), math.floor(dot_x + reach) + 1.0))
        for y in range(first_row, end_row):
            for x in range(first_column, end_column):
                distance = math.sqrt((x - dot_x) ** 2 + (y - dot_y) ** 2) - dot_radius_px
                level[y, x] = min(level[y, x], rim_level(distance, first_px, steps_per_px, profile))


def texture(
    rng: np.random.Generator, shape: tuple[int, int], half_correlation_px: float, log_sd: float
) -> NDArray[np.float32]:
    """Draw an object's log brightness: a periodic Gaussian field of mean 0 and standard deviation `log_sd`.

    White noise is smoothed by a Gaussian in the Fourier domain, so the autocorrelation is exp(-ln 2 (r / h)^2), which
    falls to one half at `half_correlation_px`. `shape` is (rows, columns), powers of two. ValueError if they are not,
    if the correlation exceeds an eighth of the field (it would meet itself round the period), or if values are not finite.
    """
    rows, columns = shape
    if any(size < 8 or size > 8192 or size & (size - 1) for size in shape):
        raise ValueError(f"shape: expected powers of two from 8 to 8192, found {shape}")
    if not 0.0 < half_correlation_px <= min(shape) / 8:
        raise ValueError(f"half_correlation_px: expected a number in (0, {min(shape) / 8:g}], found {half_correlation_px}")
    if not 0.0 <= log_sd < math.inf:
        raise ValueError(f"log_sd: expected a finite number >= 0, found {log_sd}")
    kernel_sigma_px = half_correlation_px / (2.0 * math.sqrt(math.log(2.0)))
    frequency2 = np.fft.fftfreq(rows)[:, None] ** 2 + np.fft.rfftfreq(columns)[None, :] ** 2
    spectrum = np.fft.rfft2(rng.standard_normal(shape))
    spectrum *= np.exp(-2.0 * math.pi**2 * kernel_sigma_px**2 * frequency2)
    spectrum[0, 0] = 0.0
    field = np.fft.irfft2(spectrum, shape)
    return (field * (log_sd / field.std())).astype(np.float32)


@njit(cache=True)
def sample_texture(
    texture: NDArray[np.float32],
    first_x: int,
    first_y: int,
    object_x_px: float,
    object_y_px: float,
    contrast: float,
    level: NDArray[np.float32],
) -> None:
    """Fill `level` (rows, columns), whose corner is pixel (first_x, first_y), with the texture moved by (object_x, object_y).

    level = contrast * texture(x - object_x, y - object_y), bilinear and periodic. All pixels of one scan share the same
    fraction of a pixel, hence the same four weights.
    """
    texture_rows, texture_columns = texture.shape
    rows, columns = level.shape
    # Into one period while still floats, so that no displacement is too far.
    source_x = (first_x - object_x_px) % texture_columns
    source_y = (first_y - object_y_px) % texture_rows
    whole_x = int(source_x)
    whole_y = int(source_y)
    part_x = source_x - whole_x
    part_y = source_y - whole_y
    weight_00 = np.float32(contrast * (1.0 - part_y) * (1.0 - part_x))
    weight_01 = np.float32(contrast * (1.0 - part_y) * part_x)
    weight_10 = np.float32(contrast * part_y * (1.0 - part_x))
    weight_11 = np.float32(contrast * part_y * part_x)
    for row in range(rows):
        upper = texture[(whole_y + row) & (texture_rows - 1)]
        lower = texture[(whole_y + row + 1) & (texture_rows - 1)]
        for column in range(columns):
            left = (whole_x + column) & (texture_columns - 1)
            right = (left + 1) & (texture_columns - 1)
            level[row, column] = (
                weight_00 * upper[left] + weight_01 * upper[right] + weight_10 * lower[left] + weight_11 * lower[right]
            )
