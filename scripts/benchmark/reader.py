"""Read evetac-bench without evetac: `python reader.py FOLDER` lists the recordings. Needs h5py and numpy."""

import csv
import sys
from pathlib import Path

import h5py
import numpy as np


def recordings(folder):
    """Yield the row of recordings.csv and the arrays of each recording: events/t, ms_to_idx, sensor/dot_xy_px..."""
    for row in csv.DictReader((Path(folder) / "recordings.csv").open()):
        with h5py.File(Path(folder) / "inputs" / f"{row['recording']}.recording.h5") as file:
            names = [f"{group}/{name}" for group in ("events", "sensor", "gripper") for name in file.get(group, ())]
            yield row, {name: file[name][()] for name in (*names, "ms_to_idx")}


if __name__ == "__main__":
    for row, arrays in recordings(sys.argv[1]):  # ms_to_idx: the first event of each ms
        print(*row.values(), len(arrays["events/t"]), "events, most in a ms:", np.diff(arrays["ms_to_idx"]).max())
