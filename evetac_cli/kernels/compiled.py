"""numba for all kernels, whose modules take `njit` from here: loaded with the first of them, and by nothing else.

Why so: loading numba and what is compiled takes five times as long as finding that a command has nothing to do. So a
module that such a command needs imports kernels where it calls them; constants that recipes name lie in modules without
kernels.
"""

from numba import njit
from numba.np import linalg

from evetac_cli import kernel_cache

__all__ = ["njit"]

_look_for_blas = linalg.ensure_blas


def _blas_is_there() -> None:
    """Stand in for what numba asks once, when it loads its functions of arrays.

    Why so: to see that scipy is there, it loads scipy.linalg, which takes a third of the time that kernels take to
    load. scipy always comes with evetac. A kernel that calls BLAS still loads it when it is compiled.
    """
    linalg.ensure_blas = _look_for_blas


linalg.ensure_blas = _blas_is_there
kernel_cache.first_kernel_comes()
