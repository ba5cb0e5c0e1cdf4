"""Number of events per slice in the first columns of a recording: those of the gel, if a window is beside it."""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.slip.architectures import GEL_PX
from evetac_cli.store.recordings.read import BLOCK_SLICES, Recording


def gel_counts(
    recording: Recording, start: int = 0, stop: int | None = None, columns: int = GEL_PX[0]
) -> NDArray[np.int64]:
    """Return the number of events with x < columns in each of the slices [start, stop), (slices,).

    x is read in blocks of a second, and not at all if the frame has no more columns.
    """
    stop = len(recording) if stop is None else stop
    counts = np.diff(recording.starts[start : stop + 1])
    if recording.frame_px[0] <= columns:
        return counts
    for first in range(start, stop, BLOCK_SLICES):
        starts = recording.starts[first : min(first + BLOCK_SLICES, stop) + 1]
        x = recording.read("events/x", int(starts[0]), int(starts[-1]))
        beyond = np.searchsorted(
            np.flatnonzero(x >= columns), starts - starts[0]
        )  # events of the block before each slice
        counts[first - start : first - start + len(starts) - 1] -= np.diff(beyond)
    return counts
