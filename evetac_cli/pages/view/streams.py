"""Other streams of a trial in view: columns of numbers over time, and the camera images at each time."""

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.pages.shared import BLUE, GREEN, INK, ORANGE, PINK
from evetac_cli.pages.view.time_series import decimated, timed
from evetac_cli.pages.view.trial_files import OpenTrial
from evetac_cli.pages.view.view_data import CameraImages, Panel, ViewData
from evetac_cli.store.recordings import streams
from evetac_cli.store.recordings.read import Recording
from evetac_cli.text_files import parse_json

COLOURS = (BLUE, ORANGE, GREEN, PINK, INK)  # as many columns per axis
MOST_PANELS = 12
MOST_CODES = 16
MOST_IMAGES = 100  # of all cameras together: 1 MB of a page, 4 MB for noisy images
LARGEST_IMAGE_PX = 320
JPEG_QUALITY = 80


def stream_panels(trial: OpenTrial, span: tuple[int, int], notes: list[str]) -> list[Panel]:
    """Return the columns of each stream, up to five of one unit per axis; add a note if there are too many to draw."""
    recording = trial.recording
    if recording is None:
        return []
    axes: list[tuple[str, str, list[str]]] = []  # name of the stream, unit, columns
    paths = recording.contents()
    for name in streams.names(paths):
        group = f"{streams.GROUP}/{name}"
        units = parse_json(recording.read(f"{group}/about")).get("units", {})
        by_unit: dict[str, list[str]] = {}
        for path in paths:
            column = path.rpartition("/")[2]
            if path.startswith(f"{group}/") and column not in streams.TAKEN:
                by_unit.setdefault(units.get(column, ""), []).append(column)
        most = len(COLOURS)
        for unit, alike in by_unit.items():
            axes += [(name, unit, alike[at : at + most]) for at in range(0, len(alike), most)]
    if left_out := sum(len(columns) for _, _, columns in axes[MOST_PANELS:]):
        notes.append(f"Streams: {left_out} columns beyond the first {MOST_PANELS} charts are not drawn.")
    panels = [_panel(recording, span, *axis) for axis in axes[:MOST_PANELS]]
    return [panel for panel in panels if panel.lines]


def _panel(recording: Recording, span: tuple[int, int], name: str, unit: str, columns: list[str]) -> Panel:
    group = f"{streams.GROUP}/{name}"
    t_s, first, _ = timed(recording, f"{group}/t_us", span)

    def read(start: int, stop: int) -> NDArray[Any]:
        rows = [recording.read(f"{group}/{column}", first + start, first + stop) for column in columns]
        return np.stack(rows, axis=1)

    lines = decimated(dict(zip(columns, COLOURS, strict=False)), t_s, read)
    title = f"{name}, {columns[0]}" if len(columns) == 1 else name
    return Panel(title, unit, lines, marks=not unit and all(_are_codes(line.value) for line in lines))


def _are_codes(values: NDArray[np.float64]) -> bool:
    """Whether numbers without a unit are codes, such as the source of a trigger, and not a quantity."""
    distinct = np.unique(values[np.isfinite(values)])
    return len(distinct) <= MOST_CODES and bool((distinct == np.rint(distinct)).all())


def draw_cameras(view: ViewData, trial: OpenTrial) -> None:
    """Add the last image of each camera before the end of each event image, reduced; thinned if there are too many."""
    recording = trial.recording
    if recording is None:
        return
    paths = recording.contents()
    cameras = [name for name in streams.names(paths) if f"{streams.GROUP}/{name}/frames" in paths]
    ends_us = (view.ends + 1) * SLICE_US
    for name in cameras:
        group = f"{streams.GROUP}/{name}"
        rows = np.searchsorted(recording.read(f"{group}/t_us"), ends_us) - 1  # -1 before its first image
        wanted = np.unique(rows[rows >= 0])
        step = -(-len(wanted) // max(1, MOST_IMAGES // len(cameras)))
        kept = wanted[:: max(step, 1)]
        if step > 1:
            view.notes.append(f"Images of {name}: one in {step} is kept, to keep the page small.")
        images = [_jpeg(recording.read(f"{group}/frames", row, row + 1)[0]) for row in kept.tolist()]
        shown = np.searchsorted(kept, rows, side="right") - 1
        view.cameras.append(CameraImages(name, images, shown.tolist()))


def _jpeg(frame: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    image = Image.fromarray(frame[..., 0] if frame.shape[-1] == 1 else frame)
    image.thumbnail((LARGEST_IMAGE_PX, LARGEST_IMAGE_PX))
    written = io.BytesIO()
    image.save(written, "JPEG", quality=JPEG_QUALITY)
    return written.getvalue()
