"""Open named cameras and grippers; those of plug-ins are checked while they run.

Reason: code of another package may return anything, and what it returns is recorded and commands a gripper. The rules
are some of those of `evetac_cli.testing`, which calls the same functions, and which alone checks the clock. A violation
is a DeviceError that names the plug-in: what was recorded before is kept and torque is switched off. evetac's own
devices keep the rules by their tests, and are not wrapped.
"""

import json
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from evetac_cli import plugins
from evetac_cli.devices import EventCamera, Gripper, GripperReading
from evetac_cli.devices.cameras import CameraSettings, NamedCamera, OpenedCamera
from evetac_cli.devices.device_slices import DRIFT, RESERVE_US
from evetac_cli.devices.grippers import Mode, NamedGripper
from evetac_cli.devices.rh_p12_rn.control_table import BEYOND_TICKS
from evetac_cli.errors import DeviceError, EvetacError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.kernels.grip.paper import PAPER

if TYPE_CHECKING:
    from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
    from evetac_cli.devices.virtual.world import VirtualWorld

DTYPES = tuple(map(np.dtype, (np.int64, np.uint16, np.uint16, np.uint8)))
POSITIONS_TICKS = PAPER.first_tick - BEYOND_TICKS, PAPER.last_tick + BEYOND_TICKS
DESCRIPTION = "describes itself wrongly", "a mapping for the header, in JSON"
NOT_OFF = "torque could not be read back as off"
_T = TypeVar("_T")


# What is asked of devices; each function returns what is wrong, or "" ------------------------------------------------


def slice_fault(events: Any, index: int, frame_px: tuple[int, int]) -> str:
    """Return what is wrong with the slice of this index, "" if nothing.

    Expected are events of [index, index + 1) ms, in order of time, with the right dtypes, in the frame.
    """
    if not isinstance(events, Events):
        return f"{type(events).__name__} instead of evetac_cli.Events"
    if not all(isinstance(column, np.ndarray) and column.ndim == 1 for column in events):
        return "columns that are not arrays of one dimension"
    if tuple(column.dtype for column in events) != DTYPES:
        return f"columns of {', '.join(str(column.dtype) for column in events)}"
    if len({len(column) for column in events}) > 1:
        return f"columns of {', '.join(str(len(column)) for column in events)} events"
    for name, column, wrong in (
        ("t", events.t, (events.t < index * SLICE_US) | (events.t >= (index + 1) * SLICE_US)),
        ("after a later event t", events.t[1:], events.t[1:] < events.t[:-1]),
        ("x", events.x, events.x >= frame_px[0]),
        ("y", events.y, events.y >= frame_px[1]),
        ("p", events.p, events.p > 1),
    ):
        if wrong.any():
            return f"{name} = {column[np.argmax(wrong)]}"
    return ""


def clock_fault(camera: EventCamera, slices: int, previous_us: int, slack_us: int = SLICE_US) -> str:
    """Return what is wrong with device time after this number of slices, "" if nothing.

    It may not go back by more than the slack, be earlier than the end of the last slice by more than that, or be ahead
    of the host's time. previous_us: device time before.
    """
    now_us, end_us = camera.now_us(), slices * SLICE_US
    if not isinstance(now_us, (int, np.integer)):
        return f"now_us returned {type(now_us).__name__}"
    if now_us < previous_us - slack_us:
        return f"device time went back from {previous_us} to {now_us} us"
    if now_us < end_us - slack_us:
        return f"after {slices} slices it is {now_us} us"
    ahead_us = camera.host_us(end_us) - camera.time.now_s() * 1e6  # NaN if the two clocks are not related
    if ahead_us > RESERVE_US + DRIFT * end_us:
        return f"after {slices} slices the camera is {ahead_us * 1e-3:.0f} ms in the future"
    return ""


def counts_fault(counted: Any) -> str:
    """Return what is wrong with the losses of a device, "" if nothing: they are whole numbers by name."""
    if not isinstance(counted, Mapping):
        return f"losses: {type(counted).__name__} instead of a mapping"
    for name, count in counted.items():
        if not isinstance(name, str) or not isinstance(count, int) or count < 0:
            return f"losses: {count!r} for {name!r} instead of a whole number by name"
    return ""


def reading_fault(reading: Any) -> str:
    """Return what is wrong with a gripper's reading, "" if nothing: a finite current, and ticks within the range."""
    if not isinstance(reading, GripperReading):
        return f"{type(reading).__name__} instead of GripperReading"
    current_ma, position_ticks = reading
    if not isinstance(current_ma, (int, float, np.floating)) or not math.isfinite(current_ma):
        return f"a current of {current_ma!r} mA"
    lowest, highest = POSITIONS_TICKS
    if not isinstance(position_ticks, int) or not lowest <= position_ticks <= highest:
        return f"a position of {position_ticks!r} ticks"
    return ""


