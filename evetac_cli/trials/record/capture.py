"""Recording from devices: however it ends, the data recorded until then are saved.

The camera sets the pace: its slices are written as they arrive. A thread of its own commands the gripper
(current_ramp.py). When the time is over, Ctrl-C is pressed, the gripper has released the object, or a device fails, the
result is a valid file. The file states why it ended, what was lost and how well time was kept. A full disk or a kill
leaves a NAME.part/ for `evetac validate --repair`.

Several cameras of one trial fill one file each. These share a trajectory id and store the offset between their clocks.
The first camera leads: it determines the number of slices, and its file has the gripper.
"""

import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np

from evetac_cli import console, interrupts
from evetac_cli.devices import GripperReading, Rig
from evetac_cli.devices.grippers import NoGripper
from evetac_cli.devices.losses import LossNews
from evetac_cli.devices.opening import open_rig
from evetac_cli.errors import DeviceError, EvetacError, InputError
from evetac_cli.events import SLICES_PER_S
from evetac_cli.jobs import Job, Outcome, Progress, outcome
from evetac_cli.names import Capability
from evetac_cli.realtime.emergency_key import EmergencyKey
from evetac_cli.realtime.processes import raised_priority
from evetac_cli.store.files import header_of
from evetac_cli.store.layout.provenance import Recipe, first_difference
from evetac_cli.store.recordings.segments import RecordingWriter
from evetac_cli.trials import live_view, session
from evetac_cli.trials.live_view import LiveView
from evetac_cli.trials.record.camera_recording import CameraRecording, SliceThread
from evetac_cli.trials.record.capture_plan import NAME_TAKEN, TAKEN, DeviceRecording, check, is_done
from evetac_cli.trials.record.current_ramp import GripperLoop, Hold, HoldState, step
from evetac_cli.trials.session import ABORTED, INTERRUPTED, LET_GO
from evetac_cli.trials.trial import OUTPUT

if TYPE_CHECKING:
    from evetac_cli.trials.listen.trial_requests import TrialRequests

NEWS_SLICES = 100  # number of slices after which losses are checked and reported
METHOD = 1  # method version of recordings from devices
# how often the interpreter's threads take turns: a command waits no longer than this for the camera's thread
SWITCH_S = 5e-4
OWN_PARAMETERS = (  # parameters that may differ between trials of a series
    *("trial", "trajectory", "object", "object_row", "sensor_row"),
    *("sampled_holding_ma", "sampled_fall_factor"),
)


def run(trial: DeviceRecording, *, force: bool, progress: Progress, requests: "TrialRequests | None" = None) -> Outcome:
    """Record one trial from devices. requests: a robot's program started it, and may mark and end it."""
    if is_done(trial, force=force):
        return _earlier(trial)
    check(trial, force=force, taken=TAKEN if requests is None else NAME_TAKEN)
    seeds = trial.seeds()
    rng = np.random.default_rng(seeds.spawn(1)[0])
    if requests is None and (trial.cameras[0].has(Capability.HARDWARE) or trial.gripper.has(Capability.HARDWARE)):
        session.wait_for_object(trial)
    with ExitStack() as opened, ExitStack() as priority:
        received = opened.enter_context(interrupts.signals_interrupt())
        name = f"record {trial.output.name}"
        view = opened.enter_context(live_view.opened(trial, name, moves=trial.hold is not None))
        # The gripper only holds while all threads are on time, including the camera's, which share the interpreter.
        needs_priority = trial.gripper.has(Capability.HARDWARE) and not any(
            camera.has(Capability.SCENE) for camera in trial.cameras
        )
        priority.enter_context(raised_priority(session.PRIORITY, wanted=needs_priority))
        recordings: list[CameraRecording] = []
        opened.push(lambda kind, error, trace: _discard_empty(recordings, failed=error is not None))
        trajectory = {"trajectory": uuid4().hex} if len(trial.cameras) > 1 else {}
        for place, camera in enumerate(trial.cameras):
            gripper = NoGripper() if place else trial.gripper
            rig = open_rig(camera, gripper, trial.settings, trial.plan, seeds, armed=trial.armed)
            opened.callback(rig.close)
            for note in rig.camera.notes:
                console.say(note)
            recordings.append(_begin(trial, rig, place, trajectory, None if place else view))
        moves = recordings[0].rig.gripper is not None
        with interrupts.signals_counted(received) as signals, session.gripper_key(moves=moves) as key:
            if requests is not None:
                opened.callback(requests.record_signals, signals)
                if moves and requests.end_reason:
                    with interrupts.signals_held():
                        _release(recordings)
                    return _thrown_away(recordings)
            capture = _Capture(recordings, signals, progress, view, requests)
            capture.write(_hold(trial, recordings[0].rig), rng, trial.seconds, key)
            datasets = [recording.datasets(recordings[0].rig) for recording in recordings]
            with interrupts.signals_held():
                _release(recordings)
            if view is not None:
                view.end(recordings[0].ended)
            priority.close()
            if recordings[0].ended == ABORTED:
                return _thrown_away(recordings)
            signals.append(0)  # from here a single Ctrl-C aborts: the devices are released, and the segments stay
            _finish(recordings, datasets)
    return _result(trial, recordings, datasets, interrupted=any(signals))


