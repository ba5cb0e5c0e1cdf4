"""Write the dot grid of a recording: as JSON, which `--calibration` accepts, or as the official software's pickle.

The pickle is a tuple of two arrays: centres (n, 2) as (x, y), and sizes (n, 1), which are diameters. With numpy 2, it
would have module names that the official software's numpy 1.24 does not have. The older names are written instead,
which all versions accept.
"""

import pickle
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.jobs import Progress
from evetac_cli.kernels.calibration import grid
from evetac_cli.store.calibration import stored_calibration, write_calibration
from evetac_cli.store.layout.provenance import time_host_versions
from evetac_cli.store.recordings.read import Recording

PROTOCOL = 3  # the newest protocol that stores module names as lines of text


def write(recording: Recording, path: Path, progress: Progress) -> None:
    """Write the grid that is stored in the recording; raise InputError if there is none."""
    if recording.dot_xy_px is None:
        raise InputError("the recording has no dot grid", where=str(recording.path), hint="evetac calibrate finds one")
    calibration = stored_calibration(recording)
    dot_xy_px = calibration.dot_xy_px.reshape(-1, 2)
    if path.suffix.lower() == ".pkl":
        path.write_bytes(official(dot_xy_px, calibration.dot_radius_px))
        return
    neighbours = [[int(other) for other in row if other >= 0] for row in grid.neighbours(dot_xy_px)]
    header = recording.header
    write_calibration(
        path,
        calibration,
        neighbours,
        {},
        {"recording": header["id"], "simulated": header["simulated"], "made": time_host_versions()},
        str(recording.path),
    )


def official(dot_xy_px: NDArray[np.float64], radius_px: float) -> bytes:
    """Return the pickle of dots (n, 2); missing dots are left out, because the format cannot represent them."""
    present = dot_xy_px[np.isfinite(dot_xy_px).all(axis=1)].astype(np.float64)
    content = pickle.dumps((present, np.full((len(present), 1), 2.0 * radius_px)), protocol=PROTOCOL)
    return content.replace(b"cnumpy._core.", b"cnumpy.core.")
