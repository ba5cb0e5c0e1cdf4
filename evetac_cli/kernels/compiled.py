"""numba for all kernels: their modules import `njit` from here, and nothing else loads numba.

Reason: loading numba and compiled code takes five times as long as finding that a command has nothing to do. A module
that such a command needs therefore imports kernels only where it calls them, and constants that are part of recipes are
in modules without kernels.
"""

from numba import config, njit
from numba.np import linalg

from evetac_cli.kernels import kernel_cache

__all__ = ["njit"]

_look_for_blas = linalg.ensure_blas


def _blas_is_there() -> None:
    """Replace a check that numba makes once, when it loads its array functions.

    The check loads scipy.linalg to see whether scipy exists, which takes a third of the loading time of the kernels.
    scipy is always installed with evetac. A kernel that calls BLAS still loads it when it is compiled.
    """
    linalg.ensure_blas = _look_for_blas


linalg.ensure_blas = _blas_is_there
config.CACHE_DIR = str(kernel_cache.folder())
kernel_cache.first_kernel_comes()
