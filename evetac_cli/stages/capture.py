"""Recording from devices: whatever ends it, what was recorded until then is kept.

The camera gives the pace: its slices are written as they come. A gripper is commanded by a thread of its own
(stages/handling.py). The end of the time, Ctrl-C, a gripper that has let go and a device that fails all end with a valid
file, which says why it ended, what was lost and how well time was kept. A full disk and a kill leave a NAME.part/ for
`evetac repair`.
"""

import signal
import sys
import threading
import time
from array import array
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from evetac_cli import console
from evetac_cli.devices import GripperReading, Rig
from evetac_cli.devices.naming import CameraName, CameraSettings, GripperName, camera_name, gripper_name, open_rig
from evetac_cli.errors import DeviceError, EvetacError, InputError
from evetac_cli.events import SLICE_US
from evetac_cli.params import Record
from evetac_cli.stages import Job, Outcome, Progress, outcome
from evetac_cli.stages.handling import GripperLoop, Hold, start, step
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.disk import require_room
from evetac_cli.store.files import StageFile
from evetac_cli.store.provenance import Recipe, first_difference
from evetac_cli.store.segments import RecordingWriter

OUTPUT = "recording"
METHOD = 1  # of recordings from devices
INTERRUPTED = "interrupted"
LOST = "capture/lost/"
HOLDING_MA = 50.0  # where nobody says
SECONDS = 60.0  # room on the disk for so long, where nobody says how long it will take
BYTES_AN_EVENT = 2 * 13  # in its segment and, at worst, again in the joined file
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

    def figures(self, rig: Rig) -> dict[str, Any]:
        """The datasets capture/... of the recording."""
        passed_s = self.last_s - self.began_s
        rows: dict[str, Any] = {"capture/ended": self.ended}
        if passed_s > 0:
            rows["capture/slices_per_s"] = np.float64((self.slices - 1) / passed_s)
        rows |= {LOST + name: np.int64(count) for name, count in rig.counted().items()}
        if self.late_us:
            rows["capture/slice_late_us"] = _spread(self.late_us)
        if self.loop is not None and self.loop.commands:
            if passed_s > 0:
                rows["capture/commands_per_s"] = np.float64(self.loop.commands / passed_s)
            rows["capture/command_misses"] = np.int64(self.loop.misses)
            rows["capture/command_us"] = _spread(self.loop.cycle_us)
        return rows


def _spread(values: "array[float]") -> Any:
    """Median, 99th percentile and most."""
    return np.percentile(np.frombuffer(values), [50, 99, 100])


def names(params: Record) -> tuple[CameraName, GripperName]:
    """The devices that are named; InputError for names that there are not, and for flags that do not fit them."""
    camera = camera_name(params.camera)
    gripper = gripper_name(params.gripper, camera)
    if (camera.kind == "sim") != (gripper.kind == "sim"):
        raise InputError(
            "a simulated device has no peer outside its simulation",
            where="--camera, --gripper",
            expected="both sim, or neither",
            found=f"{camera}, {gripper}",
        )
    if params.source is not None and camera.kind != "sim":
        raise InputError("either a file or a camera", where="--from, --camera", found=f"{params.source}, {camera}")
    return camera, gripper


def dry_run(jobs: list[Job], params: Record) -> Outcome:
    """What would be opened and done; no device and no file is touched."""
    camera, gripper = names(params)
    seconds = params.seconds if params.seconds is not None else SECONDS
    rows = [
        {"part": "camera", "what": str(camera), "detail": _told(asdict(_settings(params))) or "the driver's settings"},
        {"part": "gripper", "what": str(gripper), "detail": "not moved" if gripper.kind == "none" else _plan(params)},
        {
            "part": "end",
            "what": "until it lets go, or Ctrl-C" if params.seconds is None else f"after {params.seconds:g} s",
            "detail": f"room for {_needed(params) / 1e6:,.0f} MB is asked for, {params.expect:,.0f} events/s"
            f" for {seconds:g} s",
        },
        *({"part": "file", "what": str(job.output), "detail": f"trial {job.choice['trial']}"} for job in jobs),
    ]
    return Outcome(rows, camera.kind == "virtual", {"files": len(jobs)}, made=False)


def _told(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in values.items() if value is not None)


