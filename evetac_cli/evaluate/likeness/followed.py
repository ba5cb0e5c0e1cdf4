"""Distance of the published trackers from the true dots of a simulation, compared with a tracker that never moves dots.

There are three trackers: the authors' code of 2024 on slices of 1 ms, their code of 2026, and the paper's. The code of
2026 has the same arithmetic on slices of 5 ms, and requires 11 events per slice where that of 2024 requires 5. The
background filter before the tracker in both codes is left out.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.jobs import Row
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.stages import row_blocks
from evetac_cli.store.recordings.read import Recording

OFFICIAL, PAPER = presets.PRESETS["official"], presets.PRESETS["paper"]
# 10 + 3 (slice_ms - 1) entries of its table move a dot; an event makes two: 11 events in 5 ms (evetac_noros)
OFFICIAL_2026, SLICE_2026_MS = replace(OFFICIAL, min_events=10), 5
BLOCK_MS = 5000  # tracked in one piece; a multiple of both slice lengths


def followed(recording: Recording) -> Row:
    """Return errors of the three trackers over a recording with known true dots and grid; {} for other recordings."""
    dots = recording.dot_xy_px
    if dots is None or not len(recording) or recording.read("truth/dot_xy_px", 0, 1).shape[1] != dots.size // 2:
        return {}
    rest = dots.reshape(-1, 2)
    true = recording.read("truth/dot_xy_px")
    still_px = _rms(_distances(np.broadcast_to(rest, true.shape), true))
    row: Row = {"still_px_rms": still_px}
    for name, constants, length_ms in (
        ("official_2024", OFFICIAL, 1),
        ("official_2026", OFFICIAL_2026, SLICE_2026_MS),
        ("paper", PAPER, 1),
    ):
        places = np.concatenate([*_follow(recording, rest, constants, length_ms)])
        off_px = _distances(places, true[length_ms - 1 :: length_ms][: len(places)])
        row[f"{name}_px_rms"] = _rms(off_px)
        row[f"{name}_over_still"] = row[f"{name}_px_rms"] / still_px if still_px else math.nan
        row[f"{name}_p99_px"] = float(np.percentile(off_px, 99)) if off_px.size else math.nan
    return row


def _follow(
    recording: Recording, rest: Floats, constants: presets.TrackerConstants, length_ms: int
) -> Iterator[NDArray[np.float32]]:
    """Yield the tracker's dot positions after every slice of `length_ms`, in blocks."""
    state = tracker.start(rest, constants, frame_px=recording.frame_px)
    whole = len(recording) // length_ms * length_ms
    yield np.empty((0, len(rest), 2), np.float32)
    for first, stop in row_blocks(whole, BLOCK_MS):
        edges = recording.starts[first : stop + 1 : length_ms]
        if len(edges) > 1:
            x, y = (recording.read(f"events/{name}", int(edges[0]), int(edges[-1])) for name in "xy")
            yield tracker.fold(state, x, y, None, edges - edges[0]).dot_xy_px


def _distances(places: NDArray[np.float32], true: NDArray[np.float32]) -> Floats:
    """Return the distances of existing dots from their true positions, in px."""
    off_px = np.linalg.norm(places.astype(np.float64) - true, axis=2)
    finite_px: Floats = off_px[np.isfinite(off_px)]
    return finite_px


def _rms(off_px: Floats) -> float:
    return float(np.sqrt(np.mean(off_px**2))) if off_px.size else math.nan
