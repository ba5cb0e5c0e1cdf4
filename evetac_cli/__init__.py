"""evetac: event-based touch, from a recording to a grasp."""

import os
import tempfile
from pathlib import Path

__version__ = "0.1.0"

# numba keeps compiled kernels beside their source, else below the home folder, and fails where it can write to neither.
if "NUMBA_CACHE_DIR" not in os.environ and not os.access(Path(__file__).parent, os.W_OK):
    os.environ["NUMBA_CACHE_DIR"] = str(Path(tempfile.gettempdir()) / f"evetac-numba-{os.getuid()}")
