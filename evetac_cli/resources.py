"""Where the package's own data lies: schemas, scenes, tables, a slip detector, a force model."""

import functools
import os
import tempfile
import tomllib
from pathlib import Path
from typing import Any

from evetac_cli.errors import EvetacError

PACKAGE = Path(__file__).resolve().parent
DATA = PACKAGE / "data"
SCENES = DATA / "scenes"
SHIPPED = "shipped"  # names the package's model where a flag asks for one
MODEL = DATA / "models" / "slip-10ms.model.h5"  # the slip detector of `grasp`; its report lies beside it
FORCE_MODEL = DATA / "models" / "gel.force-model.h5"  # of `predict-force`, likewise


def schemas() -> Path:
    """The folder of schemas: inside an installed package, else one folder up (an editable install)."""
    for candidate in (PACKAGE / "schemas", PACKAGE.parent / "schemas"):
        if candidate.is_dir():
            return candidate
    raise EvetacError("the folder schemas/ is missing from this installation", hint="install evetac again")


@functools.cache
def table(name: str) -> dict[str, Any]:
    """A TOML table of the package: objects, sensors, paper."""
    return tomllib.loads((DATA / f"{name}.toml").read_text())


def kernel_cache() -> Path | None:
    """A folder for compiled kernels where numba cannot keep them beside their source; None where it can.

    Without such a folder numba takes one below the home folder, and fails where it can write to neither.
    """
    if os.access(PACKAGE, os.W_OK):
        return None
    return Path(tempfile.gettempdir()) / f"evetac-numba-{os.getuid()}"


def find_kernel_cache() -> None:
    """Tell numba where to keep compiled kernels, unless NUMBA_CACHE_DIR or its settings say so already."""
    folder = kernel_cache()
    if folder is not None:
        import numba

        numba.config.CACHE_DIR = numba.config.CACHE_DIR or str(folder)
