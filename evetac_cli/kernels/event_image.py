"""Draw events as an image, for people and for video. Free of compiled code, so that pages and exports load no numba."""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX


def event_image(
    x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8], frame_px: tuple[int, int] = FRAME_PX
) -> NDArray[np.int8]:
    """Draw events, in order of time, as (height, width): +1 brighter, -1 darker, 0 none; a pixel's last event wins.

    frame_px is (width, height); events outside it are left out.
    Source: paper, "Evetac Touch Features", the set of events in image form.
    """
    assert x.ndim == 1 and x.shape == y.shape == p.shape
    width, height = frame_px
    image = np.zeros((height, width), np.int8)
    inside = (x < width) & (y < height)
    image[y[inside], x[inside]] = np.where(p[inside], np.int8(1), np.int8(-1))  # the last of several events stays
    return image
