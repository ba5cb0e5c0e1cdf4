"""Labels of a recording by the methods of `label` that need no person.

They apply kernels/labelling to the window and the gel of the recording, or copy the truth of a simulation.
"""

import numpy as np

from evetac_cli.commands.label import Label
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.jobs import Progress, silent
from evetac_cli.kernels.labelling import flow
from evetac_cli.kernels.tracking.presets import PRESETS
from evetac_cli.stages.related_files import no_truth
from evetac_cli.store.calibration import MAKE_GRID
from evetac_cli.store.recordings.read import Recording, ramp_start

# The border of the window is the gel's cut edge, which moves with the gel and is part of neither region.
EDGE_IN_GEL_PX = 10
EDGE_IN_WINDOW_PX = 25


def compute(recording: Recording, params: Label, progress: Progress = silent) -> flow.Labels:
    """Return the labels of a recording by the chosen method; InputError if the recording lacks required data."""
    if params.from_start and params.method != "truth":
        expected = "--method truth"
        raise InputError("before the ramp only ground truth exists", where="--from-start", expected=expected)
    if params.method == "truth":
        return from_truth(recording, params.after_ms, from_start=params.from_start)
    window, gel = regions(recording)
    slices, start = len(recording), ramp_start(recording)

    def between(first: int, last: int) -> Events:
        progress(first, slices)
        return recording.between(first, last)

    try:
        if params.method == "event-flow":
            dots = recording.dot_xy_px
            if dots is None:
                hint = f"{MAKE_GRID} to evetac record, or label with --method farneback"
                raise InputError("the recording has no dot grid", where=str(recording.path), hint=hint)
            from evetac_cli.kernels.labelling import event_flow

            constants = event_flow.EventFlowConstants(
                slip_distance_px=params.slip_distance_px, after_ms=params.after_ms
            )
            of_dots = float(recording.read("sensor/dot_radius_px")), recording.sensitivity.contrast_over_threshold
            arguments = dots.reshape(-1, 2), PRESETS["stable"].for_dots(*of_dots), constants, start
            return event_flow.label(between, slices, window, recording.frame_px, *arguments)
        names = flow.FlowConstants.__dataclass_fields__
        parameters = {name: value for name, value in recipe_of(params).items() if name in names}
        return flow.label(between, slices, window, gel, flow.FlowConstants(**parameters), start)
    except ValueError as error:
        hint = "the object needs a texture that is visible in the window; a scene has one with record --texture on"
        raise InputError(f"slip cannot be labelled: {error}", where=str(recording.path), hint=hint) from error


def regions(recording: Recording) -> tuple[flow.Region, flow.Region]:
    """Return the regions of the window and the gel, without the cut edge between them; InputError without a window."""
    if recording.window_px is None:
        hint = "only a cut gel shows slip: evetac calibrate --gel cut makes its grid for record --calibration"
        raise InputError("slip cannot be labelled: the gel has no window", where=str(recording.path), hint=hint)
    x0, y0, x1, y1 = recording.window_px
    width, height = recording.frame_px
    # The gel is on the side of the window with most of the frame: at the left in an upright Evetac.
    area = {"left": x0 * height, "right": (width - x1) * height, "above": y0 * width, "below": (height - y1) * width}
    side = max(area, key=lambda name: area[name])
    if side == "left":
        return (min(x0 + EDGE_IN_WINDOW_PX, x1 - 1), y0, x1, y1), (0, 0, max(x0 - EDGE_IN_GEL_PX, 0), height)
    if side == "right":
        gel = (min(x1 + EDGE_IN_GEL_PX, width), 0, width, height)
        return (x0, y0, max(x1 - EDGE_IN_WINDOW_PX, x0 + 1), y1), gel
    if side == "above":
        return (x0, min(y0 + EDGE_IN_WINDOW_PX, y1 - 1), x1, y1), (0, 0, width, max(y0 - EDGE_IN_GEL_PX, 0))
    gel = (0, min(y1 + EDGE_IN_GEL_PX, height), width, height)
    return (x0, y0, x1, max(y1 - EDGE_IN_WINDOW_PX, y0 + 1)), gel


def from_truth(recording: Recording, after_ms: int, *, from_start: bool = False) -> flow.Labels:
    """Return labels from the gross slip of a simulation, up to `after_ms` after its onset; InputError without truth.

    They begin in the same slice as those of the other methods, or with `from_start` in the first slice, since nothing
    is unknown here. An object may slide a little while its weight is handed over: these slices are left out, and the
    onset is that of the ramp.
    """
    if not recording.has("truth/slip"):
        raise no_truth(recording.path, "label with another --method")
    slips = recording.read("truth/slip")
    labels = slips.astype(np.int8)
    start = ramp_start(recording)
    # as for the other methods: a trial begins when the object is held
    labels[:start] = np.where((slips[:start] == 0) & from_start, 0, -1)
    slipping = start + np.flatnonzero(slips[start:])
    onset = int(slipping[0]) if len(slipping) else -1
    confidence = float("nan")
    if onset >= 0:
        stop = onset + max(after_ms, 1)
        confidence = float(slips[onset:stop].mean())
        labels[stop:] = -1
    no_flow = np.full(len(slips), np.nan, np.float32)
    return flow.Labels(labels, no_flow, onset, confidence, 0, onset, onset)
