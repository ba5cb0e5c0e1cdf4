"""The sticking share of a contact in each slice, from tracked dots: an additional input for slip detectors.

It uses the network of touch maps without the map itself, which takes milliseconds to compute, and assumes the expected
scale of a frame (known_gel.py). `featurize` applies it to tracks, and a detector trained with it to the dots that it
tracks; both give identical bits.

The network is loaded from a file of named arrays, which contains no code.
"""

import functools
import math
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags, Floats
from evetac_cli.errors import InputError
from evetac_cli.kernels.touch import rest, sticking
from evetac_cli.kernels.touch.dot_motion import DotNoise
from evetac_cli.kernels.touch.sticking import StickingNetwork, StickingState
from evetac_cli.kernels.touch.touch_map import BEGINS, ENDS, apart_rms
from evetac_cli.kernels.touch.touch_map import LEAST_DOTS as LEAST_TOUCHED
from evetac_cli.resources import STICKING_MODEL
from evetac_cli.stages.touch.known_gel import DRIFT_PX, TRACKER_PX, expected_mm_per_px


@functools.cache
def shipped_network() -> StickingNetwork:
    """Return the pretrained network."""
    return read_network(STICKING_MODEL)


def read_network(path: Path) -> StickingNetwork:
    """Read a network from a file of named arrays (.npz); InputError if it contains none."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return StickingNetwork.of_arrays({name: arrays[name] for name in arrays.files})
    except (OSError, ValueError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        expected, found = "named arrays (.npz) as written by scripts/studies/sticking/train.py", str(error)
        raise InputError("not a sticking-share network", where=str(path), expected=expected, found=found) from None


class StickingShare:
    """The sticking share after the slices so far: `share`, NaN without contact or with too few known dots."""

    def __init__(self, rest_xy_px: NDArray[np.floating], frame_px: Sequence[int] | NDArray[np.integer]) -> None:
        """Start with the dots at rest, (dots, 2), NaN for missing ones, in a frame (width, height)."""
        self.share = math.nan
        self._middle_px, self._scale = np.array(frame_px) / 2, expected_mm_per_px(frame_px)
        self._rest_mm: Floats = (np.asarray(rest_xy_px, np.float64) - self._middle_px) * self._scale
        noise = DotNoise(TRACKER_PX * self._scale, DRIFT_PX * self._scale)
        self._own_mm = noise.own_mm
        self._touches = False
        self._slices = 0
        self._state: StickingState | None = None
        if np.count_nonzero(np.isfinite(self._rest_mm).all(axis=1)) >= sticking.LEAST_DOTS:
            self._state = sticking.start(self._rest_mm, shipped_network(), noise)

    def step(self, dot_xy_px: NDArray[np.floating], lost: NDArray[np.bool_] | NDArray[np.uint8]) -> float:
        """Process one slice, with its dots (dots, 2) and which of them are lost (dots,), and return the share."""
        if self._state is None:
            return self.share
        # float32 as in tracks files, so that live dots and dots from a file are identical
        dot_mm = (np.asarray(dot_xy_px, np.float32) - self._middle_px) * self._scale
        gone: Flags = np.asarray(lost) != 0
        self._slices += 1
        if self._slices % rest.BLOCK_MS == 0:  # the interval of the network
            self._touches = self._is_touched(dot_mm, gone)
        self.share = sticking.step(self._state, dot_mm, gone, self._touches).sticking_share
        return self.share

    def _is_touched(self, dot_mm: Floats, lost: Flags) -> bool:
        moved = dot_mm - self._rest_mm
        trusted = np.isfinite(moved[:, 0]) & np.isfinite(moved[:, 1]) & ~lost
        if np.count_nonzero(trusted) < LEAST_TOUCHED:
            return False
        return apart_rms(moved[trusted]) > (ENDS if self._touches else BEGINS) * self._own_mm
