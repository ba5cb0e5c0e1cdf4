"""Force-sensor readings of a recording, from a table next to its tracks, or from a simulation's truth with noise.

The table is `NAME.force.csv` next to `NAME.tracks.h5`, with a first line `t_s,shear_x_n,shear_y_n,normal_n`, then a
line for each reading. The time t_s begins at the start of the recording. A force that was not measured is left empty.
Shear is the force of the object on the gel, x to the right and y down in the image, as `truth/shear_force_n` of
simulated recordings.
"""

import csv
import hashlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.errors import InputError
from evetac_cli.events import SLICES_PER_S
from evetac_cli.stages.related_files import recording_with_truth
from evetac_cli.store.files import StageFile, stem
from evetac_cli.text_files import read_text

COLUMNS = ["t_s", "shear_x_n", "shear_y_n", "normal_n"]
EVERY = 40  # slices between two used readings
MOST_BYTES = 1 << 26
LARGEST_N = 1e4


class Readings(NamedTuple):
    """Forces in N at some slices, NaN if not measured."""

    slice_: NDArray[np.int64]  # (n,)
    shear_n: Floats  # (n, 2)
    normal_n: Floats  # (n,)


def table_beside(tracks: Path) -> Path:
    """Return the path of a tracks file's table of readings, which may not exist."""
    return tracks.with_name(f"{stem(tracks)}.force.csv")


def digest(tracks: Path) -> str:
    """Return the identity of a tracks file's readings for a recipe: the hash of their table, or `truth`."""
    table = table_beside(tracks)
    return hashlib.sha256(read_text(table, MOST_BYTES).encode()).hexdigest() if table.exists() else "truth"


def read(tracks: StageFile, noise_n: float, rng: np.random.Generator) -> Readings:
    """Return the readings of a tracks file, at most one per 40 ms; InputError if there is neither a table nor truth."""
    table = table_beside(tracks.path)
    if table.exists():
        return _from_table(table, tracks.length("dot_xy_px"))
    try:
        with recording_with_truth(tracks) as recording:
            shear_n = recording.read("truth/shear_force_n")[::EVERY].astype(float)
            normal_n = recording.read("truth/normal_force_n")[::EVERY].astype(float)
    except InputError as error:
        expected = f"a table {table.name} with {', '.join(COLUMNS)}, or a simulated recording"
        raise InputError(f"no known forces: {error.message}", where=str(tracks.path), expected=expected) from None
    slices = EVERY * np.arange(len(shear_n))
    return Readings(
        slices,
        shear_n + rng.normal(0.0, noise_n, shear_n.shape),
        normal_n + rng.normal(0.0, noise_n, normal_n.shape),
    )


def _from_table(path: Path, slices: int) -> Readings:
    """Return the first reading of each 40 ms; lines without a force are left out. InputError for any other text.

    slices: length of the recording, within which all readings must be.
    """
    text = read_text(path, MOST_BYTES).removeprefix("\ufeff")  # written by Excel
    if "\0" in text:
        raise InputError("not a table of forces: it contains bytes of value 0", where=str(path))
    try:
        lines = list(csv.reader(text.splitlines()))
    except csv.Error as error:
        raise InputError(f"not a table of forces: {error}", where=str(path), expected=",".join(COLUMNS)) from None
    first = [name.strip() for name in lines[0]] if lines else []
    if first != COLUMNS:
        found = ",".join(first)[:80]
        raise InputError("not a table of forces", where=f"{path}, line 1", expected=",".join(COLUMNS), found=found)
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        if not line:
            continue
        try:
            row = [float(entry) if entry.strip() else np.nan for entry in line]
        except ValueError:
            row = []
        if len(row) != len(COLUMNS) or np.isinf(row).any() or np.isnan(row[0]) or np.nanmax(np.abs(row)) > LARGEST_N:
            expected = f"four finite numbers of at most {LARGEST_N:g}, with forces left empty if not measured"
            written = ",".join(line)[:80]
            raise InputError("not a reading", where=f"{path}, line {number}", expected=expected, found=written)
        if not 0 <= row[0] * SLICES_PER_S < slices:
            written = f"{row[0]:g} s"
            expected = f"a time within the recording, 0 to {slices / SLICES_PER_S:g} s"
            where = f"{path}, line {number}"
            raise InputError("a reading outside the recording", where=where, expected=expected, found=written)
        rows.append(row)
    values = np.array(rows).reshape(-1, len(COLUMNS))
    values = values[np.isfinite(values[:, 1:]).any(axis=1)]
    if not len(values):
        raise InputError("the table of forces has no reading", where=str(path))
    slice_ = np.floor(values[:, 0] * SLICES_PER_S + 1e-6).astype(np.int64)  # 1.001 s is slice 1001
    _, kept = np.unique(slice_ // EVERY, return_index=True)
    return Readings(slice_[kept], values[kept, 1:3], values[kept, 3])
