"""Recording from devices: whatever ends it, what was recorded until then is kept.

The camera gives the pace: its slices are written as they come. A gripper is commanded by a thread of its own
(stages/record/current_ramp.py). The end of the time, Ctrl-C, a gripper that has let go and a device that fails all end with a
valid file, which says why it ended, what was lost and how well time was kept. A full disk and a kill leave a NAME.part/
for `evetac repair`.

Several cameras of one trial fill a file each; these share a trajectory id and say how their clocks lie to each other.
The first camera leads: it gives the number of slices, and its file has the gripper.
"""

import signal
import sys
import threading
import time
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from evetac_cli import console
from evetac_cli.devices import GripperReading, Rig
from evetac_cli.devices.naming import GripperName, open_rig
from evetac_cli.errors import DeviceError, EvetacError, attach_outcome
from evetac_cli.events import SLICE_US, Events
from evetac_cli.jobs import Job, Outcome, Progress, outcome
from evetac_cli.params import Record
from evetac_cli.stages.record.camera_thread import SliceThread
from evetac_cli.stages.record.capture_plan import asked_ma, check, hold_of, is_there, names, settings
from evetac_cli.stages.record.capture_series import check_series, header_of, recipe_of
from evetac_cli.stages.record.current_ramp import GripperLoop, Hold, start, step
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.provenance import Recipe
from evetac_cli.store.segments import RecordingWriter

INTERRUPTED = "interrupted"
LOST = "capture/lost/"
SWITCH_S = 5e-4  # the interpreter's threads take turns so often: a command waits no longer for the camera's thread


@dataclass
class Captured:
    """What a recording amounts to."""

    slices: int = 0
    events: int = 0
    ended: str = ""
    error: Exception | None = None
    began_s: float = 0.0
    last_s: float = 0.0
    late_us: "array[float]" = field(default_factory=lambda: array("d"))
    loop: GripperLoop | None = None

    def keep(self, events: Events, came_s: float, camera: Any) -> None:
        """Count one slice."""
        self.began_s = self.began_s or came_s
        self.last_s = came_s
        self.slices += 1
        self.events += events.size
        if hasattr(camera, "host_us"):
            self.late_us.append(came_s * 1e6 - camera.host_us(self.slices * SLICE_US))

    def figures(self, rig: Rig) -> dict[str, Any]:
        """The datasets capture/... of the recording."""
        passed_s = self.last_s - self.began_s
        rows: dict[str, Any] = {"capture/ended": self.ended}
        if passed_s > 0:
            rows["capture/slices_per_s"] = np.float64((self.slices - 1) / passed_s)
        rows |= {LOST + name: np.int64(count) for name, count in rig.counted().items()}
        if self.late_us:
            rows["capture/slice_late_us"] = spread(self.late_us)
        if self.loop is not None and self.loop.commands:
            if passed_s > 0:
                rows["capture/commands_per_s"] = np.float64(self.loop.commands / passed_s)
            rows["capture/command_misses"] = np.int64(self.loop.misses)
            rows["capture/command_us"] = spread(self.loop.cycle_us)
        return rows


def spread(values: "array[float]") -> Any:
    """Median, 99th percentile and most."""
    return np.percentile(np.frombuffer(values), [50, 99, 100])


@dataclass
class Taking:
    """One camera of a trial, and the file that it fills."""

    output: Path
    rig: Rig
    recipe: Recipe
    writer: RecordingWriter
    captured: Captured = field(default_factory=Captured)
    beside: SliceThread | None = None  # reads the camera, if it is not the first

    def keep(self, events: Events, came_s: float) -> None:
        """Write one slice."""
        self.captured.keep(events, came_s, self.rig.camera)
        self.writer.append(events)

    def figures(self, first: Rig) -> dict[str, Any]:
        """The datasets capture/...; how the clock of this camera lies to that of the first, if it is another."""
        told = self.captured.figures(self.rig)
        clocks = [getattr(rig.camera, "host_us", None) for rig in (self.rig, first)]
        if self.rig is not first and all(clocks):
            ours_us, theirs_us = (clock(0) for clock in clocks if clock)
            told["capture/clock_offset_us"] = np.float64(ours_us - theirs_us)
        return told


