"""The network of the sticking share from its file: named arrays, no code (kernels/touch/sticking.py)."""

import functools
import zipfile
from pathlib import Path

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.kernels.touch.sticking import StickingNetwork
from evetac_cli.resources import STICKING_MODEL


@functools.cache
def shipped() -> StickingNetwork:
    """The package's network."""
    return read(STICKING_MODEL)


def read(path: Path) -> StickingNetwork:
    """A network from a file of named arrays (.npz); InputError where it holds none."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as held:
            return StickingNetwork.of_arrays({name: held[name] for name in held.files})
    except (OSError, ValueError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        expected, found = "named arrays (.npz) as scripts/train_sticking.py writes them", str(error)
        raise InputError("no network of a sticking share", where=str(path), expected=expected, found=found) from None
