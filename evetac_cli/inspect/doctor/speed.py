"""doctor --speed: measure in 20 to 50 s whether this computer is fast enough to record and grasp in real time.

Each real-time part of `record` and `grasp` is measured separately: waking on time, the online step of the pretrained
detector, decoding of a camera's words, writing of segments. Then all run at once in a grasp with virtual devices
(chain.py), which is the actual load.

All measurements are methods of one object, so that tests can replace this computer by another.
"""

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

from evetac_cli import resources
from evetac_cli.commands.doctor import Doctor
from evetac_cli.devices.dvxplorer import event_words
from evetac_cli.devices.dvxplorer.usb_reader import READ_BYTES
from evetac_cli.devices.virtual.word_sources import random_event_words
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX, SLICE_US, Events
from evetac_cli.inspect.doctor import chain, check, show
from evetac_cli.jobs import Outcome, Progress, Row, silent
from evetac_cli.kernels.tracking import presets
from evetac_cli.realtime.processes import REALTIME, raised_priority
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.segments import RecordingWriter
from evetac_cli.trials.grasp.controller_process import PRIORITY
from evetac_cli.trials.grasp.online_detector import open_detector
from evetac_cli.trials.session import RECORDER_MS

SLEEP_S = 1e-3
WAKING_S = 3.0  # total time on all cores
LEAST_WAKING_S = 0.1  # minimum per core
WAKE_P99_US = 500.0  # a quarter of a control step
WAKE_MOST_US = 2000.0  # a whole control step: a command is missed
USUAL_EVENTS, USUAL_P99_US = 500, 500.0  # events per slice; half of a slice, because decoding and writing need the rest
BURST_EVENTS, BURST_MEDIAN_US = 5000, 1000.0  # a slower detector falls behind in a burst
STEPS, FIRST_STEPS = 1000, 50  # measured steps, and steps before them that load everything
DIFFERENT_SLICES = 100
DECODED_PER_S = 10e6  # the highest event rate that a DVXplorer Mini sends
DECODING_S = 1.0
WRITTEN_PER_S = 1e6
SEGMENTS, SEGMENT_SLICES = 12, 250
SLICE_EVENTS = 1000
LEAST_CORES = 2
GOVERNOR = "performance"
PARTS = 4  # of the measurement
DOT_RADIUS_PX = 11.0
DOTS_PX = np.stack(np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0), axis=-1)
ELSEWHERE = "run the command in a folder that is writable and intended for recordings"
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