def run(job: Job, params: Record, seeds: np.random.SeedSequence, *, force: bool = False, progress: Progress) -> Outcome:
    """Record one trial from devices."""
    cameras, gripper = names(params)
    outputs: tuple[Path, ...] = job.choice["outputs"]
    if is_there(job, params, force=force):
        rows = [row for output in outputs for row in _kept(job._replace(output=output)).rows]
        return Outcome(rows, header_of(outputs[0])["simulated"], made=False)
    check(job, params, force=force)
    rng = np.random.default_rng(seeds.spawn(1)[0])
    if job.choice["trial"] and params.camera.startswith("dv") and not params.resume:
        console.wait_for_enter(f"trial {job.choice['trial']}: put the object in place, then press Enter")
    with ExitStack() as opened:
        takings: list[Taking] = []
        opened.push(lambda kind, error, trace: _let_go(takings, failed=error is not None))
        trajectory = {"trajectory": uuid4().hex} if len(cameras) > 1 else {}
        for at, camera in enumerate(cameras):
            hand = GripperName("none") if at else gripper
            rig = open_rig(camera, hand, settings(params), job.choice.get("plan"), seeds)
            opened.callback(rig.close)
            for note in getattr(rig.camera, "notes", ()):
                console.say(note)
            takings.append(_taking(job, params, rig, at, trajectory))
        with signals_counted() as came:
            _write(takings, _hold(job, params, takings[0].rig), rng, params, came, progress)
            figures = [taking.figures(takings[0].rig) for taking in takings]
            _release(takings)
            _finish(takings, figures)
    return _tell(job, takings, figures)


def _kept(job: Job) -> Outcome:
    return outcome(job, made=False, simulated=header_of(job.output)["simulated"])


def _taking(job: Job, params: Record, rig: Rig, at: int, trajectory: Mapping[str, Any]) -> Taking:
    """What the camera number `at` of a trial needs to be recorded."""
    output = job.choice["outputs"][at]
    sensor = {**rig.sensor_known(), "t_offset": np.int64(0)}
    if params.calibration is not None:
        width, height = sensor["sensor/frame_px"]
        sensor |= read_calibration(params.calibration, (int(width), int(height))).arrays()
    asked = asked_ma(params, "plan" in job.choice)
    recipe = recipe_of(job, params, rig, _hold(job, params, rig), asked, sensor, trajectory)
    if params.resume:
        check_series((outputs[at] for outputs in job.choice["series"]), recipe)
    return Taking(output, rig, recipe, RecordingWriter(output, sensor, discard_leftover=False, recipe=recipe))


def _let_go(takings: Sequence[Taking], *, failed: bool) -> None:
    """Where nothing was recorded before something failed, nothing is left."""
    for taking in takings:
        if failed and taking.captured.slices == 0:
            taking.writer.discard()


def _release(takings: Sequence[Taking]) -> None:
    """Let go of all devices before the files are joined, which may take a while: torque must not wait for it."""
    for taking in takings:
        try:
            taking.rig.close()
        except DeviceError as error:
            takings[0].captured.error = takings[0].captured.error or error


def _finish(takings: Sequence[Taking], figures: Sequence[Mapping[str, Any]]) -> None:
    """Join every file, also where another cannot be."""
    errors: list[EvetacError] = []
    for taking, told in zip(takings, figures, strict=True):
        if taking.captured.slices == 0:
            taking.writer.discard()
            continue
        try:
            finish(taking.writer, taking.recipe, told)
        except EvetacError as error:
            errors.append(error)
    if errors:
        raise errors[0]


def _hold(job: Job, params: Record, rig: Rig) -> Hold | None:
    return None if rig.gripper is None else hold_of(params, rig.holding_ma if "plan" in job.choice else None)


@contextmanager
def signals_counted() -> Iterator[list[int]]:
    """Ctrl-C and SIGTERM are counted at first, so that a recording ends between slices; a second one breaks off."""
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield came
        return

    def count(number: int, frame: Any) -> None:
        came.append(number)
        if len(came) > 1:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, count) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _write(
    takings: Sequence[Taking],
    hold: Hold | None,
    rng: np.random.Generator,
    params: Record,
    came: list[int],
    progress: Progress,
) -> None:
    """Follow the cameras until something ends the recording; a device that failed is in the result."""
    first = takings[0]
    if first.rig.gripper is not None and hold is not None:
        state, law = start(hold), hold

        def act(reading: GripperReading) -> tuple[float, str]:
            target_ma = step(state, law, reading, rng)
            return target_ma, state.ended

        first.captured.loop = GripperLoop(first.rig.gripper, act, first.rig.clock.now_us)
    for taking in takings[1:]:
        taking.beside = SliceThread(taking.rig.camera)
    most = round(1000 * params.seconds) if params.seconds is not None else None
    interval = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        _follow(takings, most, came, progress)
    except DeviceError as error:
        first.captured.error = error
        first.captured.ended = str(error).splitlines()[0]
    except BaseException as error:
        if first.captured.slices == 0:
            raise
        for taking in takings:
            with suppress(EvetacError):  # of a full disk, which is the error already
                taking.writer.close_segment()
            taking.writer.leave()
        raise with_hint(error, first.writer) from None
    finally:
        sys.setswitchinterval(interval)
        if first.captured.loop is not None:
            first.captured.loop.stop()
        for taking in takings[1:]:
            if taking.beside is not None:
                taking.beside.stop()
    _fetch(takings)
    for taking in takings[1:]:
        taking.captured.ended = first.captured.ended