def _thrown_away(recordings: Sequence[CameraRecording]) -> Outcome:
    """Discard the recording; an error from the release of the devices is raised."""
    for recording in recordings:
        recording.writer.discard()
    if recordings[0].error is not None:
        raise recordings[0].error
    return Outcome([], any(recording.recipe.simulated for recording in recordings), made=False)


def _earlier(trial: DeviceRecording) -> Outcome:
    """Return the rows of a trial that was recorded before."""
    simulated = [bool(header_of(output, OUTPUT)["simulated"]) for output in trial.outputs]
    made = [
        outcome(Job(trial.inputs, output), made=False, simulated=each)
        for output, each in zip(trial.outputs, simulated, strict=True)
    ]
    return Outcome([row for each in made for row in each.rows], simulated[0], made=False)


def _begin(
    trial: DeviceRecording,
    rig: Rig,
    place: int,
    trajectory: Mapping[str, Any],
    view: LiveView | None,
) -> CameraRecording:
    """Begin the file of the camera with this index in a trial."""
    output = trial.outputs[place]
    sensor = {"t_offset": np.int64(0), **rig.known_sensor()}
    if trial.calibrations:
        trial.calibrations[place].require_frame(sensor["sensor/frame_px"], str(trial.cameras[place]))
        sensor |= trial.calibrations[place].recorded()
    if view is not None:
        view.begin(sensor)
    hold = _hold(trial, rig)
    asked_ma = None if trial.hold is None else trial.hold.holding_ma
    # A current that every trial draws belongs to the trial, not to the setup of the series.
    sampled = {} if hold is None or asked_ma is not None else {"sampled_holding_ma": hold.holding_ma}
    if hold is not None and hold.fall_factor != 1.0:
        sampled["sampled_fall_factor"] = hold.fall_factor
    recipe = session.make_recipe(
        METHOD,
        {**({} if trial.plan is None else trial.plan.parameters()), **trajectory, "trial": trial.number},
        rig.setup,
        sensor,
        {
            "current_ramp": None if hold is None else _set_up(hold, asked_ma),
            **sampled,
            "current_ramp_seed": trial.seed,
        },
        parents=rig.parents,
        simulated=rig.simulated,
    )
    if trial.resume:
        check_series((outputs[place] for outputs in trial.series), recipe)
    return CameraRecording(output, rig, recipe, RecordingWriter(output, sensor, recipe=recipe))


def _set_up(hold: Hold, asked_ma: float | None) -> dict[str, Any]:
    """Return the gripper's commands for the recipe: the course of its current if it follows one, or the ramp."""
    if hold.course is not None:
        return {"course": asdict(hold.course)}
    ramp = {**asdict(hold), "holding_ma": asked_ma}
    del ramp["course"], ramp["fall_factor"]
    return ramp


