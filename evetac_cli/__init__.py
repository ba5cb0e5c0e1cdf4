"""evetac: event-based tactile sensing, from an event camera behind a dotted gel to a grasp.

    import evetac_cli as evetac

    with evetac.open_recording("a.recording.h5") as recording:
        detector = evetac.SlipDetector(recording)
        for events in recording:            # one slice of 1 ms at a time: t, x, y, p as numpy arrays
            probability = detector.step(events)

Each name of `__all__` is imported when it is first used, so `import evetac_cli` takes almost no time.
"""

from typing import TYPE_CHECKING, Any

from evetac_cli.names import __version__ as __version__

if TYPE_CHECKING:
    from evetac_cli.api import (
        DotTracker,
        EventImager,
        Gel,
        Simulation,
        SlipDetector,
        TouchMap,
        architectures,
        objects,
        open_features,
        open_force_model,
        open_labels,
        open_model,
        open_report,
        open_touch,
        open_tracks,
        scenes,
        sensors,
        simulate,
        tracker_presets,
    )
    from evetac_cli.errors import EvetacError, InputError, UnavailableError
    from evetac_cli.events import Events, SliceBlock, Slicer
    from evetac_cli.kernels.event_drawing import ImageBlock
    from evetac_cli.kernels.slip.architectures import Sensitivity
    from evetac_cli.kernels.touch.touch_map import TouchReading
    from evetac_cli.sim.simulated_camera import SeenSlice, SimulatedCamera
    from evetac_cli.sim.touch_sensor import Touch, TouchSensor
    from evetac_cli.store.recordings.read import Recording, SlipWindows, open_recording

__all__ = [
    "DotTracker",
    "EventImager",
    "Events",
    "EvetacError",
    "Gel",
    "ImageBlock",
    "InputError",
    "Recording",
    "Sensitivity",
    "SeenSlice",
    "SimulatedCamera",
    "Simulation",
    "SliceBlock",
    "Slicer",
    "SlipDetector",
    "SlipWindows",
    "Touch",
    "TouchMap",
    "TouchReading",
    "TouchSensor",
    "UnavailableError",
    "architectures",
    "objects",
    "open_features",
    "open_force_model",
    "open_labels",
    "open_model",
    "open_recording",
    "open_report",
    "open_touch",
    "open_tracks",
    "scenes",
    "sensors",
    "simulate",
    "tracker_presets",
]

_MODULES = {
    **dict.fromkeys(("Events", "SliceBlock", "Slicer"), "events"),
    "ImageBlock": "kernels.event_drawing",
    "Sensitivity": "kernels.slip.architectures",
    **dict.fromkeys(("EvetacError", "InputError", "UnavailableError"), "errors"),
    **dict.fromkeys(("SeenSlice", "SimulatedCamera"), "sim.simulated_camera"),
    **dict.fromkeys(("Touch", "TouchSensor"), "sim.touch_sensor"),
    "TouchReading": "kernels.touch.touch_map",
    **dict.fromkeys(("Recording", "SlipWindows", "open_recording"), "store.recordings.read"),
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    value = getattr(importlib.import_module(f"{__name__}.{_MODULES.get(name, 'api')}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
