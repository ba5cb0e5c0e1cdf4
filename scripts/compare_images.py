"""Compare event images made by evetac, tonic and dv-processing: are they equal, and how long do they take?

    pip install tonic dv-processing
    python scripts/compare_images.py FILE ... [--seconds 1] [--rounds 9] [--out docs/results]

FILE is a recording, or an event file of another program. The table has a row for each file, each representation of
evetac, and each library (peer) that defines the same representation. A row states how many images of the first
`--seconds` were compared, how many values differ, the largest difference, and the median time of each, in alternating
runs. Times are counted from the first event, as in tonic. Counts must be equal. Voxels and surfaces, which tonic
computes in double precision, must agree to 1e-6 of the largest value. Exit code 1 if they do not.

Some peers define a representation differently. tonic's voxel grid spans the time from its first event to its last, so
two extra events mark the window, and are removed afterwards.

dv-processing has the time of each pixel's last event, without a decay. Its surface is compared by these times, at the
last image only, because it returns times one by one; its run time is that of its own image. Its accumulator, used
without decay, counts ON minus OFF, or both.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from script_tables import table_of, write

from evetac_cli.events import SLICE_US, Events, SliceBlock
from evetac_cli.formats.imports import read_events
from evetac_cli.jobs import Row
from evetac_cli.kernels.event_drawing import fold
from evetac_cli.kernels.event_representation import POLARITIES, Representation, representation
from evetac_cli.store.recordings.read import open_recording

Images = NDArray[Any]
BLOCK_SLICES = 1000
NAME = "event-images"
DECAY_MS = 10.0
ROUNDING = 1e-6  # evetac uses single precision
COLUMNS = {
    "images": "{representation}",
    "compared with": "{peer}",
    "images compared": "{images}",
    "values that differ": "{differ}",
    "largest difference": "{largest_difference:.1g}",
    "their time over evetac's, least and most of the files": "{least_times_as_fast:.2f} to {most_times_as_fast:.2f}",
}


class Input(NamedTuple):
    """Events sorted by time, starting at 0, in the formats of evetac, tonic and dv-processing."""

    blocks: list[SliceBlock]
    rows: NDArray[Any]
    store: Any
    frame_px: tuple[int, int]
    slices: int
    simulated: bool


class Peer(NamedTuple):
    """A peer's images of a representation: all of them, or only the last, and the largest allowed difference."""

    name: str
    of: Representation
    images: Callable[[Input, Representation], Images]
    timed: Callable[[Input, Representation], Any]
    tolerance: float = 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    rows = []
    for file in chosen.files:
        given = load(file, chosen.seconds)
        for peer in peers(given.frame_px):
            name = f"{file.name} (simulated)" if given.simulated else file.name
            rows.append({"file": name, **compared(given, peer, chosen.rounds)})
            sys.stdout.write(json.dumps(rows[-1]) + "\n")
    if chosen.out is not None:
        names = " ".join(file.name for file in chosen.files)
        command = f"python scripts/compare_images.py {names} --seconds {chosen.seconds:g} --rounds {chosen.rounds}"
        sizes = {"seconds": chosen.seconds, "rounds": chosen.rounds, "files": len(chosen.files)}
        simulated = len({row["file"] for row in rows if row["simulated"]})
        title = (
            f"Images of events of {len(chosen.files)} recordings, {simulated} of them simulated, beside tonic's and"
            " dv-processing's"
        )
        table = table_of(NAME, title, COLUMNS, summed(rows), command, sizes)
        write(chosen.out, table | {"simulated": False})  # as in the title
        lines = "".join(json.dumps(row) + "\n" for row in rows)
        (chosen.out / "rows" / f"{NAME}.jsonl").write_text(lines)
    sys.exit(any(row["differ"] for row in rows))


def summed(rows: list[Row]) -> list[Row]:
    """Return a row for each representation and peer, over all files."""
    by_pair: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        by_pair.setdefault((row["representation"], row["peer"]), []).append(row)
    return [
        {
            "representation": representation,
            "peer": peer,
            "images": sum(row["images"] for row in of_pair),
            "differ": sum(row["differ"] for row in of_pair),
            "largest_difference": max(row["largest_difference"] for row in of_pair),
            "least_times_as_fast": min(row["times_as_fast"] for row in of_pair),
            "most_times_as_fast": max(row["times_as_fast"] for row in of_pair),
        }
        for (representation, peer), of_pair in by_pair.items()
    ]