def setup_fault(setup: Any) -> str:
    """Return what is wrong with the entries of a device for the header, "" if nothing: a mapping that JSON can hold."""
    try:
        json.dumps(setup, allow_nan=False)
    except (TypeError, ValueError) as error:
        return f"its entries for the header are not JSON: {error}"
    return "" if isinstance(setup, Mapping) else f"its entries for the header are {type(setup).__name__}"


def sensor_fault(camera: EventCamera, frame_px: tuple[int, int]) -> str:
    """Return what is wrong with what an open camera reports, "" if nothing; frame_px: that of the named camera."""
    found_px = tuple(np.ravel(camera.sensor.get("sensor/frame_px", ())).tolist())
    if found_px != tuple(frame_px):
        return f"sensor/frame_px is {found_px}, but frame_px() returned {tuple(frame_px)}"
    return "" if all(isinstance(note, str) for note in camera.notes) else "notes are not texts"


# Devices of plug-ins --------------------------------------------------------------------------------------------------


class _Maker:
    """The plug-in of a device, for errors."""

    def __init__(self, group: str, name: str, check: str) -> None:
        """check: the function of evetac_cli.testing with the same checks."""
        self._group, self._name, self._check = group, name, check
        self._counts: Mapping[str, int] = {}

    def fault(self, does: str, expected: str, found: str) -> DeviceError:
        """Return the error that the plug-in breaks its contract; does: a verb, and what it concerns."""
        plugin = plugins.by_name(self._group, self._name)
        kind = self._group.removeprefix("evetac.").removesuffix("s")
        package = plugin.package if plugin is not None else "another package"
        hint = f"report it to the authors of {package}: evetac_cli.testing.{self._check} reproduces it"
        message = f"the plug-in {kind} {self._name} of {package} {does}"
        return DeviceError(message, expected=expected, found=found, hint=hint)

    def ask(self, what: str, call: Callable[..., _T], *arguments: Any, passes: type[EvetacError] = DeviceError) -> _T:
        """Return the result of a call; an exception that does not pass becomes a DeviceError, and is its cause."""
        try:
            return call(*arguments)
        except passes:
            raise
        except Exception as error:  # third-party code may raise anything
            raise self.fault(f"failed: {what}", "", _one_line(error)) from error

    def require(self, fault: str, does: str, expected: str) -> None:
        """Raise DeviceError if there is a fault."""
        if fault:
            raise self.fault(does, expected, fault)

    def counted(self, device: EventCamera | Gripper) -> Mapping[str, int]:
        """Return the last valid losses; they are also asked for at the end, after an error."""
        with suppress(Exception):  # third-party code may raise anything
            counts = dict(device.counted)
            self._counts = self._counts if counts_fault(counts) else counts
        return self._counts


