"""A trial with devices, from the first checks to the final message: the code shared by `record` and real-time `grasp`.

Before a device is touched, it checks that the outputs may be written and fit on the disk, and shows a dry run. While
the trial runs, Ctrl-C ends it between slices. Afterwards the file is joined. An error or Ctrl-C is raised again, with
the saved files attached.
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
PRIORITY = 10  # real-time priority of `record` while a gripper moves
SPEED = "`evetac doctor speed` reports what is too slow"
OVERLOADED = f"is the computer overloaded? {SPEED}; a longer --watchdog-ms gives it more time"
# share of the watchdog's time: detecting a hang, switching torque off and reading it back must fit into that time
FRESH = 0.75
# used if longer: writing a segment may take some tens of ms. Detection and release still fit into 100 ms
RECORDER_MS = 75.0
# limit for a recorder that waits for a core: the detector buffers 64 MB, 5 s at a million events per s
RECORDER_LATE_MS = 5000.0
# code that commands a gripper hangs after this long without a sign of life, or after HANGS_WATCHDOGS watchdog times if
# longer
HANGS_S = 0.5
HANGS_WATCHDOGS = 4
OPENING_S = 2.0  # extra time while it opens the gripper
LOST = "capture/lost/"
# half a minute of joining, which another Ctrl-C ends; larger recordings are left to repair
JOINED_AT_ONCE_EVENTS = 300_000_000
SEGMENT_EVENTS = 50_000  # events that take as long to join as opening a segment does
BYTES_AN_EVENT = 2 * 13  # bytes in its segment and, at worst, again in the joined file
# limit from the end of a slice: a quiet camera's words may take 4 ms, which is not the computer's fault
LATE_US = 5000.0
TOLERATED = 1e-3  # share of slices or commands that may be late before the computer is reported as too slow
BEHIND_S = 0.5  # how far a recorder may lag behind: a segment on a busy disk takes that long now and then
QUEUE_LOST = "capture/lost/camera.events_in_full_queue"
MEDIAN, P99 = 0, 1  # places in a `spread`
MOST_TIMES = 1 << 20  # number of times kept, 8 MB; of longer recordings every second, every fourth, ... is kept


def refuse_taken(trial: DeviceTrial, *, again: str, hint: str, force: bool, resume: bool = False) -> None:
    """Raise InputError if an output exists, or an aborted recording waits for repair, before anything moves.

    Checks this trial and, unless the series is resumed, all outputs that existed before the first trial. again: what
    cannot be repeated.
    """
    for output in trial.outputs:
        if output.exists() and not force:
            raise InputError(f"the output exists, and {again} cannot be repeated", where=str(output), hint=hint)
        refuse_leftover(output)
    if trial.taken and not (force or resume):
        raise InputError(
            "this trial was not started, because others of the series exist already",
            where=str(trial.output),
            found=", ".join(map(str, trial.taken)),
            hint=hint,
        )


def needed_bytes(events_per_s: float, seconds: float, files: int = 1) -> float:
    """Return the bytes that recordings may need on their disk."""
    return events_per_s * seconds * BYTES_AN_EVENT * files


def check_room(trial: DeviceTrial, events_per_s: float, seconds: float, hint: str) -> None:
    """Raise InputError if the disk has no room for a trial with this event rate; hint: how to need less."""
    require_room(trial.output.parent, needed_bytes(events_per_s, seconds, len(trial.outputs)), hint)


def plan_shown(trials: Sequence[Trial], parts: Sequence[tuple[str, str, str]], *, simulated: bool) -> Outcome:
    """Return the outcome of a dry run: its parts as (part, what, detail), and all files."""
    files = [("file", str(output), f"trial {trial.number}") for trial in trials for output in trial.outputs]
    rows = [dict(zip(("part", "what", "detail"), row, strict=True)) for row in (*parts, *files)]
    return Outcome(rows, simulated, {"files": len(files)}, made=False)


def wait_for_object(trial: Trial) -> None:
    """Ask the user to place the object, for the second and any later trial."""
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
    """Return the recipe of a device recording as known beforehand; its content digest replaces the rest.

    setup: identity and settings of the devices. sensor: the recording's datasets; those of the sensor belong to its
    setup. parameters, more: everything else, in the order of the header.
    """
    sensor_values = {name: np.asarray(value).tolist() for name, value in sensor.items() if name.startswith("sensor/")}
    described = {**parameters, "setup": dict(setup), "sensor": without_nan(sensor_values), **more}
    return Recipe(OUTPUT, method, described, parents=parents, simulated_source=simulated)


def without_nan(value: Any) -> Any:
    """Return the value with NaN, which marks a missing dot, replaced by None, because JSON has no NaN."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [without_nan(item) for item in value]
    return None if value != value else value


def spread(values: "array[float]") -> Any:
    """Return median, 99th percentile and maximum."""
    return np.percentile(np.frombuffer(values), [50, 99, 100])


def figure(datasets: Mapping[str, Any], name: str, which: int | None = None) -> float | None:
    """Return a figure of the datasets capture/..., or one of a `spread`, MEDIAN or P99; None if it is not there."""
    found = datasets.get(f"capture/{name}")
    return None if found is None else float(found if which is None else found[which])


