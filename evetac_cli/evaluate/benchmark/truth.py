"""The truth of a benchmark's recordings, which only the scorer reads."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags, Floats
from evetac_cli.errors import InputError
from evetac_cli.evaluate import alarm_rules
from evetac_cli.evaluate.benchmark.data_set import MADE_BY, Benchmark
from evetac_cli.formats.read.read_columns import read_columns
from evetac_cli.store.hdf5.checked_hdf5 import CheckedHdf5

COLUMNS = ("recording", "true_sensor", "true_object", "motion", "seed")
DATASETS = (
    *("slip", "visible_slip_share", "normal_force_n", "onset_ms"),
    *("dots_ms", "dot_xy_px", "force_ms", "shear_force_n"),
)


class Truth(NamedTuple):
    """The truth of a recording: in each ms, and at the instants that are judged.

    slips: gross slip in contact (slices,); share: slipping share of the visible contact; held: contact; onset_ms: first
    gross slip after the grip began to open, None without; dot_xy_px: (instants, dots, 2); shear_n: (instants, 2).
    """

    sensor: str
    touched: str
    slips: Flags
    share: NDArray[np.float32]
    held: Flags
    onset_ms: int | None
    dots_ms: NDArray[np.int64]
    dot_xy_px: Floats
    force_ms: NDArray[np.int64]
    shear_n: Floats

    @property
    def slices(self) -> int:
        """Length of the recording in ms."""
        return len(self.slips)

    @property
    def slip_begins(self) -> list[int]:
        """The slices at which gross slip begins."""
        return alarm_rules.slip_begins(self.slips)


def read(benchmark: Benchmark) -> dict[str, Truth]:
    """Return the truth of every recording by its name; InputError if a file is missing or damaged."""
    path = benchmark.folder / "truth" / "recordings.csv"
    if not path.exists():
        raise InputError("the truth is missing", where=str(path), hint=f"scores need the folder truth/: {MADE_BY}")
    columns = read_columns(path, COLUMNS)
    of_name = dict(
        zip(columns["recording"], zip(columns["true_sensor"], columns["true_object"], strict=True), strict=True)
    )
    found = {}
    for name in benchmark.entries:
        if name not in of_name:
            raise InputError("the truth of a recording is missing", where=str(path), expected=name, hint=MADE_BY)
        found[name] = _of_file(benchmark.folder / "truth" / f"{name}.h5", *of_name[name])
    return found


def _of_file(path: Path, sensor: str, touched: str) -> Truth:
    with CheckedHdf5(path, "the truth of a recording", MADE_BY) as file:
        datasets = file.datasets()
        missing = [name for name in DATASETS if name not in datasets]
        if missing:
            raise InputError("not the truth of a recording", where=str(path), expected=missing[0], hint=MADE_BY)
        values: dict[str, Any] = {name: datasets[name][()] for name in DATASETS}
    held = np.asarray(values["normal_force_n"]) > 0.0
    onset = int(values["onset_ms"])
    return Truth(
        sensor,
        touched,
        (np.asarray(values["slip"]) > 0) & held,
        np.asarray(values["visible_slip_share"], np.float32),
        held,
        None if onset < 0 else onset,
        np.asarray(values["dots_ms"], np.int64),
        np.asarray(values["dot_xy_px"], np.float64),
        np.asarray(values["force_ms"], np.int64),
        np.asarray(values["shear_force_n"], np.float64),
    )
