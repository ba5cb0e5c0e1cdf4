"""Loads the network of the sticking share from its file of named arrays, which contains no code.

The network itself is in kernels/touch/sticking.py.
"""

import functools
import zipfile
from pathlib import Path

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.kernels.touch.sticking import StickingNetwork
from evetac_cli.resources import STICKING_MODEL


@functools.cache
def shipped() -> StickingNetwork:
    """Return the pretrained network."""
    return read(STICKING_MODEL)


def read(path: Path) -> StickingNetwork:
    """Read a network from a file of named arrays (.npz); InputError if it contains none."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return StickingNetwork.of_arrays({name: arrays[name] for name in arrays.files})
    except (OSError, ValueError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        expected, found = "named arrays (.npz) as written by scripts/train_sticking.py", str(error)
        raise InputError("not a sticking-share network", where=str(path), expected=expected, found=found) from None
