"""Event images: as the paper draws them, bounded in number and size."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evetac_cli.kernels.event_representation import event_image
from evetac_cli.pages.view import event_images
from evetac_cli.store.recordings.read import open_recording
from tests.pages.view.trials import HEIGHT, SLICES, WIDTH, shown, write_recording


def test_a_picture_is_the_paper_s(trial: Path) -> None:
    """Assert that a PNG holds white, black and grey where the event image has +1, -1 and 0."""
    with open_recording(trial) as recording:
        png, count = event_images.picture(recording, 20, 5)
        events = recording.between(20, 25)
    levels = np.asarray(Image.open(io.BytesIO(png)).convert("L")).astype(int)
    expected = np.array(event_images.GREYS)[event_image(events.x, events.y, events.p, (WIDTH, HEIGHT)) + 1]
    np.testing.assert_array_equal(levels, expected)
    assert count == events.size == 20


def test_many_events_are_drawn_from_the_end(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that at a huge rate only the last events of an image are read and drawn, and all are counted."""
    monkeypatch.setattr(event_images, "MOST_EVENTS", 3)
    with open_recording(trial) as recording:
        png, count = event_images.picture(recording, 20, 5)
        last = recording.between(24, 25)
    levels = np.asarray(Image.open(io.BytesIO(png)).convert("L"))
    drawn = event_image(last.x[1:], last.y[1:], last.p[1:], (WIDTH, HEIGHT))
    np.testing.assert_array_equal(levels != 128, drawn != 0)
    assert count == 20


def test_a_large_frame_is_drawn_coarsely(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a frame of 65535 x 65535 px, which a file may claim, makes a picture of bounded size."""
    path = tmp_path / "a.recording.h5"
    write_recording(path, 10, truth=False)
    with open_recording(path) as recording:
        monkeypatch.setattr(type(recording), "frame_px", (65535, 65535))
        png, _ = event_images.picture(recording, 0, 5)
    assert max(Image.open(io.BytesIO(png)).size) <= event_images.LARGEST_IMAGE_PX


def test_images_are_bounded_and_dense_near_slip(trial: Path) -> None:
    """Assert that there are no more images than asked for, over the whole span, closest around the onsets."""
    data = shown(trial, images=60)
    assert len(data.frame_times) <= 60
    assert (data.frame_times[0], data.frame_times[-1]) == (0, SLICES - 5)
    gaps = np.diff(data.frame_times)
    assert gaps[(data.frame_times[:-1] > 192) & (data.frame_times[:-1] < 204)].max() <= 2 < gaps.max()
    assert len(shown(trial, images=1).frame_times) == 1