def _plan(params: Record) -> str:
    holding = "the world's" if params.holding_ma is None and params.camera.startswith("virtual") else HOLDING_MA
    holding = params.holding_ma if params.holding_ma is not None else holding
    return (
        f"closes with {params.closing_ma:g} mA until contact, holds with {holding} mA for {params.hold_s:g} s,"
        f" lets the current fall to {params.lowest_ma:g} mA"
    )


def _settings(params: Record) -> CameraSettings:
    return CameraSettings(params.threshold_on, params.threshold_off, params.readout_rate)


def _needed(params: Record) -> float:
    seconds = params.seconds if params.seconds is not None else SECONDS
    return params.expect * seconds * BYTES_AN_EVENT


def run(
    job: Job, params: Record, seeds: np.random.SeedSequence, *, force: bool = False, progress: Progress
) -> Outcome:
    """Record one trial from devices."""
    camera, gripper = names(params)
    if job.output.exists() and not force:
        if params.resume:
            return outcome(job, made=False, simulated=_header(job.output)["simulated"])
        raise InputError(
            "the output exists, and a recording from a device cannot be made again",
            where=str(job.output),
            hint="--resume goes on with a series, --force replaces it, -o NAME writes elsewhere",
        )
    require_room(job.output.parent, _needed(params), "--expect EVENTS_PER_S and --seconds say what is needed")
    rng = np.random.default_rng(seeds.spawn(1)[0])
    if job.choice["trial"] and params.camera.startswith("dv") and not params.resume:
        console.wait_for_enter(f"trial {job.choice['trial']}: put the object in place, then press Enter")
    rig = open_rig(camera, gripper, _settings(params), job.choice.get("plan"), seeds)
    for note in getattr(rig.camera, "notes", ()):
        console.say(note)
    try:
        hold = _hold(params, rig)
        sensor = {**rig.sensor_known(), "t_offset": np.int64(0)}
        if params.calibration is not None:
            width, height = sensor["sensor/frame_px"]
            sensor |= read_calibration(params.calibration, (int(width), int(height))).arrays()
        recipe = _recipe(job, params, rig, hold, sensor)
        if params.resume:
            _check_series(job, recipe)
        writer = RecordingWriter(job.output, sensor, discard_leftover=False, recipe=recipe)
        with _signals_counted() as came:
            captured = _write(rig, hold, rng, writer, params, came, progress)
            figures = captured.figures(rig)
            if captured.slices == 0:
                writer.discard()
            else:
                _finish(writer, recipe, figures)
    finally:
        rig.close()
    return _tell(job, recipe, figures, captured)


def _hold(params: Record, rig: Rig) -> Hold | None:
    if rig.gripper is None:
        return None
    holding_ma = params.holding_ma if params.holding_ma is not None else rig.holding_ma or HOLDING_MA
    return Hold(params.closing_ma, holding_ma, params.hold_s, params.lowest_ma)


def _recipe(job: Job, params: Record, rig: Rig, hold: Hold | None, sensor: Mapping[str, Any]) -> Recipe:
    """What is known of a recording beforehand; its content stands in for the rest."""
    calibrated = {name: np.asarray(value).tolist() for name, value in sensor.items() if name.startswith("sensor/")}
    parameters = {
        **job.choice.get("plan", {}),
        "trial": job.choice["trial"],
        "setup": dict(rig.setup),
        "sensor": _without_nan(calibrated),
        "handling": None if hold is None else asdict(hold),
        "handling_seed": params.seed,
    }
    return Recipe(OUTPUT, METHOD, parameters, parents=rig.parents, simulated_source=rig.simulated)


