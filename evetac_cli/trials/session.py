"""A trial with devices, from checks to the final message: what `record` and `grasp` in real time share.

Before a device is touched: whether the outputs may be written and fit on the disk, and what a dry run shows. While it
runs: Ctrl-C ends it between slices. Afterwards: the file is joined, and an error or Ctrl-C goes on with what was saved.
"""

from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli import console
from evetac_cli.devices import losses
from evetac_cli.errors import DeviceError, EvetacError, InputError, attach_outcome
from evetac_cli.jobs import Outcome
from evetac_cli.realtime.emergency_key import KEY_NAME, EmergencyKey, emergency_key
from evetac_cli.store.hdf5.disk import require_room
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.store.recordings.recovery import SUFFIX
from evetac_cli.store.recordings.segments import RecordingWriter, refuse_leftover
from evetac_cli.trials.trial import OUTPUT, DeviceTrial, Trial

INTERRUPTED = "interrupted"
OPENED = "opened by the emergency key"
LET_GO = "let go by the button of the live view"
STOPPED = "stopped by the robot's program"
ABORTED = "aborted by the robot's program"
KEY_HINT = f"{KEY_NAME} opens the gripper for half a second, at 100 mA or less, then torque is off; Ctrl-C: torque off"
PRIORITY = 10  # of `record` while a gripper moves
SPEED = "`evetac doctor --speed` says what is too slow"
OVERLOADED = f"is the computer overloaded? {SPEED}; a longer --watchdog-ms gives it more time"
FRESH = 0.75  # of the watchdog's time: so noticing a hang, switching torque off and reading it back fit into that time
RECORDER_MS = 75.0  # or, if longer, that: writing a segment may take some tens of ms, and all of it fits into 100 ms
RECORDER_LATE_MS = 5000.0  # for one that waits for a core: the detector keeps 64 MB, 5 s of a million events per s
LOST = "capture/lost/"
JOINED_AT_ONCE_EVENTS = 300_000_000  # half a minute of joining, which another Ctrl-C ends; more is left to repair
SEGMENT_EVENTS = 50_000  # that take as long to join as opening a segment does
BYTES_AN_EVENT = 2 * 13  # in its segment and, at worst, again in the joined file
LATE_US = 5000.0  # from the end of a slice: a quiet camera's words may take 4 ms, and are no fault of the computer
TOLERATED = 1e-3  # of slices and of commands may be late before it is said that the computer was too slow
BEHIND_S = 0.5  # that a recorder may lag behind: a segment of a busy disk takes that long now and then
QUEUE_LOST = "capture/lost/camera.events_in_full_queue"
MOST_TIMES = 1 << 20  # that are kept, 8 MB; of longer recordings every second one, every fourth, ...


def refuse_taken(trial: DeviceTrial, *, again: str, hint: str, force: bool, resume: bool = False) -> None:
    """InputError where an output exists, or what broke off waits for repair: nothing moves for what is refused.

    Of this trial, or, unless the series goes on, of any before the first. again: what cannot be made again.
    """
    for output in trial.outputs:
        if output.exists() and not force:
            raise InputError(f"the output exists, and {again} cannot be made again", where=str(output), hint=hint)
        refuse_leftover(output)
    if trial.taken and not (force or resume):
        raise InputError(
            "this trial was not started, because others of the series exist already",
            where=str(trial.output),
            found=", ".join(map(str, trial.taken)),
            hint=hint,
        )


def needed_bytes(events_per_s: float, seconds: float, files: int = 1) -> float:
    """Room that recordings may need on their disk."""
    return events_per_s * seconds * BYTES_AN_EVENT * files


def check_room(trial: DeviceTrial, events_per_s: float, seconds: float, hint: str) -> None:
    """InputError where the disk has no room for a trial of so many events a second; hint: what would need less."""
    require_room(trial.output.parent, needed_bytes(events_per_s, seconds, len(trial.outputs)), hint)


