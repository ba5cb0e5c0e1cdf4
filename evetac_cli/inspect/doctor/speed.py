"""doctor speed: measure in 15 to 40 s whether this computer is fast enough to record and grasp in real time.

The cores must wake on time. Then a whole grasp runs in real time for 10 s, to find how many events per second this
computer can process: a virtual camera plays random events at a given rate. Each part has its own process, as in a grasp
with devices: parts that are fast enough separately may be too slow together. The first rate is a million events per
second; if that is too much, 300,000, and then 600,000 or 100,000. Every rate that is reported was tried. A rate is fine
if the grasp reaches its end, the recorder keeps up, and at most 1 % of slices and of commands are late because of this
computer. In a real grasp, smaller faults cause a warning, and the grasp continues.

All measurements are methods of one object, so that tests can replace this computer by another.
"""

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.grasp import Grasp
from evetac_cli.errors import EvetacError, InputError, attached_outcome
from evetac_cli.events import FRAME_PX
from evetac_cli.inspect.doctor.cameras import check, show
from evetac_cli.jobs import LookCall, Outcome, Progress, Row, silent
from evetac_cli.realtime.processes import REALTIME, raised_priority
from evetac_cli.trials.grasp.controller_process import PRIORITY
from evetac_cli.trials.session import BEHIND_S

SLEEP_S = 1e-3
WAKING_S = 3.0  # total time on all cores
LEAST_WAKING_S = 0.1  # minimum per core
WAKE_P99_US = 500.0  # a quarter of a control step
WAKE_MOST_US = 2000.0  # a whole control step: a command is missed
LEAST_CORES = 2
GOVERNOR = "performance"
WANTED_PER_S = 1_000_000
NEXT_PER_S = {  # rate -> (next rate if it was too much, next rate if it was fine); 0: none
    1_000_000: (300_000, 0),
    300_000: (100_000, 600_000),
    600_000: (0, 0),
    100_000: (0, 0),
}
SECONDS = 10.0
MOST_LATE = 0.01
DOTS_PX = np.stack(np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0), axis=-1)
GRID = {"frame_px": FRAME_PX, "dot_xy_px": DOTS_PX.tolist(), "radius_px": 11.0}  # as written by `calibrate`
FEWER = "reduce events with evetac record --readout-rate, --threshold-on, --threshold-off; use a smaller --model"
CLOSE = "close other programs; connect a laptop to power"
SET_GOVERNOR = f"sudo cpupower frequency-set -g {GOVERNOR}"
PERMIT = (
    "for `ulimit -r` of 50: put `@realtime - rtprio 50` into a file in /etc/security/limits.d/, join that group, and"
    " log in again"
)

__all__ = ["run", "show"]


class WakeUps(NamedTuple):
    """The delays of wake-ups, in us, and the priority."""

    late_us: NDArray[np.float64]
    scheduling: str


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


@dataclass
class Computer:
    """The computer that is measured; tests replace it."""

    sysfs: Path = Path("/sys")

    def cores(self) -> list[int]:
        """Return the cores that this program may use; on systems other than Linux, one that represents all."""
        return sorted(os.sched_getaffinity(0)) if sys.platform == "linux" else [0]

    def wake_ups_us(self, core: int, seconds: float) -> WakeUps:
        """Sleep for 1 ms repeatedly on this core, at the controller's priority, and measure the delays."""
        pinned = sys.platform == "linux"
        before = os.sched_getaffinity(0) if pinned else set()
        late_us = []
        with raised_priority(PRIORITY) as scheduling:
            try:
                if pinned:
                    os.sched_setaffinity(0, {core})
                until_s = time.monotonic() + seconds
                while (begun_s := time.monotonic()) < until_s:
                    time.sleep(SLEEP_S)
                    late_us.append(1e6 * (time.monotonic() - begun_s - SLEEP_S))
            finally:
                if pinned:
                    os.sched_setaffinity(0, before)
        return WakeUps(np.array(late_us), scheduling)

    def governor(self) -> str | None:
        """Return the frequency governor of the first core; None if the system does not state it."""
        try:
            return (self.sysfs / "devices/system/cpu/cpu0/cpufreq/scaling_governor").read_text().strip()
        except OSError:
            return None

    def grasped(
        self, events_per_s: int, folder: Path, progress: Callable[[float], None], seconds: float = SECONDS
    ) -> Tried:
        """Grasp once with virtual devices at this event rate; progress: called with the elapsed seconds.

        Files are written into a temporary folder in `folder`, which is removed; InputError or OSError if that fails.
        """
        from evetac_cli.sim.setup import scene_file
        from evetac_cli.trials import grasp
        from evetac_cli.trials.grasp import real_time
        from evetac_cli.trials.grasp.settings import DeviceGrasp

        def watch(done: float, total: float, doing: str = "") -> None:
            progress(done * 1e-3)

        with tempfile.TemporaryDirectory(dir=folder, prefix=".speed-") as temporary:
            grid = Path(temporary) / "grid.json"
            grid.write_text(json.dumps(GRID))
            half_s = (seconds - scene_file.load(Grasp.scene).time.touch_s) / 2
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


