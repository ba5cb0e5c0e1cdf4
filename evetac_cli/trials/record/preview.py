"""record --preview: a live display of a camera; nothing is written or moved."""

import time
from dataclasses import dataclass
from typing import Any

from evetac_cli.commands.record import Record
from evetac_cli.devices import Rig, losses
from evetac_cli.devices.cameras import CameraSettings, NamedCamera
from evetac_cli.devices.grippers import NoGripper
from evetac_cli.devices.opening import open_rig
from evetac_cli.events import SLICE_US, SLICES_PER_S
from evetac_cli.jobs import Outcome
from evetac_cli.names import Capability
from evetac_cli.store.calibration import Calibration, read_calibration
from evetac_cli.trials import live_view
from evetac_cli.trials.live_view import LiveView
from evetac_cli.trials.record.capture_plan import camera_settings
from evetac_cli.trials.trial import Trial

NEWS_SLICES = 100  # number of slices after which losses are checked


@dataclass(frozen=True)
class Preview(Trial):
    """A trial whose camera is shown for some seconds, or if they are None until its stream ends."""

    exclusive = True
    camera: NamedCamera
    settings: CameraSettings
    calibration: Calibration | None
    seconds: float | None

    @classmethod
    def of(cls, trial: Trial, camera: NamedCamera, params: Record) -> "Preview":
        """Return a preview with the settings of the flags.

        InputError for a calibration that does not fit the camera.
        """
        calibration = None
        if params.calibration is not None:
            calibration = read_calibration(params.calibration, camera.frame_px())
        return cls(
            *(trial.inputs, trial.output, trial.number, trial.seed, trial.plan),
            *(camera, camera_settings(params), calibration, params.seconds),
            view=trial.view,
        )

    @property
    def shows_simulation(self) -> bool:
        """Whether the camera shows a simulation, or a recording of one."""
        return self.camera.shows_simulation()


def run(trial: Preview) -> Outcome:
    """Show the camera until the seconds are over, its stream ends, or Ctrl-C."""
    camera = trial.camera
    with live_view.opened(trial, f"preview of {camera}", moves=False) as view:
        assert view is not None
        rig = open_rig(camera, NoGripper(), trial.settings, trial.plan, trial.seeds())
        try:
            sensor = rig.known_sensor()
            if trial.calibration is not None:
                sensor |= trial.calibration.recorded()
            view.begin(sensor)
            most = round(SLICES_PER_S * trial.seconds) if trial.seconds is not None else None
            row = _watch(rig, view, most, paced=camera.has(Capability.STEPPED))
        except KeyboardInterrupt:
            raise KeyboardInterrupt("stopped; nothing was written") from None
        finally:
            rig.close()
    row = {"camera": str(camera), **row}
    return Outcome([row], rig.simulated or any(parent["simulated"] for parent in rig.parents), {"shown": 1})


def _watch(rig: Rig, view: LiveView, most: int | None, *, paced: bool) -> dict[str, Any]:
    """Read and show slices; `paced` holds a simulation back to real time."""
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
