"""doctor --speed: a whole grasp in real time, to see how many events a second this computer can judge.

A virtual camera that plays random events at a given rate, a virtual gripper, detector, controller and recorder, each in
its process as in a grasp with devices, for 10 s: parts that are fast enough one after the other may be too slow beside
each other. First at a million events a second; where that is too much, at 300,000, and then at 600,000 or 100,000. What
is said to be judged was tried. A rate is fine where the grasp lasts to its end, and no more of its slices and commands
come late than a grasp lets pass without a word.
"""

import json
import multiprocessing
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.commands.grasp import Grasp
from evetac_cli.errors import EvetacError, attached_outcome
from evetac_cli.events import FRAME_PX
from evetac_cli.inspect.doctor import check
from evetac_cli.jobs import Progress, Row
from evetac_cli.realtime.processes import cpu_time_s
from evetac_cli.trials.session import BEHIND_S, TOLERATED

WANTED_PER_S = 1_000_000
NEXT_PER_S = {  # after a rate: which one, where it was too much, and where it was fine; 0: none
    1_000_000: (300_000, 0),
    300_000: (100_000, 600_000),
    600_000: (0, 0),
    100_000: (0, 0),
}
SECONDS = 10.0
TOUCH_S = 1.5  # of the scene's contact, before the phases that have flags
SETTLED_SLICES = 500  # from which on the detector's share of a core is measured
FEWER = "fewer events: evetac record --readout-rate, --threshold-on, --threshold-off; a smaller network: --model"


class Tried(NamedTuple):
    """A grasp at a rate, and what became of it."""

    events_per_s: int
    ended: str = ""  # why it ended before its time; "" if it did not
    slices: int = 0
    late_slices: int = 0
    commands: int = 0  # missed ones among them
    missed_by_us: int = 0
    missed_by_gripper: int = 0  # by a pseudo terminal here, which says little of a real one
    behind_s: float = 0.0  # the recorder, at most
    detector_share: float | None = None  # of a core

    @property
    def is_fine(self) -> bool:
        """Whether this computer can judge so many events a second."""
        in_time = self.late_slices <= TOLERATED * self.slices and self.missed_by_us <= TOLERATED * self.commands
        return not self.ended and in_time and self.behind_s <= BEHIND_S


def attempt(
    events_per_s: int, folder: Path, dots: dict[str, Any], progress: Callable[[float], None], seconds: float = SECONDS
) -> Tried:
    """Grasp once at a rate; dots: a grid as `calibrate` writes it; progress: takes the seconds that have passed.

    Writes in a temporary folder in this one, which is removed. InputError or OSError where that cannot be.
    """
    from evetac_cli.trials import grasp
    from evetac_cli.trials.grasp import real_time
    from evetac_cli.trials.grasp.settings import DeviceGrasp

    shares = _DetectorShare()

    def watch(done: float, total: float, doing: str = "") -> None:
        shares.look(done)
        progress(done * 1e-3)

    with tempfile.TemporaryDirectory(dir=folder, prefix=".speed-") as temporary:
        grid = Path(temporary) / "grid.json"
        grid.write_text(json.dumps({"frame_px": FRAME_PX, **dots}))
        half_s = (seconds - TOUCH_S) / 2
        params = Grasp(
            camera=f"virtual:prepared={events_per_s}",
            gripper="virtual",
            calibration=grid,
            lift_s=half_s,
            balance_s=half_s,
        )
        (job,) = grasp.jobs([], params, Path(temporary) / "a.recording.h5")
        assert isinstance(job, DeviceGrasp)
        ended = ""
        try:
            outcome = real_time.run(job, force=False, progress=watch, say=lambda line: None)
        except EvetacError as error:
            outcome, ended = attached_outcome(error), error.message.splitlines()[0]
            if outcome is None:
                return Tried(events_per_s, ended)
    row = outcome.rows[0]
    missed, by_gripper = row["command_misses"] or 0, row["command_misses_by_gripper"] or 0
    return Tried(
        events_per_s,
        ended,
        row["slices"],
        row["late_slices"],
        row["commands"] + missed,
        missed - by_gripper,
        by_gripper,
        row["recorder_behind_s"],
        shares.share,
    )


class _DetectorShare:
    """Which share of a core the detector of a grasp takes, from its CPU time at two moments."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, float]] = []  # time of day, CPU time

    def look(self, slices: float) -> None:
        """Take its CPU time after so many slices."""
        if slices < SETTLED_SLICES:
            return
        for process in multiprocessing.active_children():
            if process.name == "evetac-detector":
                self._seen = [*self._seen[:1], (time.monotonic(), cpu_time_s(process.pid))]

    @property
    def share(self) -> float | None:
        """CPU time over time; None before there were two moments."""
        if len(self._seen) < 2:
            return None
        (first_s, first_cpu_s), (last_s, last_cpu_s) = self._seen
        return (last_cpu_s - first_cpu_s) / max(last_s - first_s, 1e-9)


def rows(
    attempt_at: Callable[[int, Callable[[float], None]], Tried], progress: Progress, close: str
) -> tuple[list[Row], int]:
    """A row for each rate that was tried and one for what is judged; how many events a second that are, 0 for none.

    attempt_at: tries a rate, and reports the seconds that have passed; close: advice for a computer that is busy.
    """
    found: list[Row] = []
    judged, rate = 0, WANTED_PER_S
    while rate:
        tried = attempt_at(rate, _reporting(progress, f"s of a grasp at {rate:,} events/s"))
        judged = max(judged, rate * tried.is_fine)
        found.append(_row(tried, close))
        rate = NEXT_PER_S[rate][tried.is_fine]
    words = f"{judged:,} events a second; tried for {SECONDS:g} s each: {', '.join(row['check'] for row in found)}"
    if not judged:
        words = f"not even {tried.events_per_s:,} events a second"
    wanted = judged >= WANTED_PER_S
    fix = "" if wanted else f"{close}; {FEWER}"
    found.append(check("grasp", "judges in time", wanted, words, f"{WANTED_PER_S:,} events a second", fix))
    return found, judged


def _reporting(progress: Progress, doing: str) -> Callable[[float], None]:
    """What takes the seconds of a grasp."""
    return lambda passed_s: progress(passed_s, SECONDS, doing)


def _row(tried: Tried, close: str) -> Row:
    """What became of a grasp at a rate."""
    parts = [f"{tried.late_slices:,} of {tried.slices:,} slices late"]
    parts.append(f"{tried.missed_by_us:,} of {tried.commands:,} commands missed")
    if tried.missed_by_gripper:
        parts.append(f"{tried.missed_by_gripper:,} more by the virtual gripper")
    if tried.behind_s > BEHIND_S:
        parts.append(f"the recorder {tried.behind_s:.1f} s behind")
    if tried.detector_share is not None:
        parts.append(f"the detector takes {100 * tried.detector_share:.0f} % of a core")
    if tried.ended:
        parts.insert(0, tried.ended)
    verdict = "fine" if tried.is_fine else "not fine"
    limit = f"at most {TOLERATED:.1%} of slices late and of commands missed"
    found = f"{verdict}: {'; '.join(parts)}"
    fix = "" if tried.is_fine else close
    return check("grasp", f"at {tried.events_per_s:,}/s", tried.is_fine, found, limit, fix)
