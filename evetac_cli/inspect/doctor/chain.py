"""doctor --speed: run a whole grasp in real time, to find how many events per second this computer can process.

A virtual camera that plays random events at a given rate, a virtual gripper, detector, controller and recorder run for
10 s. Each has its own process, as in a grasp with devices: parts that are fast enough separately may be too slow
together. The first rate is a million events per second; if that is too much, 300,000, and then 600,000 or 100,000.
Every rate that is reported was tried. A rate is fine if the grasp reaches its end, the recorder keeps up, and at most
1 % of slices and of commands are late because of this computer. In a real grasp, smaller faults cause a warning, and
the grasp continues.
"""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.commands.grasp import Grasp
from evetac_cli.errors import EvetacError, attached_outcome
from evetac_cli.events import FRAME_PX
from evetac_cli.inspect.doctor import check
from evetac_cli.jobs import Progress, Row
from evetac_cli.trials.session import BEHIND_S

WANTED_PER_S = 1_000_000
NEXT_PER_S = {  # rate -> (next rate if it was too much, next rate if it was fine); 0: none
    1_000_000: (300_000, 0),
    300_000: (100_000, 600_000),
    600_000: (0, 0),
    100_000: (0, 0),
}
SECONDS = 10.0
MOST_LATE = 0.01
TOUCH_S = 1.5  # duration of the scene's contact, before the phases that have flags
FEWER = "reduce events with evetac record --readout-rate, --threshold-on, --threshold-off; use a smaller --model"


class Tried(NamedTuple):
    """The result of a grasp at a rate."""

    events_per_s: int
    ended: str = ""  # why it ended early; "" if it did not
    slices: int = 0
    late_slices: int = 0
    commands: int = 0  # including missed ones
    missed_by_us: int = 0
    missed_by_gripper: int = 0  # by the pseudo terminal, which is not representative of a real gripper
    behind_s: float = 0.0  # largest delay of the recorder
    detector_share: float | None = None  # of a core

    @property
    def is_fine(self) -> bool:
        """Whether this computer can process events at this rate."""
        in_time = self.late_slices <= MOST_LATE * self.slices and self.missed_by_us <= MOST_LATE * self.commands
        return not self.ended and in_time and self.behind_s <= BEHIND_S


def attempt(
    events_per_s: int, folder: Path, dots: dict[str, Any], progress: Callable[[float], None], seconds: float = SECONDS
) -> Tried:
    """Grasp once at a rate; dots: a grid as written by `calibrate`; progress: called with the seconds that have passed.

    Files are written into a temporary folder in `folder`, which is removed. Raises InputError or OSError if that fails.
    """
    from evetac_cli.trials import grasp
    from evetac_cli.trials.grasp import real_time
    from evetac_cli.trials.grasp.settings import DeviceGrasp

    def watch(done: float, total: float, doing: str = "") -> None:
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
        row["detector_core_share"],
    )


def rows(
    attempt_at: Callable[[int, Callable[[float], None]], Tried], progress: Progress, close: str
) -> tuple[list[Row], int]:
    """Return a row for each rate that was tried and one for the result, and the highest fine rate (0: none).

    attempt_at: tries a rate and reports the seconds that have passed. close: advice for a busy computer.
    """
    found: list[Row] = []
    judged, rate = 0, WANTED_PER_S
    while rate:
        tried = attempt_at(rate, _reporting(progress, f"s of a grasp at {rate:,} events/s"))
        judged = max(judged, rate * tried.is_fine)
        found.append(_row(tried, close))
        rate = NEXT_PER_S[rate][tried.is_fine]
    words = f"{judged:,} events per second; tried for {SECONDS:g} s each: {', '.join(row['check'] for row in found)}"
    if not judged:
        words = f"less than {tried.events_per_s:,} events per second"
    wanted = judged >= WANTED_PER_S
    fix = "" if wanted else f"{close}; {FEWER}"
    found.append(check("grasp", "judges in time", wanted, words, f"{WANTED_PER_S:,} events per second", fix))
    return found, judged


def _reporting(progress: Progress, doing: str) -> Callable[[float], None]:
    """Return a function that reports the elapsed seconds of a grasp as progress."""
    return lambda passed_s: progress(passed_s, SECONDS, doing)


def _row(tried: Tried, close: str) -> Row:
    """Return the row with the result of a grasp at a rate."""
    parts = [f"{tried.late_slices:,} of {tried.slices:,} slices late"]
    parts.append(f"{tried.missed_by_us:,} of {tried.commands:,} commands missed")
    if tried.missed_by_gripper:
        parts.append(f"{tried.missed_by_gripper:,} more by the virtual gripper")
    if tried.behind_s > BEHIND_S:
        parts.append(f"the recorder is {tried.behind_s:.1f} s behind")
    if tried.detector_share is not None:
        parts.append(f"the detector takes {100 * tried.detector_share:.0f} % of a core")
    if tried.ended:
        parts.insert(0, tried.ended)
    verdict = "fine" if tried.is_fine else "not fine"
    limit = f"a complete grasp, with at most {MOST_LATE:.0%} of slices late and of commands missed"
    found = f"{verdict}: {'; '.join(parts)}"
    fix = "" if tried.is_fine else close
    return check("grasp", f"at {tried.events_per_s:,}/s", tried.is_fine, found, limit, fix)
