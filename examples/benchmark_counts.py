"""Predictions for evetac-bench made without evetac: slip by counts of events. A baseline, and a start for your own.

    python examples/benchmark_counts.py bench-small --out mine
    evetac evaluate benchmark bench-small --predictions mine

- warning: the number of events outside the window in the last 5 ms, divided by its median so far;
- onset: the first ms in which this ratio reaches 5, after the motor current began to fall;
- dots: stay at rest; force: none.

Needs h5py and numpy. Only inputs/, queries/ and recordings.csv of the benchmark are read.
"""

import argparse
import csv
from pathlib import Path

import h5py
import numpy as np

SUM_MS, RATIO, FIRST_MS = 5, 5.0, 300


def read_table(path):
    """Return the rows of a CSV table as dictionaries."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def counts_of(recording):
    """Return the events outside the window in the last SUM_MS of each ms, divided by their median so far."""
    x, y, starts = (recording[name][:] for name in ("events/x", "events/y", "ms_to_idx"))
    inside = np.ones(len(x), bool)
    if "sensor/window_px" in recording:
        x0, y0, x1, y1 = recording["sensor/window_px"][:]
        inside = ~((x >= x0) & (x < x1) & (y >= y0) & (y < y1))
    so_far = np.concatenate([[0], np.cumsum(inside)])
    counts = np.convolve(np.diff(so_far[starts]), np.ones(SUM_MS))[: len(starts) - 1]
    usual = np.array([np.median(counts[: end + 1 : 10]) for end in range(0, len(counts), 50)])
    return counts / np.maximum(np.repeat(usual, 50)[: len(counts)], 1.0)


def falls_ms(recording):
    """Return the ms in which the motor current first changes, as in the paper's forced slip; 0 if it does not."""
    target = recording["gripper/current_target_ma"][:]
    changed = np.flatnonzero(np.isfinite(target[:-1]) & (target[1:] != target[:-1]))
    return int(recording["gripper/t_us"][changed[0] + 1] // 1000) if len(changed) else 0


def write_table(path, names, rows):
    """Write a table as CSV."""
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([names, *rows])


def main():
    """Write the four tables of predictions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("benchmark", type=Path, help="folder of the benchmark")
    parser.add_argument("--out", type=Path, required=True, help="folder of the predictions")
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    onsets, scores, rest = [], [], {}
    for row in read_table(chosen.benchmark / "recordings.csv"):
        name = row["recording"]
        with h5py.File(chosen.benchmark / "inputs" / f"{name}.recording.h5") as recording:
            rest[name] = recording["sensor/dot_xy_px"][:].reshape(-1, 2)
            if row["kind"] == "press":
                continue
            ratio = counts_of(recording)
            scores += [(name, ms, f"{ratio[ms]:.4g}") for ms in range(FIRST_MS, len(ratio))]
            if row["kind"] == "slip":
                first = max(FIRST_MS, falls_ms(recording))
                above = np.flatnonzero(ratio[first:] >= RATIO)
                onsets.append((name, first + above[0] if len(above) else ""))
    forces = [(row["recording"], row["ms"], 0, 0) for row in read_table(chosen.benchmark / "queries" / "force.csv")]
    dots = [
        (row["recording"], row["ms"], dot, x, y)
        for row in read_table(chosen.benchmark / "queries" / "dots.csv")
        for dot, (x, y) in enumerate(rest[row["recording"]])
    ]
    write_table(chosen.out / "onset.csv", ("recording", "onset_ms"), onsets)
    write_table(chosen.out / "warning.csv", ("recording", "ms", "score"), scores)
    write_table(chosen.out / "force.csv", ("recording", "ms", "fx_n", "fy_n"), forces)
    write_table(chosen.out / "dots.csv", ("recording", "ms", "dot", "x_px", "y_px"), dots)


if __name__ == "__main__":
    main()
