"""RAW as we write it: read by others' programs, in long silence, at the limits of their bits, and cut."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.events import Events
from evetac_cli.formats.exports import export, target_path
from evetac_cli.formats.imports import read_events
from evetac_cli.formats.write import event_files
from tests.formats.test_exports import drawn, refusal, write
from tests.importing import same

faery = pytest.importorskip("faery")


def exported(folder: Path, events: Events, slices: int, **more: Any) -> Path:
    source = write(folder / "a.recording.h5", events, slices, **more)
    target = target_path(source, "raw", folder / "raw")
    export(source, "raw", target)
    return target


def test_other_programs_read_ours(tmp_path: Path) -> None:
    """Assert that faery and expelliarmus find every event with its time since the start, and faery the frame.

    expelliarmus adds a turn of the low bits of EVT3's time wherever the high bits count it already, also in files of
    faery and of its own: of that time the low bits are compared.
    """
    events = drawn(30_000)
    path = exported(tmp_path, events, 8000, t_offset=1_700_000_000_000_000, simulated=True)
    stream = faery.events_stream_from_file(path)
    assert stream.dimensions() == (640, 480)
    rows = np.concatenate(list(stream))
    for ours, theirs in zip(events, ("t", "x", "y", "on"), strict=True):
        np.testing.assert_array_equal(rows[theirs], ours)
    wizard = pytest.importorskip("expelliarmus").Wizard(encoding="evt3")
    rows = wizard.read(path)
    for ours, theirs in zip(events, "txyp", strict=True):
        np.testing.assert_array_equal(rows[theirs].astype(np.int64) & 0xFFF, ours.astype(np.int64) & 0xFFF)
    assert b'"simulated": true' in path.read_bytes()[:1000]


@settings(max_examples=15, deadline=None)
@given(
    gaps_us=st.lists(st.sampled_from([0, 0, 1, 63, 64, 4095, 4096, 70_000, 17_000_000]), min_size=1, max_size=20),
    places=st.randoms(use_true_random=False),
    piece=st.integers(1, 7),
)
def test_silence_of_any_length_is_kept(
    tmp_path_factory: pytest.TempPathFactory, gaps_us: list[int], places: Any, piece: int
) -> None:
    """Assert that clocks of few bits are followed through silence longer than they are, in pieces of any size."""
    t = np.cumsum(np.array(gaps_us, np.int64))
    x, y, p = (np.array([places.randrange(most) for _ in gaps_us]) for most in (3, 3, 2))
    events = Events(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(event_files, "PIECE_EVENTS", piece)
        path = exported(tmp_path_factory.mktemp("silence"), events, int(t[-1]) // 1000 + 1)
    assert same(read_events(path).events, events)


def test_frames_that_fit_are_written_and_larger_ones_refused(tmp_path: Path) -> None:
    """Assert that the corner of the largest frame comes back, and that a pixel more is refused in words."""
    most_px = 2048
    events = drawn(2)._replace(x=np.array([0, most_px - 1], np.uint16), y=np.array([most_px - 1, 0], np.uint16))
    more = {"sensor/frame_px": np.array([most_px, most_px], np.int32)}
    path = exported(tmp_path, events, 9, more=more)
    imported = read_events(path)
    assert same(imported.events, events) and imported.frame_px == (most_px, most_px)
    path.unlink()
    more["sensor/frame_px"] = np.array([most_px + 1, 10], np.int32)
    events = events._replace(y=np.zeros(2, np.uint16))
    words = refusal(lambda: exported(tmp_path, events, 9, more=more))
    assert f"at most {most_px}x{most_px} px" in words and f"{most_px + 1}x10" in words
    assert list(path.parent.iterdir()) == []


@pytest.mark.parametrize("offset", ["x", "9" * 17, str(2**53), "-"])
def test_a_damaged_offset_is_refused(tmp_path: Path, offset: str) -> None:
    """Assert that a line of ours that says anything else than microseconds is not believed."""
    path = exported(tmp_path, drawn(5), 9, t_offset=77)
    assert read_events(path).t_offset_us == 77
    path.write_bytes(path.read_bytes().replace(b"t_offset_us 77", b"t_offset_us " + offset.encode()))
    assert "`t_offset_us` is damaged" in refusal(lambda: read_events(path))
