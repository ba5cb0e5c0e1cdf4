"""record --preview: what a camera sees, shown live; nothing is written or moved. And the view beside a recording."""

import time
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

from evetac_cli.devices import Rig, cameras, losses
from evetac_cli.devices.grippers import NoGripper
from evetac_cli.devices.opening import open_rig
from evetac_cli.events import SLICE_US
from evetac_cli.jobs import Outcome
from evetac_cli.params.recording import Record
from evetac_cli.stages import live_view
from evetac_cli.stages.live_view import LiveView
from evetac_cli.stages.live_view.messages import Title
from evetac_cli.stages.record.capture_plan import settings
from evetac_cli.stages.trials import DeviceTrial, SimulatedTrial
from evetac_cli.store.calibration import read_calibration

NEWS_SLICES = 100  # after so many slices it is asked what was lost


def view_of(trial: SimulatedTrial | DeviceTrial, params: Record) -> AbstractContextManager[LiveView | None]:
    """The live view of a recording or a preview, if one is asked for; slip is that of the package's detector."""
    if not (params.live or params.preview):
        return nullcontext()
    from evetac_cli.stages.grasp.setup import open_view_detector  # loads what a recording does not need

    moves = isinstance(trial, DeviceTrial) and trial.gripper.is_moved and not params.preview
    simulated = isinstance(trial, SimulatedTrial) or trial.cameras[0].shows_simulation()
    what = f"preview of {_camera(trial)}" if params.preview else f"record {trial.output.name}"
    title = Title(what, simulated, moves)
    open_detector = partial(open_view_detector, None, "stable", None)
    return live_view.opened(params.live_in, title, open_detector)


def run(trial: SimulatedTrial | DeviceTrial, params: Record) -> Outcome:
    """Show the camera until --seconds are over, its stream ends, or Ctrl-C."""
    camera = _camera(trial)
    with view_of(trial, params) as view:
        assert view is not None
        rig = open_rig(camera, NoGripper(), settings(params), trial.plan, trial.seeds())
        try:
            sensor = rig.known_sensor()
            if params.calibration is not None:
                sensor |= read_calibration(params.calibration, camera.frame_px()).arrays()
            view.begin(sensor)
            most = round(1000 * params.seconds) if params.seconds is not None else None
            row = _watch(rig, view, most, paced=camera.is_stepped)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("stopped; nothing was written") from None
        finally:
            rig.close()
    row = {"camera": str(camera), **row}
    return Outcome([row], rig.simulated or any(parent["simulated"] for parent in rig.parents), {"shown": 1})


def _camera(trial: SimulatedTrial | DeviceTrial) -> cameras.NamedCamera:
    return trial.cameras[0] if isinstance(trial, DeviceTrial) else cameras.Simulated()


def _watch(rig: Rig, view: LiveView, most: int | None, *, paced: bool) -> dict[str, Any]:
    """Read and show; `paced` holds a simulation back to real time."""
    slices = total = 0
    began_s = time.monotonic()
    camera = rig.camera
    while slices != most and (events := camera.read()) is not None:
        slices += 1
        total += events.size
        view.add_slice(events, camera.time.now_s() * 1e6 - camera.host_us(slices * SLICE_US))
        if paced:
            time.sleep(max(0.0, began_s + slices * 1e-3 - time.monotonic()))
        if slices % NEWS_SLICES == 0:
            view.lost(rig.counted())
    passed_s = time.monotonic() - began_s
    return {
        "slices": slices,
        "events": total,
        "events_per_s": total / (slices * 1e-3) if slices else None,
        "slices_per_s": slices / passed_s,
        "lost": losses.events_lost(rig.counted()),
        "lost_why": losses.reasons(rig.counted()),
    }
