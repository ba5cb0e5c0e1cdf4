"""Trials that can be made again: the file is what was appended, however many blocks; broken off, nothing is left."""

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.errors import SchemaError
from evetac_cli.events import empty
from evetac_cli.resources import PACKAGE
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings import trial_writer
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.store.recordings.trial_writer import TrialWriter
from tests.make import everything
from tests.store.recordings.test_segments import RECIPE, STATIC, expected, slice_rows, some_events

KNOWN = {**STATIC, "truth/sampled_parameters": "{}"}


def write(path: Path, counts: list[int], every: int = 1) -> TrialWriter:
    """Slices with so many events, and a gripper row in every so-manieth."""
    with TrialWriter(path, KNOWN) as writer:
        for k, count in enumerate(counts):
            writer.append(some_events(k, count), slice_rows(k, every))
        writer.finish(RECIPE)
    return writer


@given(
    st.lists(st.sampled_from([0, 0, 1, 2, 90]), min_size=1, max_size=12),
    st.integers(1, 13),
    st.sampled_from([1, 3, 91, 1000]),
    st.integers(1, 3),
)
@settings(max_examples=10, deadline=None)
def test_the_file_is_what_was_appended(counts: list[int], block_slices: int, block_events: int, every: int) -> None:
    """Assert that every dataset is what was appended, bit for bit, whatever the blocks, and nothing else is left."""
    with TemporaryDirectory() as name, pytest.MonkeyPatch.context() as patch:
        folder = Path(name)
        patch.setattr(trial_writer, "BLOCK_SLICES", block_slices)
        patch.setattr(trial_writer, "BLOCK_EVENTS", block_events)
        write(folder / "new" / "a.recording.h5", counts, every)
        assert everything(folder) == ["new", "new/a.recording.h5"]
        wanted = expected(counts, every)
        with StageFile(folder / "new" / "a.recording.h5", "recording") as file:
            assert file.contents().keys() == wanted.keys()
            for path, value in wanted.items():
                np.testing.assert_array_equal(file.read(path), value, strict=not isinstance(value, str))
            assert file.header["id"] == RECIPE.id


def test_a_trial_without_slices_is_a_valid_file(tmp_path: Path) -> None:
    """Assert that a recording without a slice has its columns all the same."""
    path = tmp_path / "a.recording.h5"
    with TrialWriter(path, STATIC) as writer:
        writer.finish(RECIPE)
    with open_recording(path) as recording:
        assert len(recording) == recording.event_count == 0


def test_a_trial_that_is_not_finished_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that an older file stays, and no other file or folder comes, however far a trial had come."""
    monkeypatch.setattr(trial_writer, "BLOCK_SLICES", 2)
    write(tmp_path / "a.recording.h5", [1, 2])
    for path in (tmp_path / "a.recording.h5", tmp_path / "b.recording.h5"):
        for slices in (0, 1, 5):
            with TrialWriter(path, KNOWN) as writer:
                for k in range(slices):
                    writer.append(some_events(k, 9), slice_rows(k, 1))
            with pytest.raises(ZeroDivisionError), TrialWriter(path, KNOWN) as writer:
                for k in range(slices):
                    writer.append(some_events(k, 9), slice_rows(k, 1))
                raise ZeroDivisionError
    assert everything(tmp_path) == ["a.recording.h5"]
    with open_recording(tmp_path / "a.recording.h5") as recording:
        assert recording.event_count == 3


@pytest.mark.parametrize("at", [0, 4])
def test_ctrl_c_is_heard_at_the_next_slice(at: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that Ctrl-C ends a trial whose file is open within a slice, and leaves neither file nor folder."""
    monkeypatch.setattr(trial_writer, "BLOCK_SLICES", 2)
    appended = []
    with pytest.raises(KeyboardInterrupt), TrialWriter(tmp_path / "new" / "a.recording.h5", KNOWN) as writer:
        for k in range(20):
            writer.append(some_events(k, 9), slice_rows(k, 1))
            appended.append(k)
            if k == at:
                signal.raise_signal(signal.SIGINT)
    assert appended == list(range(at + 1))
    assert everything(tmp_path) == []


def incomplete(writer: TrialWriter) -> None:
    writer.append(some_events(0, 3), {"gripper/t_us": 0})


def a_row_too_few(writer: TrialWriter) -> None:
    writer.append(some_events(0, 3), slice_rows(0, 1))
    writer.append(some_events(1, 3), {})


def wrong_dtype(writer: TrialWriter) -> None:
    events = some_events(0, 3)
    writer.append(events._replace(x=events.x.astype(np.int64)), {})


def outside_the_frame(writer: TrialWriter) -> None:
    events = some_events(0, 9)
    events.x[4] = 640
    writer.append(events, {})
    writer.append(empty(), {})


@pytest.mark.parametrize("block", [1, 1000])
@pytest.mark.parametrize("spoil", [incomplete, a_row_too_few, wrong_dtype, outside_the_frame])
def test_what_makes_no_sense_makes_no_file(
    spoil: Callable[[TrialWriter], None], block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a trial against the schema or its limits is refused in words, in its first block or later."""
    monkeypatch.setattr(trial_writer, "BLOCK_SLICES", block)
    with pytest.raises(SchemaError), TrialWriter(tmp_path / "a.recording.h5", STATIC) as writer:
        spoil(writer)
        writer.finish(RECIPE)
    assert everything(tmp_path) == []


PROGRAM = """
import os, sys
from pathlib import Path
import numpy as np
from evetac_cli.events import Events
from evetac_cli.store.recordings import trial_writer
trial_writer.BLOCK_SLICES = 2
path = Path(sys.argv[1])
known = {"sensor/frame_px": np.array([640, 480], np.int32), "sensor/name": "e", "t_offset": np.int64(0)}
rng = np.random.default_rng(0)
with trial_writer.TrialWriter(path, known) as writer:
    for k in range(6):
        t = np.sort(rng.integers(1000 * k, 1000 * k + 1000, 4000))
        writer.append(Events(t, *(rng.integers(0, 2, t.size).astype(kind) for kind in ("u2", "u2", "u1"))), {})
    os.kill(os.getpid(), 9)
"""


def test_what_a_kill_leaves_is_removed_by_the_next(tmp_path: Path) -> None:
    """Assert that a process that was killed leaves no recording nor folder, and the next leaves nothing of it."""
    program = [sys.executable, "-c", PROGRAM, str(tmp_path / "a.recording.h5")]
    assert subprocess.run(program, check=False, cwd=PACKAGE.parent).returncode == -signal.SIGKILL
    assert [path.name[0] for path in tmp_path.iterdir()] == ["."]
    write(tmp_path / "a.recording.h5", [1, 2])
    assert everything(tmp_path) == ["a.recording.h5"]