def _follow(takings: Sequence[Taking], most: int | None, came: list[int], progress: Progress) -> None:
    first = takings[0]
    captured, loop = first.captured, first.captured.loop
    for taking in takings[1:]:
        assert taking.beside is not None
        taking.beside.start()
    while captured.slices != most:
        events = first.rig.camera.read()
        if events is None:
            captured.ended = "the camera's stream ended"
            return
        if captured.slices == 0 and loop is not None:
            loop.start()
        _fetch(takings)
        first.keep(events, time.monotonic())
        failed = [part.error for part in (loop, *(taking.beside for taking in takings)) if part and part.error]
        if failed:
            raise failed[0]
        if loop is not None and loop.ended:
            captured.ended = loop.ended
            return
        if came:
            captured.ended = INTERRUPTED
            return
        if captured.slices % 100 == 0:
            progress(captured.slices, most or captured.slices)
    captured.ended = "after the seconds asked for"


def _fetch(takings: Sequence[Taking]) -> None:
    """Write what came beside the slices of the first camera: commands, and slices of the others."""
    first = takings[0]
    if first.captured.loop is not None:
        for row in first.captured.loop.rows():
            first.writer.append_rows(row)
    for taking in takings[1:]:
        if taking.beside is not None:
            for events, came_s in taking.beside.take():
                taking.keep(events, came_s)


def finish(writer: RecordingWriter, recipe: Recipe, figures: Mapping[str, Any]) -> None:
    """Join the segments; whatever keeps it from that says where they are."""
    try:
        writer.finish(recipe, figures, from_device=True)
    except BaseException as error:
        writer.leave()
        raise with_hint(error, writer) from None


def with_hint(error: BaseException, writer: RecordingWriter) -> BaseException:
    """An error for the user, or Ctrl-C, that says too what is left for `evetac repair`; any other as it is."""
    kept = f"{writer.folder}, for `evetac repair`"
    if isinstance(error, EvetacError):
        error.kept = kept
    if isinstance(error, KeyboardInterrupt):
        return KeyboardInterrupt(f"interrupted: what was recorded is in {kept}")
    return error


def _tell(job: Job, takings: Sequence[Taking], figures: Sequence[Mapping[str, Any]]) -> Outcome:
    """A row for each file; an error or Ctrl-C goes on from here, and says what there is."""
    captured = takings[0].captured
    files = [f"{taking.captured.slices:,} slices in {taking.output}" for taking in takings if taking.captured.slices]
    kept = ", ".join(files) or "nothing was recorded"
    there = [told for told in zip(takings, figures, strict=True) if told[0].captured.slices]
    result = Outcome([_row(job, *told) for told in there], any(taking.recipe.simulated for taking in takings))
    if captured.error is not None:
        error = captured.error if isinstance(captured.error, EvetacError) else DeviceError(str(captured.error))
        error.kept = kept
        raise attach_outcome(error, result)
    if captured.ended == INTERRUPTED:
        raise attach_outcome(KeyboardInterrupt(f"interrupted: {kept}"), result)
    return result


def _row(job: Job, taking: Taking, figures: Mapping[str, Any]) -> dict[str, Any]:
    captured = taking.captured
    lost = {name.removeprefix(LOST): int(count) for name, count in figures.items() if name.startswith(LOST) and count}
    none = (None, None, None)
    late_us, command_us = (figures.get(f"capture/{name}", none) for name in ("slice_late_us", "command_us"))
    (row,) = outcome(
        job._replace(output=taking.output),
        made=True,
        simulated=taking.recipe.simulated,
        slices=captured.slices,
        events=captured.events,
        ended=captured.ended,
        slices_per_s=_plain(figures.get("capture/slices_per_s")),
        slice_late_us_p99=_plain(late_us[1]),
        lost="; ".join(f"{name} {count}" for name, count in lost.items()) or None,
        commands=captured.loop.commands if captured.loop is not None else None,
        command_misses=captured.loop.misses if captured.loop is not None else None,
        command_us_median=_plain(command_us[0]),
    ).rows
    return row


def _plain(value: Any) -> float | None:
    return None if value is None else float(value)