def _without_nan(value: Any) -> Any:
    """JSON has no NaN, which stands for a missing dot."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if value != value else value


def _header(path: Any) -> dict[str, Any]:
    with StageFile(path, OUTPUT) as file:
        return file.header


def _check_series(job: Job, recipe: Recipe) -> None:
    """Refuse to go on with a series that was begun with another set-up."""
    for other in job.choice["series"]:
        if not other.exists():
            continue
        header = _header(other)
        same = {name: header["parameters"].get(name) for name in ("trial", "object", "object_row", "individual_row")}
        wanted = {**recipe.parameters, **{name: value for name, value in same.items() if name in recipe.parameters}}
        now = Recipe(
            OUTPUT, METHOD, wanted, header["seed"], recipe.parents, header["content"], recipe.simulated_source
        )
        if now.id != header["id"]:
            raise InputError(
                "the series was begun with another set-up",
                where=str(other),
                found=first_difference(now, header),
                hint="set it up as it was, or begin a series of its own with -o",
            )


@contextmanager
def _signals_counted() -> Iterator[list[int]]:
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
    rig: Rig,
    hold: Hold | None,
    rng: np.random.Generator,
    writer: RecordingWriter,
    params: Record,
    came: list[int],
    progress: Progress,
) -> Captured:
    """Follow the camera until something ends the recording; a device that failed is in the result."""
    captured = Captured()
    if rig.gripper is not None and hold is not None:
        state, law = start(hold), hold

        def act(reading: GripperReading) -> tuple[float, str]:
            target_ma = step(state, law, reading, rng)
            return target_ma, state.ended

        captured.loop = GripperLoop(rig.gripper, act, rig.clock.now_us)
    most = round(1000 * params.seconds) if params.seconds is not None else None
    interval = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        _follow(rig, writer, captured, most, came, progress)
    except DeviceError as error:
        captured.error = error
        captured.ended = str(error).splitlines()[0]
    except BaseException as error:
        if captured.slices == 0:
            writer.discard()
            raise
        writer.leave()
        if isinstance(error, EvetacError):
            raise _with_hint(error, writer) from error
        raise
    finally:
        sys.setswitchinterval(interval)
        if captured.loop is not None:
            captured.loop.stop()
    for row in captured.loop.rows() if captured.loop is not None else ():
        writer.append_rows(row)
    return captured


def _follow(
    rig: Rig, writer: RecordingWriter, captured: Captured, most: int | None, came: list[int], progress: Progress
) -> None:
    host_us = getattr(rig.camera, "host_us", None)
    loop = captured.loop
    while captured.slices != most:
        events = rig.camera.read()
        captured.last_s = time.monotonic()
        if events is None:
            captured.ended = "the camera's stream ended"
            return
        if captured.slices == 0:
            captured.began_s = captured.last_s
            if loop is not None:
                loop.start()
        captured.slices += 1
        captured.events += events.size
        if host_us is not None:
            captured.late_us.append(captured.last_s * 1e6 - host_us(captured.slices * SLICE_US))
        if loop is not None:
            for row in loop.rows():
                writer.append_rows(row)
        writer.append(events)
        if loop is not None and loop.error is not None:
            raise loop.error
        if loop is not None and loop.ended:
            captured.ended = loop.ended
            return
        if came:
            captured.ended = INTERRUPTED
            return
        if captured.slices % 100 == 0:
            progress(captured.slices, most or captured.slices)
    captured.ended = "after the seconds asked for"


def _finish(writer: RecordingWriter, recipe: Recipe, figures: Mapping[str, Any]) -> None:
    try:
        writer.finish(recipe, figures, from_device=True)
    except BaseException as error:
        writer.leave()
        if isinstance(error, EvetacError):
            raise _with_hint(error, writer) from error
        raise


def _with_hint(error: EvetacError, writer: RecordingWriter) -> EvetacError:
    return type(error)(f"{error}\n  kept:     {writer.folder}, for `evetac repair`")


def _tell(job: Job, recipe: Recipe, figures: Mapping[str, Any], captured: Captured) -> Outcome:
    """The row of a recording; an error or Ctrl-C goes on from here, and says what there is."""
    kept = f"{captured.slices:,} slices in {job.output}" if captured.slices else "nothing was recorded"
    if captured.error is not None:
        kind = type(captured.error) if isinstance(captured.error, EvetacError) else DeviceError
        raise kind(f"{captured.error}\n  kept:     {kept}") from captured.error
    if captured.ended == INTERRUPTED:
        raise KeyboardInterrupt(f"interrupted: {kept}")
    lost = {name.removeprefix(LOST): int(count) for name, count in figures.items() if name.startswith(LOST) and count}
    none = (None, None, None)
    late_us, command_us = (figures.get(f"capture/{name}", none) for name in ("slice_late_us", "command_us"))
    return outcome(
        job,
        made=True,
        simulated=recipe.simulated,
        slices=captured.slices,
        events=captured.events,
        ended=captured.ended,
        slices_per_s=_plain(figures.get("capture/slices_per_s")),
        slice_late_us_p99=_plain(late_us[1]),
        lost="; ".join(f"{name} {count}" for name, count in lost.items()) or None,
        commands=captured.loop.commands if captured.loop is not None else None,
        command_misses=captured.loop.misses if captured.loop is not None else None,
        command_us_median=_plain(command_us[0]),
    )


def _plain(value: Any) -> float | None:
    return None if value is None else float(value)
