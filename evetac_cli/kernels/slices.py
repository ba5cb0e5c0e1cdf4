"""Whether the columns of a slice of events are valid, in one pass."""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.compiled import njit


@njit(cache=True)
def is_slice(
    t: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    start_us: int,
    width: int,
    height: int,
) -> bool:
    """Whether all events are in [start_us, start_us + 1000), in order of time, in the frame, with p 0 or 1."""
    count = t.shape[0]
    if x.shape[0] != count or y.shape[0] != count or p.shape[0] != count:
        return False
    fine, last = True, start_us
    for i in range(count):  # without branches, so that it is vectorised
        fine &= (t[i] >= last) & (x[i] < width) & (y[i] < height) & (p[i] <= 1)
        last = t[i]
    return fine & (last < start_us + 1000)