def plan_shown(trials: Sequence[Trial], parts: Sequence[tuple[str, str, str]], *, simulated: bool) -> Outcome:
    """What a dry run shows: its parts as (part, what, detail), and all files."""
    files = [("file", str(output), f"trial {trial.number}") for trial in trials for output in trial.outputs]
    rows = [dict(zip(("part", "what", "detail"), row, strict=True)) for row in (*parts, *files)]
    return Outcome(rows, simulated, {"files": len(files)}, made=False)


def wait_for_object(trial: Trial) -> None:
    """Ask for the object of the second and any later trial to be put in place."""
    if trial.number:
        console.wait_for_enter(f"trial {trial.number}: put the object in place, then press Enter")


def make_recipe(
    method: int,
    parameters: Mapping[str, Any],
    setup: Mapping[str, Any],
    sensor: Mapping[str, Any],
    more: Mapping[str, Any],
    *,
    parents: tuple[Header, ...],
    simulated: bool,
) -> Recipe:
    """What is known of a recording from devices beforehand; its content stands in for the rest.

    setup: what the devices are and how they are set; sensor: the recording's datasets, of which those of the sensor
    belong to its set-up; parameters, more: all else, in the order of the header.
    """
    known = {name: np.asarray(value).tolist() for name, value in sensor.items() if name.startswith("sensor/")}
    described = {**parameters, "setup": dict(setup), "sensor": without_nan(known), **more}
    return Recipe(OUTPUT, method, described, parents=parents, simulated_source=simulated)