def load(file: Path, seconds: float) -> Input:
    """Load the first seconds of a file; times are counted from the first event."""
    import dv_processing as dv

    simulated = False
    if file.name.endswith(".recording.h5"):
        with open_recording(file) as recording:
            events, frame_px = recording.between(0, len(recording)), recording.frame_px
            simulated = bool(recording.header["simulated"])
    else:
        imported = read_events(file)
        events, frame_px = imported.events, imported.frame_px
    t = events.t - events.t[0]
    count = int(np.searchsorted(t, round(seconds * 1e6)))
    events = Events(t[:count], *(column[:count] for column in events[1:]))
    slices = int(t[count - 1]) // SLICE_US + 1
    blocks = []
    for first in range(0, slices, BLOCK_SLICES):
        stop = min(first + BLOCK_SLICES, slices)
        starts = np.searchsorted(events.t, np.arange(first, stop + 1) * SLICE_US)
        blocks.append(SliceBlock(first, starts - starts[0], events.part(int(starts[0]), int(starts[-1]))))
    rows = np.empty(count, [("x", "i2"), ("y", "i2"), ("t", "i8"), ("p", "i1")])
    store = dv.EventStore()
    for name in "xytp":
        rows[name] = getattr(events, name)
    for t_us, x, y, p in zip(*(column.tolist() for column in events), strict=True):
        store.push_back(t_us, x, y, bool(p))
    return Input(blocks, rows, store, frame_px, slices, simulated)


def peers(frame_px: tuple[int, int]) -> Iterator[Peer]:
    """Return the comparisons to make."""
    surface = representation("surface", frame_px, None, 100.0, None, decay_ms=DECAY_MS)
    counts, signed, both = (
        representation("frames", frame_px, None, 200.0, None, polarity=polarity) for polarity in POLARITIES
    )
    histogram, voxels = (representation(kind, frame_px, None, 20.0, None, bins=5) for kind in ("histogram", "voxels"))
    yield Peer("tonic", counts, tonic_frames, tonic_frames)
    yield Peer("tonic", histogram, tonic_histogram, tonic_histogram)
    yield Peer("tonic", voxels, tonic_voxels, tonic_voxels, ROUNDING)
    yield Peer("tonic", surface, tonic_surface, tonic_surface, ROUNDING)
    yield Peer("dv-processing", signed, dv_counts, dv_counts)
    yield Peer("dv-processing", both, dv_counts, dv_counts)
    yield Peer("dv-processing", surface, dv_surface, dv_surface_pictures, ROUNDING)


def compared(given: Input, peer: Peer, rounds: int) -> Row:
    """Return the row of one representation and one peer."""
    of = peer.of

    def ours() -> list[Images]:
        return [block.images for block in fold(of, given.blocks)]

    mine, theirs = np.concatenate(ours()), peer.images(given, of)
    images = min(len(mine), len(theirs))
    mine = mine[-1:] if peer.images is dv_surface else mine[:images]
    difference = np.abs(mine - theirs[:images].astype(np.float64))
    largest = max(1.0, float(np.abs(theirs).max(initial=0.0)))
    ours_s, theirs_s = [], []
    for _ in range(rounds):
        for run, took in ((ours, ours_s), (partial(peer.timed, given, of), theirs_s)):
            begin = time.perf_counter()
            run()
            took.append(time.perf_counter() - begin)
    ours_median_s, theirs_median_s = statistics.median(ours_s), statistics.median(theirs_s)
    return {
        "peer": peer.name,
        "representation": f"{of.kind}, {of.polarity}" if of.kind == "frames" else of.kind,
        "simulated": given.simulated,
        "frame_px": list(given.frame_px),
        "events": len(given.rows),
        "images": images,
        "differ": int(np.count_nonzero(difference > peer.tolerance * largest)),
        "largest_difference": float(difference.max(initial=0.0)),
        "ours_ms": 1e3 * ours_median_s,
        "theirs_ms": 1e3 * theirs_median_s,
        "times_as_fast": theirs_median_s / ours_median_s,
    }


