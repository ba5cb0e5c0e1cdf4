"""record --live: what a camera sees, as a picture of characters on the terminal; nothing is written or moved."""

import time
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli import console
from evetac_cli.devices import Rig, cameras, losses
from evetac_cli.devices.grippers import NoGripper
from evetac_cli.devices.opening import open_rig
from evetac_cli.events import Events
from evetac_cli.jobs import Outcome
from evetac_cli.params.recording import Record
from evetac_cli.stages.record.capture_plan import settings
from evetac_cli.stages.trials import DeviceTrial, SimulatedTrial

COLUMNS, ROWS = 80, 30  # characters, which are twice as high as wide
SHOWN_MS = 100  # events of so long make one picture
SHADES = " .:-=+*#%@"
FULL = 2.0  # events a pixel for the darkest shade


def run(trial: SimulatedTrial | DeviceTrial, params: Record) -> Outcome:
    """Show the camera until --seconds are over, its stream ends, or Ctrl-C."""
    camera = trial.cameras[0] if isinstance(trial, DeviceTrial) else cameras.Simulated()
    rig = open_rig(camera, NoGripper(), settings(params), trial.plan, trial.seeds())
    try:
        most = round(1000 * params.seconds) if params.seconds is not None else None
        row = _watch(rig, most, paced=camera.is_stepped)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("stopped; nothing was written") from None
    finally:
        rig.close()
    row = {"camera": str(camera), **row}
    return Outcome([row], rig.simulated or any(parent["simulated"] for parent in rig.parents), {"shown": 1})


def _watch(rig: Rig, most: int | None, *, paced: bool) -> dict[str, Any]:
    """Read and show; `paced` holds a simulation back to real time."""
    frame = tuple(int(size) for size in rig.known_sensor()["sensor/frame_px"])
    latest: deque[Events] = deque(maxlen=SHOWN_MS)
    slices = total = 0
    began_s = time.monotonic()
    with console.live() as show:
        while slices != most and (events := rig.camera.read()) is not None:
            slices += 1
            total += events.size
            latest.append(events)
            if paced:
                time.sleep(max(0.0, began_s + slices * 1e-3 - time.monotonic()))
            if slices % SHOWN_MS == 0:
                show(f"{_headline(rig, latest, slices, began_s)}\n{picture(list(latest), frame)}")
    passed_s = time.monotonic() - began_s
    return {
        "slices": slices,
        "events": total,
        "events_per_s": total / (slices * 1e-3) if slices else None,
        "slices_per_s": slices / passed_s,
        "lost": losses.events_lost(rig.counted()),
        "lost_why": losses.reasons(rig.counted()),
    }


def _headline(rig: Rig, latest: deque[Events], slices: int, began_s: float) -> str:
    events_s = sum(events.size for events in latest) / (len(latest) * 1e-3)
    slices_s = slices / (time.monotonic() - began_s)
    lost = losses.events_lost(rig.counted())
    return f"{slices * 1e-3:8.1f} s   {slices_s:6.0f} slices/s   {events_s:11,.0f} events/s   lost: {lost}"


def picture(parts: list[Events], frame_px: tuple[int, ...]) -> str:
    """Events as ROWS lines of COLUMNS characters, darker where there are more."""
    width, height = frame_px
    counts: NDArray[np.int64] = np.zeros(ROWS * COLUMNS, np.int64)
    for events in parts:
        column = events.x.astype(np.int64) * COLUMNS // width
        row = events.y.astype(np.int64) * ROWS // height
        counts += np.bincount(row * COLUMNS + column, minlength=ROWS * COLUMNS)
    pixels = width * height / (ROWS * COLUMNS)
    dark = np.sqrt(np.minimum(counts / (FULL * pixels), 1.0))  # events of a single dot are visible, too
    shade = np.ceil(dark * (len(SHADES) - 1)).astype(np.int64).reshape(ROWS, COLUMNS)
    return "\n".join("".join(SHADES[value] for value in line) for line in shade)