def check_series(others: Iterable[Path], recipe: Recipe) -> None:
    """Refuse to resume a series, the files of one camera, that was begun with another setup."""
    for other in others:
        if not other.exists():
            continue
        header = header_of(other, OUTPUT)
        own = {name: header["parameters"].get(name) for name in OWN_PARAMETERS}
        wanted = {**recipe.parameters, **{name: value for name, value in own.items() if name in recipe.parameters}}
        now = Recipe(OUTPUT, METHOD, wanted, header["seed"], recipe.parents, header["content"], recipe.simulated_source)
        if now.id != header["id"]:
            raise InputError(
                "the series was begun with a different setup",
                where=str(other),
                found=first_difference(now, header),
                hint="restore the setup, or start a new series with -o",
            )


def _discard_empty(recordings: Sequence[CameraRecording], *, failed: bool) -> None:
    """Discard the files if something failed before anything was recorded."""
    for recording in recordings:
        if failed and recording.slices == 0:
            recording.writer.discard()


def _release(recordings: Sequence[CameraRecording]) -> None:
    """Release all devices before the files are joined, which may take a while: torque must not wait for it."""
    for recording in recordings:
        try:
            recording.rig.close()
        except DeviceError as error:
            recordings[0].error = recordings[0].error or error


def _finish(recordings: Sequence[CameraRecording], datasets: Sequence[Mapping[str, Any]]) -> None:
    """Join every file, even if another cannot be joined."""
    errors: list[EvetacError] = []
    for recording, late in zip(recordings, datasets, strict=True):
        if recording.slices == 0:
            recording.writer.discard()
            continue
        try:
            recording.saved = session.finish(recording.writer, recording.recipe, late, ended=recording.ended)
        except EvetacError as error:
            errors.append(error)
    if errors:
        raise errors[0]


def _hold(trial: DeviceRecording, rig: Rig) -> Hold | None:
    """Return how the object is handled; None without a gripper, for example for a second camera."""
    return None if rig.gripper is None or trial.hold is None else trial.hold.of_trial(rig.holding_ma, rig.fall_factor)