def window(given: Input, of: Representation, image: int) -> NDArray[Any]:
    """Return tonic's rows for the window of an image, as a copy, because tonic changes them."""
    end_us = of.end(image) * SLICE_US
    first, last = np.searchsorted(given.rows["t"], (end_us - of.window_ms * SLICE_US, end_us))
    return given.rows[first:last].copy()


def tonic_frames(given: Input, of: Representation) -> Images:
    from tonic.functional import to_frame_numpy

    shape, window_us = (*given.frame_px, 2), of.window_ms * SLICE_US
    frames: Images = to_frame_numpy(
        given.rows, shape, time_window=window_us, start_time=0, end_time=given.slices * SLICE_US
    )
    return frames


def tonic_histogram(given: Input, of: Representation) -> Images:
    from tonic.functional import to_frame_numpy

    shape, bin_us = (*given.frame_px, 2), of.window_ms * SLICE_US // of.bins
    frames = to_frame_numpy(given.rows, shape, time_window=bin_us, start_time=0, end_time=given.slices * SLICE_US)
    images = len(frames) // of.bins
    binned: Images = frames[: images * of.bins].reshape(images, of.bins, *frames.shape[1:]).swapaxes(1, 2)
    return binned


def tonic_voxels(given: Input, of: Representation) -> Images:
    from tonic.functional import to_voxel_grid_numpy

    grids = []
    for image in range(of.images(given.slices)):
        end_us = of.end(image) * SLICE_US
        marks = np.zeros(2, given.rows.dtype)
        marks["t"], marks["p"] = (end_us - of.window_ms * SLICE_US, end_us), 1
        marked = np.concatenate([marks[:1], window(given, of, image), marks[1:]])
        grid = to_voxel_grid_numpy(marked, (*given.frame_px, 2), of.bins)[:, 0]
        grid[0, 0, 0] -= 1
        grids.append(grid)
    return np.array(grids)


def tonic_surface(given: Input, of: Representation) -> Images:
    from tonic.functional import to_timesurface_numpy

    step_us = of.end(0) * SLICE_US
    surfaces: Images = to_timesurface_numpy(given.rows, (*given.frame_px, 2), step_us, of.decay_ms * SLICE_US)
    return surfaces


def dv_counts(given: Input, of: Representation) -> Images:
    import dv_processing as dv

    most = 1e6
    accumulator = dv.Accumulator(
        given.frame_px, dv.Accumulator.Decay.NONE, 0.0, False, 1.0, most, 0.0, -most, of.polarity == "sum"
    )
    images = np.empty((of.images(given.slices), *of.shape), np.float32)
    for number, image in enumerate(images):
        end_us = of.end(number) * SLICE_US
        accumulator.accept(given.store.sliceTime(end_us - of.window_ms * SLICE_US, end_us))
        image[0] = accumulator.getPotentialSurface()
        accumulator.clear()
    return images


def dv_surfaces(given: Input) -> list[tuple[Any, Any]]:
    """Return an empty surface of dv-processing for each polarity, with the filter for its events."""
    import dv_processing as dv

    return [(dv.TimeSurface(given.frame_px), dv.EventPolarityFilter(on)) for on in (False, True)]


def dv_surface(given: Input, of: Representation) -> Images:
    """Return the last surface."""
    end_us = of.end(of.images(given.slices) - 1) * SLICE_US
    result = np.zeros((1, *of.shape))
    rows = given.rows[given.rows["t"] < end_us]
    for channel, (surface, of_polarity) in enumerate(dv_surfaces(given)):
        of_polarity.accept(given.store.sliceTime(0, end_us))
        surface.accept(of_polarity.generateEvents())
        for y, x in np.unique(rows[rows["p"] == channel][["y", "x"]]).tolist():
            result[0, channel, y, x] = np.exp((surface.at(y, x) - end_us) / (of.decay_ms * SLICE_US))
    return result


def dv_surface_pictures(given: Input, of: Representation) -> None:
    """Return dv-processing's own images of its surfaces."""
    surfaces, begin_us = dv_surfaces(given), 0
    for image in range(of.images(given.slices)):
        end_us = of.end(image) * SLICE_US
        new = given.store.sliceTime(begin_us, end_us)
        for surface, of_polarity in surfaces:
            of_polarity.accept(new)
            surface.accept(of_polarity.generateEvents())
            surface.generateFrame()
        begin_us = end_us


if __name__ == "__main__":
    main()
