"""Read the motion of dots that another simulator computed: positions over time, and forces and slip if it has them.

npz        arrays of these names
parquet    a row for each time and dot, sorted by time: columns t_s, x_px and y_px or x_mm and y_mm, and columns of
           one value for each time; extra `convert` (pyarrow)

t_s               (n,) rising
dot_xy_px         (n, dots, 2) or (n, rows, columns, 2), x right and y down, where the camera sees them; or
                  dot_xy_mm, on the gel from the middle of the view. The first positions are those at rest
normal_force_n    (n,), shear_force_n (n, 2): optional, of the object on the gel
slip              (n,), 1 while the object slides as one body; slip_share (n,), 0 to 1: optional
"""

import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.errors import InputError, needs_extra
from evetac_cli.formats.read.damage import read_in_words, refuse_too_much

TIME, UNITS = "t_s", ("px", "mm")
TRUTH = {"normal_force_n": (), "shear_force_n": (2,), "slip": (), "slip_share": ()}  # shapes at one time
NAMES = (TIME, *(f"dot_xy_{unit}" for unit in UNITS), *TRUTH)
SUFFIXES = (".npz", ".parquet")


class DotMotion(NamedTuple):
    """Times (n,) and positions (n, dots, 2) or (n, rows, columns, 2) of dots, their unit, and the truth by name."""

    t_s: Floats
    dot_xy: Floats
    unit: str
    truth: dict[str, Floats]


def read_motion(path: Path) -> DotMotion:
    """Return the motion in a file; InputError if arrays are missing, or do not fit each other."""
    where = str(path)
    if path.suffix not in SUFFIXES:
        raise InputError("not a file of moving dots", where=where, expected=", ".join(SUFFIXES), found=path.suffix)
    with read_in_words(where, f"the file cannot be read as {path.suffix[1:]}"):
        arrays = {".npz": _npz, ".parquet": _parquet}[path.suffix](path)
    units = [unit for unit in UNITS if f"dot_xy_{unit}" in arrays]
    if TIME not in arrays or len(units) != 1:
        found = ", ".join(arrays) or "none of these"
        raise InputError("arrays are missing", where=where, expected="t_s, and dot_xy_px or dot_xy_mm", found=found)
    t_s, dot_xy = arrays.pop(TIME), arrays.pop(f"dot_xy_{units[0]}")
    if t_s.ndim != 1 or dot_xy.ndim not in (3, 4) or dot_xy.shape[-1] != 2 or not 2 <= len(t_s) == len(dot_xy):
        expected = "t_s (n,), dot_xy (n, dots, 2) or (n, rows, columns, 2), at least two times"
        raise InputError("arrays do not fit each other", where=where, expected=expected, found=_shapes(t_s, dot_xy))
    for name, values in arrays.items():
        if values.shape != (len(t_s), *TRUTH[name]) or not np.isfinite(values).all():
            expected = f"finite numbers {(len(t_s), *TRUTH[name])}"
            raise InputError(f"{name} does not fit", where=where, expected=expected, found=_shapes(values))
    return DotMotion(t_s, dot_xy, units[0], arrays)


def _shapes(*arrays: NDArray[Any]) -> str:
    return " and ".join(str(array.shape) for array in arrays)


def _npz(path: Path) -> dict[str, Floats]:
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(entry.file_size for entry in archive.infolist())
    refuse_too_much(unpacked, path.stat().st_size, str(path))
    with np.load(path, allow_pickle=False) as arrays:
        return {name: np.asarray(arrays[name], np.float64) for name in NAMES if name in arrays.files}


def _parquet(path: Path) -> dict[str, Floats]:
    """Return a table of a row per time and dot as arrays."""
    with needs_extra("parquet files need pyarrow", "convert", str(path)):
        from pyarrow import parquet
    table = parquet.read_table(path)
    columns = {name: np.asarray(table[name], np.float64) for name in table.column_names if name != "dot"}
    rows = columns[TIME]
    t_s = rows[np.append(True, np.diff(rows) != 0.0)]
    shape = (len(t_s), len(rows) // max(len(t_s), 1))
    found: dict[str, Floats] = {TIME: t_s}
    for unit in UNITS:
        if f"x_{unit}" in columns and f"y_{unit}" in columns:
            both = [columns[f"{axis}_{unit}"].reshape(shape) for axis in "xy"]
            found[f"dot_xy_{unit}"] = np.stack(both, axis=-1)
    found |= {name: columns[name].reshape(shape)[:, 0] for name in TRUTH if name in columns}
    shear = [columns.get(f"shear_force_{axis}_n") for axis in "xy"]
    if shear[0] is not None and shear[1] is not None:
        found["shear_force_n"] = np.stack([one.reshape(shape)[:, 0] for one in shear if one is not None], axis=-1)
    return found