class Written(NamedTuple):
    """The recorder's rate of writing, and the time of its slowest segment."""

    events_per_s: float
    longest_ms: float


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

    def steps_us(self, events: int) -> NDArray[np.float64]:
        """Measure online steps of the pretrained detector, on slices with this many events at the rims of the dots."""
        sensor = {"sensor/frame_px": FRAME_PX, "sensor/dot_xy_px": DOTS_PX, "sensor/dot_radius_px": DOT_RADIUS_PX}
        with StageFile(resources.MODEL, "model") as model:
            detector = open_detector(model, sensor, presets.PRESETS["stable"])
        rng = np.random.default_rng(0)
        slices = [_rim_events(rng, events) for _ in range(DIFFERENT_SLICES)]
        times_us = []
        with raised_priority(PRIORITY):
            for k in range(FIRST_STEPS + STEPS):
                begun_s = time.perf_counter()
                detector.step(slices[k % DIFFERENT_SLICES])
                _ = detector.signal
                times_us.append(1e6 * (time.perf_counter() - begun_s))
        return np.array(times_us[FIRST_STEPS:])

    def decoded_per_s(self) -> float:
        """Measure the decoded events per second from a camera's words, in transfers of the driver's size."""
        words = random_event_words(DECODED_PER_S, 0.1, np.random.default_rng(0)).astype("<u4").tobytes()
        parts = [words[first : first + READ_BYTES] for first in range(0, len(words), READ_BYTES)]
        event_words.step(event_words.start(), parts[0])
        events, began_s = 0, time.perf_counter()
        while (passed_s := time.perf_counter() - began_s) < DECODING_S or not events:
            decoder = event_words.start()
            events += sum(event_words.step(decoder, part).size for part in parts)
        return events / passed_s

    def written(self, folder: Path) -> Written:
        """Measure the recorder on a temporary recording of 3 s in the folder, which is removed."""
        rng = np.random.default_rng(0)
        x, y = (rng.integers(0, size, SLICE_EVENTS).astype(np.uint16) for size in FRAME_PX)
        p = rng.integers(0, 2, SLICE_EVENTS).astype(np.uint8)
        t = np.sort(rng.integers(0, SLICE_US, SLICE_EVENTS))
        times_s = []
        with tempfile.TemporaryDirectory(dir=folder, prefix=".speed-") as temporary:
            sensor = {"sensor/frame_px": np.array(FRAME_PX, np.int32), "t_offset": np.int64(0)}
            writer = RecordingWriter(Path(temporary) / "a.recording.h5", sensor)
            try:
                for segment in range(SEGMENTS):
                    for k in range(SEGMENT_SLICES * segment, SEGMENT_SLICES * (segment + 1)):
                        writer.append(Events(t + k * SLICE_US, x, y, p))
                    begun_s = time.perf_counter()
                    writer.close_segment()
                    times_s.append(time.perf_counter() - begun_s)
            finally:
                writer.discard()
        return Written(SEGMENTS * SEGMENT_SLICES * SLICE_EVENTS / sum(times_s), 1e3 * max(times_s))

    def grasped(self, events_per_s: int, folder: Path, progress: Callable[[float], None]) -> chain.Tried:
        """Run a grasp with virtual devices at this event rate; progress: called with the elapsed seconds."""
        dots = {"dot_xy_px": DOTS_PX.tolist(), "radius_px": DOT_RADIUS_PX}
        return chain.attempt(events_per_s, folder, dots, progress)