def without_nan(value: Any) -> Any:
    """JSON has no NaN, which stands for a missing dot."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [without_nan(item) for item in value]
    return None if value != value else value


def spread(values: "array[float]") -> Any:
    """Median, 99th percentile and most."""
    return np.percentile(np.frombuffer(values), [50, 99, 100])


class TimeSample:
    """Times of a recording of any length, in us: a bounded number of them, evenly spread over it, and the longest."""

    def __init__(self) -> None:
        self._values = array("d")
        self._most = 0.0
        self._seen = 0
        self._step = 1

    def add(self, time_us: float) -> None:
        """Take one time."""
        self._most = max(self._most, time_us) if self._seen else time_us
        if self._seen % self._step == 0:
            self._values.append(time_us)
            if len(self._values) >= MOST_TIMES:
                self._values = self._values[::2]
                self._step *= 2
        self._seen += 1

    def spread(self) -> Any:
        """Median, 99th percentile and most; None without a time."""
        if not self._values:
            return None
        values = spread(self._values)
        values[2] = self._most
        return values


class LateSlices:
    """Counts slices that are late by the computer's fault: with events, and more of them in the slice after it.

    Why so: a slice that is followed by silence is over only when the camera would have spoken.
    """

    def __init__(self, most_us: float = LATE_US) -> None:
        """most_us: from the end of a slice; what comes later is late."""
        self.count = 0
        self.most_us = most_us
        self._late = False

    def add(self, late_us: float, events: int) -> None:
        """Take the next slice: how late it was, from its end, and how many events it has."""
        self.count += self._late and events > 0
        self._late = events > 0 and late_us > self.most_us


def too_slow(
    datasets: Mapping[str, Any],
    slices: int,
    late_slices: LateSlices,
    commands: int,
    behind_s: float | None = None,
    used: str = "",
) -> str | None:
    """What this computer was too slow for, and what that means for the recording, in one line; None for nothing.

    datasets: capture/...; commands: that were given; behind_s: how far behind the recorder of a grasp was at most; None
    where no slice decides on a command, and one that is late costs nothing; used: who used its cores, in words.
    """
    missed, lost = int(datasets.get("capture/command_misses", 0)), int(datasets.get(QUEUE_LOST, 0))
    late = f"{late_slices.count:,} of {slices:,} slices came more than {late_slices.most_us * 1e-3:g} ms late"
    parts = {
        f"{missed:,} of {commands + missed:,} commands were missed (the gripper kept the one before)": missed
        > TOLERATED * (commands + missed),
        f"{late} ({'they are all in the file' if behind_s is None else 'slip was answered late'})": late_slices.count
        > TOLERATED * slices,
        f"{lost:,} events were lost while they waited (they are missing in the file)": lost > 0,
        f"the recorder was {behind_s or 0.0:.1f} s behind (all is in the file)": (behind_s or 0.0) > BEHIND_S,
    }
    said = [words for words, applies in parts.items() if applies]
    return f"this computer was too slow: {'; '.join([*said, *([used] if used else [])])}. {SPEED}" if said else None


def lost_datasets(counts: Mapping[str, int]) -> dict[str, Any]:
    """What devices lost, by DEVICE.REASON, as datasets of a recording."""
    return {LOST + reason: np.int64(count) for reason, count in counts.items()}


def lost_columns(datasets: Mapping[str, Any]) -> dict[str, Any]:
    """What was lost, as columns of the table: how many events, as far as that is known, and why; None for nothing."""
    counts = {name.removeprefix(LOST): int(count) for name, count in datasets.items() if name.startswith(LOST)}
    return {"lost": losses.events_lost(counts), "lost_why": losses.reasons(counts)}


def finish(writer: RecordingWriter, recipe: Recipe, datasets: Mapping[str, Any], *, ended: str = "") -> Path:
    """Join the segments, with datasets that are known only now; whatever keeps it from that says where they are.

    ended: why the recording ended, in words. After Ctrl-C nobody waits for minutes: what is that long is left to
    `evetac repair`, complete. Returns the file, or the folder that is left.
    """
    size = writer.events + SEGMENT_EVENTS * writer.segments
    try:
        if ended == INTERRUPTED and size > JOINED_AT_ONCE_EVENTS:
            writer.leave_complete(datasets)
            return writer.folder
        writer.finish(recipe, datasets)
        return writer.path
    except BaseException as error:
        writer.leave()
        raise with_hint(error, writer) from None


def with_hint(error: BaseException, writer: RecordingWriter) -> BaseException:
    """An error for the user, or Ctrl-C, that says too what is left for `evetac repair`; any other as it is."""
    if not writer.folder.exists():
        return error
    left = place(writer.folder)
    if isinstance(error, EvetacError):
        error.kept = left
    if isinstance(error, KeyboardInterrupt):
        return KeyboardInterrupt(f"interrupted: what was recorded is in {left}")
    return error


def place(saved: Path) -> str:
    """Where a recording is, in words: a file, or a folder of segments."""
    return f"{saved}, for `evetac repair`" if saved.suffix == SUFFIX else str(saved)


def raise_end(
    error: Exception | None,
    ended: str,
    saved: str,
    result: Outcome | None,
    torque: str = "",
    *,
    interrupted: bool = False,
) -> None:
    """Let what ended the trial go on from here, with what was saved and the rows of its files.

    error: what failed; ended: why the recording ended, in words; torque: what it was left with, in words; interrupted:
    Ctrl-C came, maybe after it had ended. The emergency key and the button of a live view end a series as Ctrl-C does:
    no further trial moves the gripper.
    """
    then = f"; {torque}" if torque else ""
    if error is not None:
        failed = error if isinstance(error, EvetacError) else DeviceError(str(error))
        if "torque" not in str(failed):
            failed.message += then
        failed.kept = saved
        raise attach_outcome(failed, result)
    if interrupted or ended in (INTERRUPTED, OPENED, LET_GO):
        raise attach_outcome(KeyboardInterrupt(f"{ended}{then}: {saved}"), result)


@contextmanager
def gripper_key(*, moves: bool) -> Iterator[EmergencyKey]:
    """The key that opens the gripper, announced, where one is moved and somebody is at a terminal to press it."""
    if not moves:
        yield EmergencyKey(None)
        return
    with emergency_key() as key:
        if key.exists:
            console.say(KEY_HINT)
        yield key
