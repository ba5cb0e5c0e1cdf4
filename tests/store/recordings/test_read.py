"""The reading API: a recording by slice, by iteration, by range and in blocks is the same."""

import itertools
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from evetac_cli.errors import InputError, SchemaError
from evetac_cli.events import Events, concatenate
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings import read
from evetac_cli.store.recordings.read import Recording, open_recording
from tests.make import event_arrays


def pieces_of(counts: list[int]) -> list[Events]:
    """One Events per slice, with running numbers in x to tell them apart."""
    done, pieces = 0, []
    for k, count in enumerate(counts):
        x = np.arange(done, done + count, dtype=np.uint16)
        t = np.sort(np.random.default_rng(k).integers(1000 * k, 1000 * k + 1000, count))
        pieces.append(Events(t, x, x + 1, (x % 2).astype(np.uint8)))
        done += count
    return pieces


def write_recording(path: Path, counts: list[int], **more: Any) -> Path:
    """A recording with so many events in each slice."""
    events = concatenate(pieces_of(counts))
    arrays = event_arrays(events, len(counts), (2000, 1900)) | more
    write_stage(path, Recipe("recording", 1, {}, content="0" * 64), arrays)
    return path


def equal(ours: Events, theirs: Events) -> bool:
    """Whether two Events are the same, dtypes included."""
    return all(a.dtype == b.dtype and np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True))


@given(
    st.lists(st.sampled_from([0, 0, 1, 3, 80]), max_size=20),
    st.integers(1, 7),
    st.lists(st.integers(-20, 19), max_size=10),
)
@settings(max_examples=30, deadline=None)
def test_slices_by_index_iteration_and_range_are_equal(counts: list[int], block: int, jumps: list[int]) -> None:
    """Assert that every way to a slice gives the same events, in any order, across the borders of blocks."""
    slices, pieces = len(counts), pieces_of(counts)
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(read, "BLOCK_SLICES", block)
        with open_recording(write_recording(Path(folder) / "a.recording.h5", counts)) as recording:
            assert len(recording) == slices
            assert recording.event_count == sum(counts)
            iterated = list(recording)
            assert len(iterated) == slices
            for k in [*range(slices), *(jump for jump in jumps if -slices <= jump < slices)]:
                assert equal(recording[k], pieces[k])
                assert equal(iterated[k], pieces[k])
                assert equal(recording.between(k % slices, k % slices + 1), pieces[k])
            for start in range(slices + 1):
                for stop in range(start, slices + 1):
                    assert equal(recording.between(start, stop), concatenate(pieces[start:stop]))


@given(st.lists(st.sampled_from([0, 0, 1, 3, 80]), max_size=20), st.integers(1, 25), st.data())
@settings(max_examples=30, deadline=None)
def test_blocks_hold_their_slices(counts: list[int], ms: int, data: st.DataObject) -> None:
    """Assert that blocks of any length, of all slices or a part, hold each slice once, in order, empty ones too."""
    start = data.draw(st.integers(0, len(counts)))
    stop = data.draw(st.one_of(st.none(), st.integers(start, len(counts))))
    pieces, end = pieces_of(counts), len(counts) if stop is None else stop
    with TemporaryDirectory() as folder:
        with open_recording(write_recording(Path(folder) / "a.recording.h5", counts)) as recording:
            blocks = list(recording.blocks(ms, start, stop))
        edges = [*range(start, end, ms), end]
        assert [(block.first, block.stop) for block in blocks] == list(itertools.pairwise(edges))
        for block in blocks:
            own = pieces[block.first : block.stop]
            assert equal(block.events, concatenate(own))
            assert np.diff(block.starts).tolist() == [events.size for events in own]
            assert block.starts[0] == 0
            assert all(equal(*pair) for pair in zip(block.slices(), own, strict=True))


def test_no_block_is_read_before_it_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a wrong length or range of blocks is refused at once, and a right one reads block by block."""
    with open_recording(write_recording(tmp_path / "a.recording.h5", [2] * 6)) as recording:
        for wrong, words in (((0,), "expected: at least 1"), ((1, 2, 1), "out of range"), ((1, 0, 7), "out of range")):
            with pytest.raises(InputError, match=words):
                recording.blocks(*wrong)
        read_ranges: list[tuple[int, int]] = []
        events_of = Recording.events

        def noted(self: Recording, first: int, last: int) -> Events:
            read_ranges.append((first, last))
            return events_of(self, first, last)

        monkeypatch.setattr(Recording, "events", noted)
        blocks = recording.blocks(2)
        assert read_ranges == []
        next(blocks)
        assert read_ranges == [(0, 4)]


@pytest.mark.parametrize("slices", [0, 3])
def test_out_of_range(tmp_path: Path, slices: int) -> None:
    """Assert that a slice that is not there is an IndexError, as in a list, and a range that is not there is named."""
    with open_recording(write_recording(tmp_path / "a.recording.h5", [2] * slices)) as recording:
        for index in (slices, slices + 100, -slices - 1):
            with pytest.raises(IndexError):
                recording[index]
        for start, stop in ((-1, 0), (0, slices + 1), (2, 1), (slices + 1, slices + 1)):
            with pytest.raises(InputError, match=f"expected: 0 <= start <= stop <= {slices}"):
                recording.between(start, stop)
        assert recording.between(slices, slices).size == 0


LIES: dict[str, Callable[[NDArray[np.int64]], NDArray[np.int64]]] = {
    "starts late": lambda starts: starts + (starts == 0),
    "ends early": lambda starts: np.minimum(starts, starts[-1] - 1),
    "ends late": lambda starts: starts + (starts == starts[-1]),
    "goes back": lambda starts: np.array([starts[0], starts[2], starts[1], starts[3]]),
    "negative": lambda starts: np.array([starts[0], -5, starts[2], starts[3]]),
}


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES)
def test_index_that_does_not_count_the_events(tmp_path: Path, lie: Callable[..., NDArray[np.int64]]) -> None:
    """Assert that a recording whose index does not count its events is refused, not read with events cut off."""
    path = write_recording(tmp_path / "a.recording.h5", [2, 3, 4])
    with h5py.File(path, "r+") as h5:
        h5["ms_to_idx"][...] = lie(h5["ms_to_idx"][()])
    with pytest.raises(SchemaError, match="ms_to_idx is impossible"):
        open_recording(path)
    path.unlink()


def test_damaged_events(tmp_path: Path) -> None:
    """Assert that damage in the events of one block is an error in words for its slices."""
    path = write_recording(tmp_path / "a.recording.h5", [100, 100])
    with h5py.File(path) as h5:
        chunk = h5["events/x"].id.get_chunk_info(0)
    damaged = bytearray(path.read_bytes())
    damaged[chunk.byte_offset : chunk.byte_offset + chunk.size] = bytes(chunk.size)
    path.write_bytes(damaged)
    with pytest.raises(InputError, match=r"events/x cannot be read(.|\n)*damaged"), open_recording(path) as recording:
        list(recording)
