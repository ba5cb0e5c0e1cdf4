"""What a recording from devices is about to do: told, and refused where it would fail, before anything is touched."""

import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from evetac_cli.devices.naming import CameraName, CameraSettings, GripperName, camera_name, gripper_name
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX
from evetac_cli.jobs import Job, Outcome
from evetac_cli.params import Record
from evetac_cli.stages.record.capture_series import refuse_taken
from evetac_cli.stages.record.current_ramp import Hold
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.disk import require_room
from evetac_cli.store.read import open_recording

HOLDING_MA = 50.0  # where nobody says
SECONDS = 60.0  # room on the disk for so long, where nobody says how long it will take
BYTES_AN_EVENT = 2 * 13  # in its segment and, at worst, again in the joined file
TAKEN = "--resume goes on with a series, --force replaces it, -o NAME writes elsewhere"


def names(params: Record) -> tuple[tuple[CameraName, ...], GripperName]:
    """The devices that are named; InputError for names that there are not, and for flags that do not fit them."""
    cameras = tuple(camera_name(text) for text in re.split(",(?=sim|virtual|dvxplorer|dv|replay:)", params.camera))
    gripper = gripper_name(params.gripper, cameras[0])
    if any((camera.kind == "sim") != (gripper.kind == "sim") for camera in cameras):
        raise InputError(
            "a simulated device has no peer outside its simulation",
            where="--camera, --gripper",
            expected="both sim, or neither",
            found=f"{params.camera}, {gripper}",
        )
    if params.source is not None and cameras[0].kind != "sim":
        raise InputError("either a file or a camera", where="--from, --camera", found=params.camera)
    worlds = sum(camera.kind in ("sim", "virtual") and camera.prepared_events_s is None for camera in cameras)
    if len(cameras) > 1 and (worlds or params.live):
        expected = "one camera of a simulated world" if worlds else "one camera to look through"
        raise InputError("too many cameras", where="--camera", expected=expected, found=params.camera)
    return cameras, gripper


def check(job: Job, params: Record, *, force: bool) -> None:
    """InputError for whatever can be known to be wrong with a trial before a device is touched."""
    cameras, gripper = names(params)
    for camera in cameras:
        frame_px = FRAME_PX
        if camera.kind == "replay":
            with open_recording(Path(camera.which or "")) as recording:
                frame_px = recording.frame_px
        if params.calibration is not None:
            read_calibration(params.calibration, frame_px)
    if gripper.kind != "none" and asked_ma(params, "plan" in job.choice) is not None:
        hold_of(params, None)
    if params.live:
        return
    refuse_taken(job, again="a recording from a device", hint=TAKEN, force=force, resume=params.resume)
    needed = needed_bytes(params) * len(cameras)
    require_room(job.output.parent, needed, "--expected-event-rate and --seconds say what is needed")


def is_there(job: Job, params: Record, *, force: bool) -> bool:
    """Whether the trial of a series that goes on is there already."""
    return params.resume and not force and all(output.exists() for output in job.choice["outputs"])


def asked_ma(params: Record, world: bool) -> float | None:
    """The holding current that is set up; None where a world draws one for each trial."""
    return params.holding_ma if params.holding_ma is not None or world else HOLDING_MA


def hold_of(params: Record, drawn_ma: float | None) -> Hold:
    """How the object is handled; drawn_ma: what a world draws. InputError for a current that has nowhere to fall."""
    asked = asked_ma(params, drawn_ma is not None)
    holding_ma = drawn_ma if asked is None else asked
    assert holding_ma is not None
    if params.lowest_ma >= holding_ma:
        raise InputError(
            "the current would not fall",
            where="--lowest-ma",
            expected=f"less than the holding current, {holding_ma:g} mA (--holding-ma)",
            found=f"{params.lowest_ma:g} mA",
        )
    return Hold(params.closing_ma, holding_ma, params.hold_s, params.lowest_ma)


def dry_run(jobs: list[Job], params: Record, *, force: bool = False) -> Outcome:
    """What would be opened and done, checked as by a run; no device is touched, and no file written."""
    for job in jobs:
        if not is_there(job, params, force=force):
            check(job, params, force=force)
    cameras, gripper = names(params)
    told = _told(asdict(settings(params))) or "the driver's settings"
    seconds = params.seconds if params.seconds is not None else SECONDS
    rows = [
        *({"part": "camera", "what": str(camera), "detail": told} for camera in cameras),
        {"part": "gripper", "what": str(gripper), "detail": "not moved" if gripper.kind == "none" else _plan(params)},
        {
            "part": "end",
            "what": f"after {params.seconds:g} s" if params.seconds is not None else _end(cameras, gripper),
            "detail": f"room for {needed_bytes(params) / 1e6:,.0f} MB is asked for, {params.expected_event_rate:,.0f} events/s"
            f" for {seconds:g} s",
        },
        *(
            {"part": "file", "what": str(output), "detail": f"trial {job.choice['trial']}"}
            for job in jobs
            for output in job.choice["outputs"]
        ),
    ]
    files = sum(len(job.choice["outputs"]) for job in jobs)
    return Outcome(rows, any(camera.kind == "virtual" for camera in cameras), {"files": files}, made=False)


def _end(cameras: tuple[CameraName, ...], gripper: GripperName) -> str:
    ends = ["it lets go"] * (gripper.kind != "none") + ["the recording is over"] * (cameras[0].kind == "replay")
    return "until " + ", or ".join([*ends, "Ctrl-C"])


def _told(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in values.items() if value is not None)


def _plan(params: Record) -> str:
    holding = "the world's" if params.holding_ma is None and params.camera.startswith("virtual") else HOLDING_MA
    holding = params.holding_ma if params.holding_ma is not None else holding
    return (
        f"closes with {params.closing_ma:g} mA until contact, holds with {holding} mA for {params.hold_s:g} s,"
        f" lets the current fall to {params.lowest_ma:g} mA"
    )


def settings(params: Record) -> CameraSettings:
    """What is set on the camera."""
    return CameraSettings(params.threshold_on, params.threshold_off, params.readout_rate)


def needed_bytes(params: Record) -> float:
    """Room that a recording may need on its disk."""
    seconds = params.seconds if params.seconds is not None else SECONDS
    return params.expected_event_rate * seconds * BYTES_AN_EVENT