def look(call: LookCall) -> Outcome:
    """Measure this computer."""
    return run(progress=call.progress)


def run(computer: Computer | None = None, folder: Path | None = None, progress: Progress = silent) -> Outcome:
    """Return a row for each part: the measurement, its limit, and what to do if it exceeds the limit.

    folder: on the disk to test; None: the current folder. The summary has the events per second that are processed in
    time, 0 for none, and None if this could not be tried.
    """
    computer = computer or Computer()
    progress(0, 2, "measuring wake-ups")
    rows = _waking(computer)
    try:
        grasped, judged = _grasping(computer, folder or Path.cwd(), progress)
        rows += grasped
    except (InputError, OSError) as error:
        reason, judged = f"not tried: {' '.join(str(error).split())}", None
        fix = "run the command in a folder that is writable and intended for recordings"
        rows.append(check("grasp", "judges in time", None, reason, "a folder to write in", fix))
    return Outcome(rows, False, {"wrong": sum(row["ok"] is False for row in rows), "judged_events_per_s": judged})


def _waking(computer: Computer) -> list[Row]:
    cores = computer.cores()
    few = "use another computer, or permit more cores (`taskset -p $$` shows the permitted ones)"
    enough = len(cores) >= LEAST_CORES
    rows = [check("cores", "for this program", enough, str(len(cores)), f"at least {LEAST_CORES}", few)]
    each_s = max(WAKING_S / len(cores), LEAST_WAKING_S)
    woken = {core: computer.wake_ups_us(core, each_s) for core in cores}
    scheduling = woken[cores[0]].scheduling
    first = scheduling.startswith(REALTIME)
    governor = computer.governor()
    slow = governor not in (None, GOVERNOR)
    ways = [CLOSE, *([] if first else [PERMIT]), *([SET_GOVERNOR] if slow else [])]
    for core, (late_us, _) in woken.items():
        p99, most = float(np.percentile(late_us, 99)), float(late_us.max())
        fine = p99 <= WAKE_P99_US and most <= WAKE_MOST_US
        words = f"99 % of sleeps of 1 ms end at most {p99:.0f} us late, all of them at most {most:.0f} us"
        limit = f"{WAKE_P99_US:.0f} us and {WAKE_MOST_US:.0f} us"
        rows.append(check("cores", f"core {core} wakes", fine, words, limit, "; ".join(ways)))
    rows.append(check("cores", "priority", first or None, scheduling, REALTIME, PERMIT))
    if governor is not None:
        rows.append(
            check("cores", "clock rate", None if slow else True, f"governor {governor}", GOVERNOR, SET_GOVERNOR)
        )
    return rows


def _grasping(computer: Computer, folder: Path, progress: Progress) -> tuple[list[Row], int | None]:
    """Return a row for each rate that was tried and one for the result, and the highest fine rate (0: none)."""
    found: list[Row] = []
    judged, rate = 0, WANTED_PER_S
    while rate:
        doing = f"s of a grasp at {rate:,} events/s"
        tried = computer.grasped(rate, folder, lambda passed_s, doing=doing: progress(passed_s, SECONDS, doing))  # type: ignore[misc]
        judged = max(judged, rate * tried.is_fine)
        found.append(_row(tried))
        rate = NEXT_PER_S[rate][tried.is_fine]
    words = f"{judged:,} events per second; tried for {SECONDS:g} s each: {', '.join(row['check'] for row in found)}"
    if not judged:
        words = f"less than {tried.events_per_s:,} events per second"
    limit = f"{WANTED_PER_S:,} events per second"
    found.append(check("grasp", "judges in time", judged >= WANTED_PER_S, words, limit, f"{CLOSE}; {FEWER}"))
    return found, judged


def _row(tried: Tried) -> Row:
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
    return check("grasp", f"at {tried.events_per_s:,}/s", tried.is_fine, found, limit, CLOSE)
