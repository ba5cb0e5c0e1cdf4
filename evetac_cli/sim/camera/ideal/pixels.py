"""The arrays of the ideal camera, in the groups in which its compiled loops take them.

Groups end at the functions that Python calls; what these call takes the arrays one by one (why so: see scanning/dots).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.sim.camera.optics import DotProfile


class IdealGelPixels(NamedTuple):
    """The gel: where its dots were last (dots, 2), how a dot looks, and its pixels, (height, width) each.

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
    is the texture's level there.
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
    """A slice: its number, when it starts, and how long a pixel is blind after an event."""

    number: int
    t0_us: int
    refractory_us: float
