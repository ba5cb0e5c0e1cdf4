"""The event images of a trial in view, and the positions of the dots in them.

Their number is limited; they are dense around onsets of slip and the slice with most events.
"""

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICES_PER_S, Events
from evetac_cli.jobs import Progress
from evetac_cli.kernels.event_representation import event_image
from evetac_cli.pages.view.trial_files import OpenTrial
from evetac_cli.pages.view.view_data import ViewData
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import Recording

IMAGE_BYTES = 9_000_000  # of PNG per page; a third more as base64
DOT_PLACES = 150_000  # dots times images
LARGEST_IMAGE_PX = 1280
MOST_EVENTS = 4_000_000  # drawn in one image; earlier ones are left out
DENSE_MS = 2  # step between images near an onset or the busiest slice
DENSE_SHARE = 0.4  # of all images
GREYS = (0, 128, 255)  # darker, nothing, brighter


def frame_size_px(trial: OpenTrial) -> tuple[int, int]:
    """Return width and height of the sensor in px; 0 if no file has them."""
    if trial.recording is not None:
        return trial.recording.frame_px
    width, height = trial.tracks.read("sensor/frame_px").tolist() if trial.tracks is not None else (0, 0)
    return width, height


def window_px(trial: OpenTrial) -> tuple[int, int, int, int] | None:
    """Return the corners x0, y0, x1, y1 of the window in px, or None."""
    for file in (trial.recording, trial.tracks):
        if file is not None and file.has("sensor/window_px"):
            x0, y0, x1, y1 = file.read("sensor/window_px").tolist()
            return x0, y0, x1, y1
    return None


def choose_frame_times(view: ViewData, trial: OpenTrial, most: int) -> None:
    """Choose the times of at most `most` images: evenly spaced, and dense around onsets and the busiest slice."""
    start, stop = view.span
    last = max(start, stop - view.shown_ms)
    if trial.tracks is not None:  # positions of dots are in the page too
        dots = int(np.prod(trial.tracks.read("sensor/dot_xy_px").shape[:2]))
        most = max(1, min(most, DOT_PLACES // max(dots, 1)))
    if last - start < most:
        view.frame_times = np.arange(start, last + 1)
        return
    view.dense = {f"onset, {source}": slice_ for source, slice_ in view.onsets.items() if slice_ is not None}
    view.dense |= view.contact_times
    if trial.recording is not None:
        per_slice = np.diff(trial.recording.starts[start : stop + 1])
        view.dense["busiest"] = start + int(np.argmax(per_slice))
    places = list(dict.fromkeys(view.dense.values()))
    each = int(most * DENSE_SHARE / max(len(places), 1))
    uniform = np.linspace(start, last, most - each * len(places)).astype(np.int64)
    near = [place - view.shown_ms + DENSE_MS * (np.arange(each) - each // 2) for place in places]
    view.frame_times = np.unique(np.clip(np.concatenate((uniform, *near)), start, last))


def draw_pictures(view: ViewData, trial: OpenTrial, progress: Progress) -> None:
    """Draw a PNG at each time; if they make the page too large, drop every other one, repeatedly."""
    recording = trial.recording
    if recording is None:
        return
    pictures: dict[int, tuple[bytes, int]] = {}
    step = 1
    size = 0
    times = view.frame_times
    for number, start in enumerate(times.tolist()):
        progress(number, len(times))
        if number % step:
            continue
        pictures[number] = picture(recording, start, view.shown_ms)
        size += len(pictures[number][0])
        while size > IMAGE_BYTES and len(pictures) > 1:
            step *= 2
            pictures = {number: pair for number, pair in pictures.items() if number % step == 0}
            size = sum(len(png) for png, _ in pictures.values())
    if step > 1:
        view.notes.append(
            f"Event images: only every {step}th of {len(times)} is kept, to keep the page small; "
            "use --start-s and --stop-s to show a part in more detail."
        )
    view.frame_times = times[list(pictures)]
    view.pictures = [png for png, _ in pictures.values()]
    view.events = [events for _, events in pictures.values()]


def picture(recording: Recording, start: int, shown_ms: int, largest_px: int = LARGEST_IMAGE_PX) -> tuple[bytes, int]:
    """Return events of a few ms as in the paper (white brighter, black darker, grey none) as PNG, and their number."""
    from PIL import Image

    first, last = (int(recording.starts[at]) for at in (start, min(start + shown_ms, len(recording))))
    events = recording.events(max(first, last - MOST_EVENTS), last)
    width, height = recording.frame_px
    coarse = -(-max(width, height) // largest_px)
    if coarse > 1:
        events = Events(events.t, events.x // np.uint16(coarse), events.y // np.uint16(coarse), events.p)
    pixels = event_image(events.x, events.y, events.p, (-(-width // coarse), -(-height // coarse)))
    image = Image.fromarray((pixels + 1).astype(np.uint8))
    image.putpalette(bytes(level for level in GREYS for _ in range(3)))
    written = io.BytesIO()
    image.save(written, "PNG", bits=2, compress_level=9)
    return written.getvalue(), last - first


def telling_frame(view: ViewData) -> int:
    """Return the image to open with, which shows an event: at slip's onset, else the grip, else the first touch.

    If there is none of these, it is the image with most events.
    """
    for at in (*view.onsets.values(), *view.contact_times.values()):
        if at is None:
            continue
        frame = int(np.argmin(np.abs(view.frame_times - at)))
        if not view.events or view.events[frame]:
            return frame
    return int(np.argmax(view.events)) if view.events else 0


def place_dots(view: ViewData, trial: OpenTrial) -> None:
    """Set the positions of the dots at the end of each image, tracked and true; NaN after the end of the tracks."""
    ends = view.ends
    if trial.tracks is not None:
        view.rest_xy_px = trial.tracks.read("sensor/dot_xy_px").reshape(-1, 2)
        tracked = trial.tracks.length("dot_xy_px")
        if tracked < view.slices:
            end_s, missing_ms = tracked / SLICES_PER_S, view.slices - tracked
            view.notes.append(f"The tracks end at {end_s:.3f} s, {missing_ms} ms before the end of the recording.")
        view.dot_xy_px = read_rows(trial.tracks, "dot_xy_px", ends, np.nan).astype(np.float32)
        view.lost = read_rows(trial.tracks, "lost", ends, 0).astype(np.uint8)
    recording = trial.recording
    if recording is None:
        return
    if view.rest_xy_px is None and recording.dot_xy_px is not None:
        view.rest_xy_px = recording.dot_xy_px.reshape(-1, 2)
    if recording.has("truth/dot_xy_px"):
        dots = recording.read("truth/dot_xy_px", 0, 1).shape[1]
        if dots * len(ends) <= DOT_PLACES:
            view.true_xy_px = read_rows(recording, "truth/dot_xy_px", ends, np.nan).astype(np.float32)


def read_rows(file: StageFile, path: str, rows: NDArray[np.int64], absent: float) -> NDArray[Any]:
    """Return some rows of a dataset, read in blocks; `absent` for rows beyond its end."""
    length = file.length(path)
    shape = file.contents()[path][1]
    values = np.full((len(rows), *shape[1:]), absent)
    block, first = None, 0
    for at, row in enumerate(rows.tolist()):
        if row >= length:
            continue
        if block is None or not first <= row < first + len(block):
            first = row - row % 512
            block = file.read(path, first, first + 512)
        values[at] = block[row - first]
    return values