def _rim_events(rng: np.random.Generator, count: int) -> Events:
    """Return a slice of events near the rims of dots at rest."""
    dots = DOTS_PX.reshape(-1, 2)[rng.integers(0, DOTS_PX.size // 2, count)]
    angle, radius = rng.uniform(0, 2 * np.pi, count), DOT_RADIUS_PX + rng.normal(0, 1, count)
    x, y = (dots + radius[:, np.newaxis] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).T
    p = rng.integers(0, 2, count).astype(np.uint8)
    return Events(np.sort(rng.integers(0, SLICE_US, count)), x.astype(np.uint16), y.astype(np.uint16), p)


def run(
    params: Doctor, computer: Computer | None = None, folder: Path | None = None, progress: Progress = silent
) -> Outcome:
    """Return a row for each part: the measurement, its limit, and what to do if it exceeds the limit.

    folder: on the disk to test; None: the current folder. The summary has the events per second that are processed in
    time, 0 for none, and None if this could not be tried.
    """
    computer = computer or Computer()
    folder = folder or Path.cwd()
    progress(0, PARTS, "measuring wake-ups")
    rows = _waking(computer)
    progress(1, PARTS, "measuring detector and decoder")
    rows += _computing(computer)
    progress(2, PARTS, "measuring the disk")
    rows += _writing(computer, folder)
    grasped, judged = _grasping(computer, folder, progress)
    rows += grasped
    return Outcome(rows, False, {"wrong": sum(row["ok"] is False for row in rows), "judged_events_per_s": judged})


def _grasping(computer: Computer, folder: Path, progress: Progress) -> tuple[list[Row], int | None]:
    """Run all parts at once; return rows and the events per second, None if the folder is not writable."""
    try:
        return chain.rows(lambda rate, passed: computer.grasped(rate, folder, passed), progress, CLOSE)
    except (InputError, OSError) as error:
        reason = f"not tried: {' '.join(str(error).split())}"
        return [check("grasp", "judges in time", None, reason, "a folder to write in", ELSEWHERE)], None


def _waking(computer: Computer) -> list[Row]:
    cores = computer.cores()
    row = check
    few = (
        ""
        if len(cores) >= LEAST_CORES
        else "use another computer, or permit more cores (`taskset -p $$` shows the permitted ones)"
    )
    rows = [row("cores", "for this program", not few, str(len(cores)), f"at least {LEAST_CORES}", few)]
    each_s = max(WAKING_S / len(cores), LEAST_WAKING_S)
    woken = {core: computer.wake_ups_us(core, each_s) for core in cores}
    scheduling = woken[cores[0]].scheduling
    first = scheduling.startswith(REALTIME)
    governor = computer.governor()
    slow = governor not in (None, GOVERNOR)
    for core, (late_us, _) in woken.items():
        p99, most = float(np.percentile(late_us, 99)), float(late_us.max())
        fine = p99 <= WAKE_P99_US and most <= WAKE_MOST_US
        ways = [CLOSE, *([] if first else [PERMIT]), *([SET_GOVERNOR] if slow else [])]
        words = f"99 % of sleeps of 1 ms end at most {p99:.0f} us late, all of them at most {most:.0f} us"
        limit = f"{WAKE_P99_US:.0f} us and {WAKE_MOST_US:.0f} us"
        rows.append(row("cores", f"core {core} wakes", fine, words, limit, "" if fine else "; ".join(ways)))
    rows.append(row("cores", "priority", first or None, scheduling, REALTIME, "" if first else PERMIT))
    if governor is not None:
        fix = SET_GOVERNOR if slow else ""
        rows.append(row("cores", "clock rate", None if slow else True, f"governor {governor}", GOVERNOR, fix))
    return rows


def _computing(computer: Computer) -> list[Row]:
    rows = []
    limits: tuple[tuple[int, str, float, Callable[[NDArray[np.float64]], float]], ...] = (
        (USUAL_EVENTS, "99 %", USUAL_P99_US, lambda us: float(np.percentile(us, 99))),
        (BURST_EVENTS, "half", BURST_MEDIAN_US, lambda us: float(np.median(us))),
    )
    for events, share, most_us, of in limits:
        us = of(computer.steps_us(events))
        fine = us <= most_us
        words = f"{share} of steps take at most {us:.0f} us"
        fix = "" if fine else f"{CLOSE}; or use a smaller network: --model"
        limit = f"{most_us:.0f} us, for 1000 slices per second"
        rows.append(check("slip detector", f"{events} events", fine, words, limit, fix))
    decoded = computer.decoded_per_s()
    fine = decoded >= DECODED_PER_S
    words, limit = (f"{per_s * 1e-6:.1f} million events per second" for per_s in (decoded, DECODED_PER_S))
    fix = "" if fine else f"{CLOSE}; reduce events with evetac record --readout-rate, --threshold-on, --threshold-off"
    return [*rows, check("camera", "decoding", fine, words, f"{limit}, the highest rate of a camera", fix)]


def _writing(computer: Computer, folder: Path) -> list[Row]:
    try:
        events_per_s, longest_ms = computer.written(folder)
    except (InputError, OSError) as error:
        return [check("disk", "writes", False, " ".join(str(error).split()), "a folder to write in", ELSEWHERE)]
    elsewhere = "record to an internal disk with -o"
    speed, limit = (f"{per_s * 1e-6:.1f} million events per second" for per_s in (events_per_s, WRITTEN_PER_S))
    fine, quick = events_per_s >= WRITTEN_PER_S, longest_ms <= RECORDER_MS
    fix = f"{elsewhere}; {CLOSE}"
    longest = f"the longest of {SEGMENTS} segments takes {longest_ms:.0f} ms"
    return [
        check("disk", "writes", fine, f"{speed} in {folder}", limit, "" if fine else elsewhere),
        check("disk", "segments", quick, longest, f"{RECORDER_MS:.0f} ms", "" if quick else fix),
    ]
