"""The event frames of the LeRobot camera in examples/: each once, in order and complete, from a virtual camera.

Its clock waits, so that nothing here depends on how fast the machine is. The plug-in inside of LeRobot is tried in
tests/formats/test_lerobot_library.py, for a minute.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.devices import EventCamera
from evetac_cli.devices.cameras import ReplayCamera
from evetac_cli.devices.dvxplorer.camera import DvxplorerCamera
from evetac_cli.devices.virtual.dvxplorer import VirtualDvxplorer
from evetac_cli.devices.virtual.word_sources import random_event_words
from evetac_cli.store.recordings.read import Recording
from tests import small_files
from tests.patience import PATIENCE_S, patient_words, until

PLUG_IN = Path(__file__).resolve().parents[1] / "examples" / "lerobot_camera_evetac" / "lerobot_camera_evetac"
sys.path.insert(0, str(PLUG_IN))  # the module that knows nothing of lerobot, which is not installed here
from event_frames import EventFrames  # noqa: E402

SIZE_PX, RATE_HZ = (160, 120), 200.0
PERIOD_MS, TIMES = 250, 4
PER_PERIOD = PERIOD_MS // 5


@contextmanager
def frames_of(camera: EventCamera, shown: int = 1) -> Iterator[EventFrames]:
    frames = EventFrames(camera, (640, 480), SIZE_PX, RATE_HZ, shown)
    try:
        yield frames
    finally:
        frames.close()


@pytest.fixture
def virtual() -> DvxplorerCamera:
    """A second of words at random, a quarter of a second four times, whose time waits for who reads the slices."""
    words = random_event_words(200_000, PERIOD_MS / 1000, np.random.default_rng(0))
    return DvxplorerCamera(backend=VirtualDvxplorer(patient_words(words, times=TIMES, period_ms=PERIOD_MS)))


def test_each_frame_of_a_virtual_camera_comes_once(virtual: DvxplorerCamera) -> None:
    """Assert all frames of a second in order, each unlike the next, and the same ones in each period of the words."""
    count = TIMES * PER_PERIOD - 2  # the last slices close when later events come, and none do
    with frames_of(virtual) as frames:
        taken = [frames.next(PATIENCE_S) for _ in range(count)]
        assert frames.frames_lost == 0 and not any(virtual.counted.values())
    assert [frame.number for frame in taken] == list(range(count))
    greys = np.stack([frame.grey for frame in taken])
    assert greys.shape == (count, *SIZE_PX[::-1]) and (greys[0] != 128).any()
    assert (greys[1:] != greys[:-1]).any(axis=(1, 2)).all()
    again = (greys[PER_PERIOD:] == greys[:-PER_PERIOD]).all(axis=(1, 2))
    assert again[1:].all()  # but for the first frame, before whose first slice the camera was not running


def test_frames_of_a_replay_are_those_of_the_recording(tmp_path: Path) -> None:
    """Assert the counts of `Recording.frames`, and that whoever asks for more is told that the stream has ended."""
    path = tmp_path / "a.recording.h5"
    small_files.recording(path)
    with Recording(path) as recording:
        images = np.concatenate([block.images for block in recording.frames(RATE_HZ, SIZE_PX, polarity="signed")])
    with frames_of(ReplayCamera(path, paced=False)) as frames:
        taken = [frames.next(PATIENCE_S).grey.astype(int) for _ in images]
        with pytest.raises(EOFError, match="has ended"):
            frames.next(PATIENCE_S)
        with pytest.raises(EOFError, match="has ended"):
            frames.latest()
    np.testing.assert_array_equal(np.rint((np.stack(taken) - 128) * 16 / 127), images[:, 0])


def test_a_picture_shows_the_last_frames(virtual: DvxplorerCamera) -> None:
    """Assert four frames in reading order up to the newest, which is not given twice, and how old it is."""
    with frames_of(virtual, shown=4) as frames:
        while (last := frames.next(PATIENCE_S)).number < 6:
            pass
        picture = frames.newest(PATIENCE_S)
        assert picture.shape == (2 * SIZE_PX[1], 2 * SIZE_PX[0])
        tiles = [half for row in np.vsplit(picture, 2) for half in np.hsplit(row, 2)]
        assert all((one != other).any() for one, other in zip(tiles[1:], tiles[:-1], strict=True))
        assert frames.next(PATIENCE_S).number > last.number
        shown, age_s = frames.latest()
        assert shown.shape == picture.shape and 0 <= age_s < PATIENCE_S


def test_frames_that_nobody_takes_are_counted(virtual: DvxplorerCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the oldest goes, the newest stays, and both add up."""
    monkeypatch.setattr("event_frames.WAITING_S", 0.05)
    with frames_of(virtual) as frames:
        assert until(lambda: frames.frames_lost >= 20, every_s=0.001)
        first = frames.next(PATIENCE_S)
        assert first.number >= 20


def test_a_camera_that_fails_is_told_to_who_asks(tmp_path: Path) -> None:
    """Assert that the error of a reading thread reaches the reader, and that closing twice does nothing."""

    class Broken(ReplayCamera):
        def read(self) -> None:
            raise OSError("unplugged")

    path = tmp_path / "a.recording.h5"
    small_files.recording(path)
    with frames_of(Broken(path, paced=False)) as frames:
        with pytest.raises(OSError, match="unplugged"):
            frames.next(PATIENCE_S)
        frames.close()