class TimeSample:
    """A sample of times (us) of a recording of any length: a bounded number, evenly spread, and the longest time."""

    def __init__(self) -> None:
        self._values = array("d")
        self._most = 0.0
        self._seen = 0
        self._step = 1

    def add(self, time_us: float) -> None:
        """Add one time."""
        self._most = max(self._most, time_us) if self._seen else time_us
        if self._seen % self._step == 0:
            self._values.append(time_us)
            if len(self._values) >= MOST_TIMES:
                self._values = self._values[::2]
                self._step *= 2
        self._seen += 1

    def spread(self) -> Any:
        """Return median, 99th percentile and maximum; None without a time."""
        if not self._values:
            return None
        values = spread(self._values)
        values[2] = self._most
        return values


class LateSlices:
    """Counts slices that are late because of the computer: slices with events, followed by a slice with events.

    A slice that is followed by silence is closed only when the camera would have sent its next data, so its delay is
    normal.
    """

    def __init__(self, most_us: float = LATE_US) -> None:
        """most_us: limit from the end of a slice; a slice that arrives later is late."""
        self.count = 0
        self.most_us = most_us
        self._late = False

    def add(self, late_us: float, events: int) -> None:
        """Add the next slice: its delay from its end, and its number of events."""
        self.count += self._late and events > 0
        self._late = events > 0 and late_us > self.most_us


def too_slow(
    datasets: Mapping[str, Any],
    slices: int,
    late_slices: LateSlices,
    commands: int,
    behind_s: float | None = None,
) -> str | None:
    """Return one line on what this computer was too slow for, and the effect on the recording; None if nothing.

    datasets: capture/...; commands: number of commands sent. behind_s: the longest lag of a grasp's recorder; None if
    no slice decides on a command, so that a late slice costs nothing.
    """
    problems = []
    if (missed := int(datasets.get("capture/command_misses", 0))) > TOLERATED * (commands + missed):
        problems.append(f"{missed:,} of {commands + missed:,} commands were missed (the gripper kept the one before)")
    if late_slices.count > TOLERATED * slices:
        late = f"{late_slices.count:,} of {slices:,} slices arrived more than {late_slices.most_us * 1e-3:g} ms late"
        problems.append(f"{late} ({'all are in the file' if behind_s is None else 'slip was answered late'})")
    if lost := int(datasets.get(QUEUE_LOST, 0)):
        problems.append(f"{lost:,} events were lost in the queue (they are missing from the file)")
    if behind_s is not None and behind_s > BEHIND_S:
        problems.append(f"the recorder lagged {behind_s:.1f} s behind (nothing is missing from the file)")
    return f"this computer was too slow: {'; '.join(problems)}. {SPEED}" if problems else None


def lost_datasets(counts: Mapping[str, int]) -> dict[str, Any]:
    """Return the losses of devices, named DEVICE.REASON, as datasets of a recording."""
    return {LOST + reason: np.int64(count) for reason, count in counts.items()}


def lost_columns(datasets: Mapping[str, Any]) -> dict[str, Any]:
    """Return the losses as columns of the table: the number of events, as far as known, and the reasons.

    None for none.
    """
    counts = {name.removeprefix(LOST): int(count) for name, count in datasets.items() if name.startswith(LOST)}
    return {"lost": losses.events_lost(counts), "lost_why": losses.reasons(counts)}


def finish(writer: RecordingWriter, recipe: Recipe, datasets: Mapping[str, Any], *, ended: str = "") -> Path:
    """Join the segments, with datasets that are known only now; an error names the remaining segments.

    ended: a sentence on why the recording ended. After Ctrl-C, long joining is left to `validate --repair`;
    the segments are complete. Returns the file, or the folder that is left.
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
    """Add the location of what is left for `evetac validate --repair` to an error for the user, or to Ctrl-C.

    Other errors are returned unchanged.
    """
    if not writer.folder.exists():
        return error
    left = place(writer.folder)
    if isinstance(error, EvetacError):
        error.kept = left
    if isinstance(error, KeyboardInterrupt):
        return KeyboardInterrupt(f"interrupted: the recording so far is in {left}")
    return error


def place(saved: Path) -> str:
    """Return the location of a recording for messages: a file, or a folder of segments."""
    return f"{saved}, for `evetac validate --repair`" if saved.suffix == SUFFIX else str(saved)


def raise_end(
    error: Exception | None,
    ended: str,
    saved: str,
    result: Outcome | None,
    torque: str = "",
    *,
    interrupted: bool = False,
) -> None:
    """Raise the error or Ctrl-C that ended the trial, with the saved files and their rows attached.

    error: the failure; ended: why the recording ended; torque: a sentence on its final state. interrupted: Ctrl-C came,
    perhaps after the end. The emergency key and the button of a live view end a series like Ctrl-C: no further trial
    moves the gripper.
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
    """Yield the key that opens the gripper; it is announced if a gripper moves and a user is at a terminal."""
    if not moves:
        yield EmergencyKey(None)
        return
    with emergency_key() as key:
        if key.exists:
            console.say(KEY_HINT)
        yield key
