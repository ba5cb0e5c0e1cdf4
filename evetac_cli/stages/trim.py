"""trim: write a new recording with a range of slices of another, without its noise, or both.

Every group is cut: rows per slice by their index, rows of gripper, controller, marks and other streams by their time.
Times start again at 0, and `t_offset` stores the shift. Datasets without time are copied. Of `capture`, only the lost
slices and the reason of the end are kept, because its counts are those of the whole recording.

If the piece begins at slice 0, its tracks and features equal the first rows of those of the whole recording, bit for
bit, because they do not depend on later slices. In a piece that begins later, the tracker starts with dots at rest, as
in every recording.

The noise filter looks back only over a fixed time, and slices before the piece are included in this. So a piece of a
denoised recording and a denoised piece of the recording have the same events.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.trim import Trim
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.jobs import Job, Outcome, Progress, Stage, outcome, silent
from evetac_cli.stages import output_in, row_blocks
from evetac_cli.store.files import stem, up_to_date, write_stage
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.layout.rules import BLOCK_VALUES
from evetac_cli.store.recordings.read import Recording, open_recording

OUTPUT = "recording"
METHOD = 1
DV_SUPPORT_MS = 2.0  # default of dv-processing's filter
DENOISED_SLICES = 200  # processed at a time
# Dimensions whose rows have separate times, and the datasets of these times; for `samples`, within the stream.
CLOCKS = {"commands": "gripper/t_us", "control_steps": "control/t_us", "marks": "marks/t_us", "samples": "t_us"}


def jobs(files: list[Path], params: Trim, out: Path | None) -> list[Job]:
    """Return a job for every recording, with output <name>-<from>-<to>ms, or <name>-denoised for all slices."""
    if params.support_ms is not None and not params.denoise:
        raise InputError("has no effect", where="--support-ms", expected="--denoise", found="none")
    to = "end" if params.to_ms is None else f"{params.to_ms}"
    whole = params.denoise and not params.from_ms and params.to_ms is None
    called = ("" if whole else f"-{params.from_ms}-{to}ms") + ("-denoised" if params.denoise else "")
    return [Job((file,), output_in(out, file.parent, f"{stem(file)}{called}.{OUTPUT}.h5")) for file in files]


def run(job: Job, params: Trim, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Write the slices [from_ms, to_ms) of a recording; InputError if it has no such slices."""
    with open_recording(job.inputs[0]) as recording:
        first = params.from_ms
        end = len(recording) if params.to_ms is None else params.to_ms
        if not first < end <= len(recording):
            expected, found = f"--from-ms and --to-ms within 0 and {len(recording)}", f"{first} to {end}"
            raise InputError("slices out of range", where=str(job.inputs[0]), expected=expected, found=found)
        header = recording.header
        simulated = bool(header["simulated"])
        parameters = {**header["parameters"], "trimmed": {"from_ms": first, "to_ms": end}}
        noise = None
        if params.denoise:
            support_ms = DV_SUPPORT_MS if params.support_ms is None else params.support_ms
            noise = _Noise(recording, first, end, support_ms)
            parameters["denoised"] = {"support_ms": support_ms}
        recipe = Recipe(OUTPUT, METHOD, parameters, seed=header["seed"], parents=(header,))
        if up_to_date(job.output, recipe, force=force):
            return outcome(job, made=False, simulated=simulated)
        piece = _CutDatasets(recording, first, end, noise)
        made = (
            write_stage(job.output, recipe, piece.whole, piece.blocks(progress), piece.lengths, force=force) is not None
        )
        before = int(recording.starts[end] - recording.starts[first])
    events = int(piece.whole["ms_to_idx"][-1])
    left_out = {"left_out": before - events} if params.denoise else {}
    return outcome(job, made=made, simulated=simulated, slices=end - first, events=events, **left_out)


class _Noise(NamedTuple):
    """The noise filter for the slices [first, end) of a recording."""

    recording: Recording
    first: int
    end: int
    support_ms: float

    def rest(self) -> Iterator[Events]:
        """Yield the remaining events of each block of slices, with the times of the recording."""
        from evetac_cli.kernels.noise_filter import NoiseFilter

        hot = self.recording.hot_pixels()
        behind = NoiseFilter(self.support_ms, self.recording.frame_px)
        looked_back = max(0, self.first - math.ceil(self.support_ms))
        for block in self.recording.blocks(DENOISED_SLICES, looked_back, self.first):
            behind.keep(_without(block.events, hot))
        for block in self.recording.blocks(DENOISED_SLICES, self.first, self.end):
            yield Events(*behind.keep(_without(block.events, hot)))


