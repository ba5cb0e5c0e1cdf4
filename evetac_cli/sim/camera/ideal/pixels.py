"""The arrays of the ideal camera, grouped as its compiled loops take them.

Groups are used only in the functions that Python calls; the functions below take single arrays (see scanning/dots).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.sim.camera.optics import DotProfile


class IdealGelPixels(NamedTuple):
    """The gel: the last positions of its dots (dots, 2), a dot's profile, and its pixels, (height, width) each.

    See `IdealState` for `level_index` to `release_us`.
    """

    seen_dot_xy_px: NDArray[np.float64]
    profile: DotProfile
    level_index: NDArray[np.int16]
    reference: NDArray[np.float32]
    threshold: NDArray[np.float32]
    lower2_px2: NDArray[np.float32]
    upper2_px2: NDArray[np.float32]
    solved_in: NDArray[np.int64]
    release_us: NDArray[np.float64]


class IdealWindowPixels(NamedTuple):
    """The window: its first pixel in the frame, the texture that slides by, and its pixels, (rows, columns) each.

    `seen_object` is the object's last x, y in px and the texture's last contrast, NaN before the first slice; `level`
    is the texture's level at that position.
    """

    first_x: int
    first_y: int
    seen_object: NDArray[np.float64]
    texture: NDArray[np.float32]
    level: NDArray[np.float32]
    reference: NDArray[np.float32]
    threshold: NDArray[np.float32]
    release_us: NDArray[np.float64]


class SliceTimes(NamedTuple):
    """A slice: its number, its start, and the refractory period of a pixel."""

    number: int
    t0_us: int
    refractory_us: float
