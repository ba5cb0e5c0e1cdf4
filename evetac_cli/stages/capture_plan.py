"""What a recording from devices is about to do, told before anything is touched."""

import re
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from evetac_cli.devices.naming import CameraName, CameraSettings, GripperName, camera_name, gripper_name
from evetac_cli.errors import InputError
from evetac_cli.params import Record
from evetac_cli.stages import Job, Outcome

HOLDING_MA = 50.0  # where nobody says
SECONDS = 60.0  # room on the disk for so long, where nobody says how long it will take
BYTES_AN_EVENT = 2 * 13  # in its segment and, at worst, again in the joined file


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


def dry_run(jobs: list[Job], params: Record) -> Outcome:
    """What would be opened and done; no device and no file is touched."""
    cameras, gripper = names(params)
    told = _told(asdict(settings(params))) or "the driver's settings"
    seconds = params.seconds if params.seconds is not None else SECONDS
    rows = [
        *({"part": "camera", "what": str(camera), "detail": told} for camera in cameras),
        {"part": "gripper", "what": str(gripper), "detail": "not moved" if gripper.kind == "none" else _plan(params)},
        {
            "part": "end",
            "what": "until it lets go, or Ctrl-C" if params.seconds is None else f"after {params.seconds:g} s",
            "detail": f"room for {needed_bytes(params) / 1e6:,.0f} MB is asked for, {params.expect:,.0f} events/s"
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
    return params.expect * seconds * BYTES_AN_EVENT