def _without(events: Events, hot: NDArray[np.bool_]) -> Events:
    """Return the events that are not from a hot pixel, as new arrays; hot: (height, width)."""
    return events.at(~hot[events.y, events.x])


class _CutDatasets:
    """The datasets of a recording, cut to the slices [first, end): small ones whole, those with rows in blocks."""

    def __init__(self, recording: Recording, first: int, end: int, noise: _Noise | None) -> None:
        self._recording = recording
        self._slices = first, end
        self._noise = noise
        begin, stop = int(recording.starts[first]), int(recording.starts[end])
        starts = recording.starts[first : end + 1] - begin
        if noise is not None:
            edges_us = np.arange(first, end + 1) * SLICE_US
            starts = np.sum([np.searchsorted(events.t, edges_us) for events in noise.rest()], axis=0, dtype=np.int64)
        self.whole: dict[str, Any] = {
            "ms_to_idx": starts,
            "t_offset": np.int64(recording.read("t_offset") + first * SLICE_US),
        }
        self.lengths: dict[str, int] = {}
        self._ranges: dict[str, tuple[int, int, str]] = {}  # for each dataset its rows, and the clock that selects some
        kept: dict[str, int] = {}  # number of rows, by clock
        table = schema.load(OUTPUT)
        for name in recording.contents():
            described = table.find(name)
            dim = described.dims[0] if described is not None and described.dims else ""
            group = described.named_group(name) if described is not None else ""
            if name in self.whole or (name.startswith("capture/") and name != "capture/ended"):
                continue
            if dim == "events" and noise is not None:
                self.lengths[name] = int(starts[-1])
            elif dim in ("events", "slices"):
                rows = (begin, stop) if dim == "events" else (first, end)
                self._ranges[name] = (*rows, "")
                self.lengths[name] = rows[1] - rows[0]
            elif dim in CLOCKS:
                clock = f"{group}/{CLOCKS[str(dim)]}" if group else CLOCKS[str(dim)]
                if clock not in kept:
                    kept[clock] = self._within(clock)
                self._ranges[name] = (0, recording.length(name), clock)
                self.lengths[name] = kept[clock]
            else:
                self.whole[name] = recording.read(name)
        self.whole |= _lost(recording, first, end)

    def blocks(self, progress: Progress) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield one dataset after the other; progress is the share of all rows, in slices."""
        shift_us = self._slices[0] * SLICE_US
        slices = self._slices[1] - self._slices[0]
        for events in () if self._noise is None else self._noise.rest():
            yield {
                f"events/{name}": column for name, column in events._replace(t=events.t - shift_us)._asdict().items()
            }
        done, total = 0, sum(stop - start for start, stop, _ in self._ranges.values())
        for name, (start, stop, clock) in self._ranges.items():
            row_values = int(np.prod(self._recording.contents()[name][1][1:]))
            for first, last in row_blocks(stop - start, max(1, BLOCK_VALUES // row_values)):
                rows = self._recording.read(name, start + first, start + last)
                if clock:
                    rows = rows[self._rows(clock, first, last)]
                yield {name: rows - shift_us if name in ("events/t", clock) else rows}
                done += last - first
                progress(done * slices // max(total, 1), slices)

    def _within(self, clock: str) -> int:
        """Return the number of rows with a time within the slices."""
        blocks = row_blocks(self._recording.length(clock))
        return sum(int(np.count_nonzero(self._rows(clock, first, stop))) for first, stop in blocks)

    def _rows(self, clock: str, first: int, stop: int) -> NDArray[np.bool_]:
        """Return which of the rows [first, stop) have a time within the slices."""
        t_us = self._recording.read(clock, first, stop)
        return np.asarray((t_us >= self._slices[0] * SLICE_US) & (t_us < self._slices[1] * SLICE_US))


def _lost(recording: Recording, first: int, end: int) -> dict[str, Any]:
    """Return the lost slices within [first, end), relative to first."""
    if not recording.has("capture/lost_slices"):
        return {}
    gaps = np.clip(recording.read("capture/lost_slices"), first, end) - first
    gaps = gaps[gaps[:, 0] < gaps[:, 1]]
    return {"capture/lost_slices": gaps} if len(gaps) else {}


STAGE = Stage(jobs, run)