class CheckedCamera:
    """The open camera of a plug-in; DeviceError, which names the plug-in, for anything but valid slices and times."""

    def __init__(self, named: NamedCamera, camera: EventCamera) -> None:
        self._camera = camera
        self._maker = _Maker(plugins.CAMERAS, named.name, "check_camera")
        frame_px = self._maker.ask("frame_px", named.frame_px)
        fault = self._maker.ask("sensor", sensor_fault, camera, frame_px)
        self._maker.require(fault, "reports an invalid sensor", "its frame, and notes that are texts")
        self.sensor, self.notes, self.time = dict(camera.sensor), camera.notes, camera.time
        self._frame_px = int(frame_px[0]), int(frame_px[1])
        self._slices = self._now_us = 0
        self._is_open = True

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses so far by plain name."""
        return self._maker.counted(self._camera)

    def now_us(self) -> int:
        """Return device time in us, which never goes back."""
        self._now_us = max(self._now_us, int(self._maker.ask("now_us", self._camera.now_us)))
        return self._now_us

    def host_us(self, device_us: float) -> float:
        """Return the reading of `time`, in us, at this time of the recording; NaN if unknown."""
        return float(self._maker.ask("host_us", self._camera.host_us, device_us))

    def read(self) -> Events | None:
        """Return the next slice, or None after the end of the stream."""
        events = self._maker.ask("read", self._camera.read)
        if events is None:
            if self._is_open and not self._slices:
                raise self._maker.fault("returned no slice", "slices until it is closed or its stream ends", "None")
            return None
        if fault := slice_fault(events, self._slices, self._frame_px):
            first_us, (width, height) = self._slices * SLICE_US, self._frame_px
            within = f"[{first_us}, {first_us + SLICE_US}) us, in order of time, in a frame of {width} x {height} px"
            expected = f"{within}, with p 0 or 1, as {', '.join(map(str, DTYPES))}"
            raise self._maker.fault(f"returned an invalid slice {self._slices}", expected, fault)
        self._slices += 1
        return events

    def close(self) -> None:
        """Stop the camera; a second call does nothing."""
        if self._is_open:
            self._is_open = False
            self._maker.ask("close", self._camera.close)


class CheckedGripper:
    """The open gripper of a plug-in; DeviceError, which names the plug-in, for anything but valid readings."""

    def __init__(self, named: NamedGripper, gripper: Gripper) -> None:
        self._gripper = gripper
        self._maker = _Maker(plugins.GRIPPERS, named.name, "check_gripper")
        self._not_off = ""  # why torque could not be switched off

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses so far by plain name."""
        return self._maker.counted(self._gripper)

    @property
    def release_words(self) -> str:
        """The known state of torque; if `close` failed, that it is not known to be off."""
        if self._not_off:
            return f"{NOT_OFF}: {self._not_off}"
        try:
            return str(self._gripper.release_words)
        except Exception as error:
            return f"{NOT_OFF}: {_one_line(error)}"

    def read(self) -> GripperReading:
        """Return the measured current and position."""
        reading = self._maker.ask("read", self._gripper.read)
        expected = "a finite current in mA, and a position of {} to {} ticks".format(*POSITIONS_TICKS)
        self._maker.require(reading_fault(reading), "returned an invalid reading", expected)
        return reading

    def write_current(self, current_ma: int) -> None:
        """Set the goal current."""
        self._maker.ask("write_current", self._gripper.write_current, current_ma)

    def write_position(self, goal_ticks: int) -> None:
        """Set the goal position."""
        self._maker.ask("write_position", self._gripper.write_position, goal_ticks)

    def emergency_open(self) -> None:
        """Open the fingers, then let go."""
        self._maker.ask("emergency_open", self._gripper.emergency_open)

    def close(self) -> None:
        """Switch torque off. DeviceError if that fails for the first time; a further call tries again."""
        failed_before, self._not_off = bool(self._not_off), ""
        try:
            self._gripper.close()
        except Exception as error:
            self._not_off = _one_line(error)
            if not failed_before:
                raise self._maker.fault(f"failed to let go: {self.release_words}", "", "") from error


def open_camera(
    named: NamedCamera, settings: CameraSettings, world: "VirtualWorld | None", seeds: np.random.SeedSequence
) -> OpenedCamera:
    """Start a camera as `NamedCamera.open` does; that of a plug-in is checked."""
    if _is_ours(named):
        return named.open(settings, world, seeds)
    maker = _Maker(plugins.CAMERAS, named.name, "check_camera")
    opened = maker.ask("open", lambda: OpenedCamera(*named.open(settings, world, seeds)), passes=EvetacError)
    try:
        maker.require(setup_fault(opened.setup), *DESCRIPTION)
        return opened._replace(camera=CheckedCamera(named, opened.camera))
    except BaseException:
        maker.ask("close", opened.camera.close)
        raise


def open_gripper(
    named: NamedGripper, mode: Mode, port: str, settings: "RhP12RnSettings | None" = None
) -> tuple[Gripper | None, Any]:
    """Start a gripper as `NamedGripper.open` does; that of a plug-in is checked."""
    if _is_ours(named):
        return named.open(mode, port, settings)
    maker = _Maker(plugins.GRIPPERS, named.name, "check_gripper")

    def opened() -> tuple[CheckedGripper, Any]:
        gripper, setup = named.open(mode, port, settings)
        if gripper is None:
            raise TypeError("it returned no gripper")
        return CheckedGripper(named, gripper), setup

    checked, setup = maker.ask("open", opened, passes=EvetacError)
    try:
        maker.require(setup_fault(setup), *DESCRIPTION)
    except BaseException:
        checked.close()
        raise
    return checked, setup


def release_gripper(named: NamedGripper, port: str, settings: "RhP12RnSettings") -> str:
    """Switch torque off as `NamedGripper.release` does; if that fails, the sentence says so."""
    try:
        return named.release(port, settings)
    except Exception as error:  # third-party code may raise anything
        return f"{NOT_OFF}: {_one_line(error)}"


def _is_ours(named: NamedCamera | NamedGripper) -> bool:
    return type(named).__module__.partition(".")[0] == "evetac_cli"


def _one_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