@dataclass
class _Capture:
    """The recordings of a trial while they are made; signals: grows when Ctrl-C is pressed."""

    recordings: Sequence[CameraRecording]
    signals: Sequence[int]
    progress: Progress
    view: LiveView | None
    requests: "TrialRequests | None"

    def write(self, hold: Hold | None, rng: np.random.Generator, seconds: float | None, key: EmergencyKey) -> None:
        """Follow the cameras until something ends the recording; a device failure is stored in the result."""
        first, *others = self.recordings
        if first.rig.gripper is not None and hold is not None:
            state, law = HoldState(), hold

            def act(reading: GripperReading) -> tuple[float, str]:
                target_ma = step(state, law, reading, rng)
                return target_ma, state.ended

            camera, watchdog_ms = first.rig.camera, first.rig.watchdog_ms
            first.loop = GripperLoop(first.rig.gripper, act, camera.now_us, camera.time, watchdog_ms, key)
        for recording in others:
            recording.thread = SliceThread(recording.rig.camera)
        interval = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        try:
            self._follow(None if seconds is None else round(SLICES_PER_S * seconds))
        except DeviceError as error:
            first.error = error
            first.ended = str(error).splitlines()[0]
        except BaseException as error:
            if first.slices == 0:
                raise
            for recording in self.recordings:
                with suppress(EvetacError):  # on a full disk, which is the error already
                    recording.writer.close_segment()
                recording.writer.leave()
            raise session.with_hint(error, first.writer) from None
        finally:
            sys.setswitchinterval(interval)
            for part in (first.loop, *(each.thread for each in others)):
                if part is not None:
                    part.stop()
        self._fetch(last=True)
        for recording in others:
            recording.ended = first.ended

    def _follow(self, most: int | None) -> None:
        """Read and write slices until something ends the recording, and store the reason; a failure is raised."""
        first, view = self.recordings[0], self.view
        camera, loop = first.rig.camera, first.loop
        news = [LossNews() for _ in self.recordings]
        for recording in self.recordings[1:]:
            assert recording.thread is not None
            recording.thread.start()
        while first.slices != most:
            events = camera.read()
            if events is None:
                first.ended = "the camera's stream ended"
                return
            if first.slices == 0 and loop is not None:
                loop.start()
            self._fetch()
            first.append(events, camera.time.now_s())
            if view is not None:
                view.add_slice(events, first.late_us)
            failed = [part.error for part in (loop, *(each.thread for each in self.recordings)) if part and part.error]
            if failed:
                raise failed[0]
            if self.requests is not None:
                first.ended = self.requests.recorded(first.slices, camera.time.now_s, camera.host_us(0.0))
            if loop is not None and not first.ended:
                first.ended = loop.ended
            if self.signals and not first.ended:
                first.ended = INTERRUPTED
            if view is not None and view.is_asked_to_let_go and not first.ended:
                first.ended = LET_GO
            if first.ended:
                return
            if first.slices % NEWS_SLICES == 0:
                self.progress(first.slices, most or 0)
                self._tell(news)
        first.ended = "after the seconds asked for"

    def _tell(self, news: Sequence[LossNews]) -> None:
        """Report new losses; for several cameras with the name of the file."""
        if self.view is not None:
            self.view.lost(self.recordings[0].rig.counted())
        say = console.say if self.view is None else self.view.say
        for recording, each in zip(self.recordings, news, strict=True):
            for sentence in each.of(recording.rig.counted(), time.monotonic()):
                say(sentence if len(self.recordings) == 1 else f"{recording.output.name}: {sentence}")

    def _fetch(self, *, last: bool = False) -> None:
        """Write what arrived alongside the first camera's slices: commands, marks, and slices of other cameras.

        last: there will be no more marks.
        """
        first, *others = self.recordings
        commands = [] if first.loop is None else first.loop.rows()
        for row in (*commands, *(() if self.requests is None else self.requests.marked(last=last))):
            first.writer.append_rows(row)
        if self.view is not None:
            for row in commands:
                self.view.add_command(row)
        for recording in others:
            for events, received_s in () if recording.thread is None else recording.thread.take():
                recording.append(events, received_s)


def _result(
    trial: DeviceRecording,
    recordings: Sequence[CameraRecording],
    datasets: Sequence[Mapping[str, Any]],
    *,
    interrupted: bool,
) -> Outcome:
    """Return a row per file; an error or Ctrl-C is raised again here with the saved files."""
    saved = [(each, rows) for each, rows in zip(recordings, datasets, strict=True) if each.slices]
    files = ", ".join(
        f"{recording.slices:,} slices in {session.place(recording.saved)}" for recording, _ in saved if recording.saved
    )
    simulated = any(recording.recipe.simulated for recording in recordings)
    result = Outcome([_row(trial, recording, rows) for recording, rows in saved], simulated)
    first = recordings[0]
    torque = first.rig.gripper.release_words if first.rig.gripper is not None else ""
    session.raise_end(
        first.error, first.ended, files or "nothing was recorded", result, torque, interrupted=interrupted
    )
    return result


def _row(trial: DeviceRecording, recording: CameraRecording, datasets: Mapping[str, Any]) -> dict[str, Any]:
    """Return the table row of one file."""
    loop = recording.loop
    commands = None if loop is None else loop.commands
    too_slow = session.too_slow(datasets, recording.slices, recording.late_slices, commands or 0)
    if too_slow is not None:
        console.say(too_slow)
    (row,) = outcome(
        Job(trial.inputs, recording.saved or recording.output),
        made=True,
        simulated=recording.recipe.simulated,
        slices=recording.slices,
        events=recording.events,
        ended=recording.ended,
        slices_per_s=session.figure(datasets, "slices_per_s"),
        slice_late_us_p99=session.figure(datasets, "slice_late_us", session.P99),
        **session.lost_columns(datasets),
        commands=commands,
        command_misses=None if loop is None else loop.misses,
        command_us_median=session.figure(datasets, "command_us", session.MEDIAN),
        late_slices=recording.late_slices.count,
        too_slow=too_slow,
    ).rows
    return row
