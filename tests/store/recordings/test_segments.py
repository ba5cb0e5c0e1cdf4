"""Recordings that grow: joined they are what was appended, however they were cut; and what is left when they break."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.errors import InputError, SchemaError
from evetac_cli.events import Events, concatenate, empty, slice_starts
from evetac_cli.resources import PACKAGE
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.provenance import Recipe, content_digest
from evetac_cli.store.recordings import segments
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.store.recordings.segments import RecordingWriter
from tests.make import everything
from tests.patience import PATIENCE_S

STATIC: dict[str, Any] = {
    "sensor/frame_px": np.array([640, 480], np.int32),
    "sensor/name": "evetac",
    "t_offset": np.int64(0),
}
RECIPE = Recipe("recording", 1, {"object": 8}, seed=3, simulated_source=True)


@pytest.fixture(autouse=True)
def no_timer(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Segments are closed by the tests, not by the time that passes."""
    monkeypatch.setattr(segments, "SEGMENT_S", 1e9)
    yield


def some_events(k: int, count: int) -> Events:
    """`count` events of slice k, different in every slice."""
    rng = np.random.default_rng([k, count])
    return Events(
        np.sort(rng.integers(1000 * k, 1000 * (k + 1), count)),
        rng.integers(0, 640, count).astype(np.uint16),
        rng.integers(0, 480, count).astype(np.uint16),
        rng.integers(0, 2, count).astype(np.uint8),
    )


# What a recording may have of every slice (truth) and of every gripper command, whatever the schema says today.
TRUTH, GRIPPER = (
    [row for row in schema.load("recording").datasets if row.path.startswith(group + "/") and row.dims]
    for group in ("truth", "gripper")
)


def slice_rows(k: int, every: int) -> dict[str, Any]:
    """Truth in every slice, the gripper in every so-manieth; scalars as plain Python numbers."""
    rows: dict[str, Any] = {}
    for number, row in enumerate(TRUTH + (GRIPPER if k % every == 0 else [])):
        value = (k + number) % 200 if "int" in row.dtype else k / 7 + number
        if row.limits.one_of or row.limits.maximum == 1:
            value = (k + number) % 2
        shape = [4 if isinstance(dim, str) else dim for dim in (row.dims or ())[1:]]
        rows[row.path] = np.full(shape, value) if shape else value
    return rows


def expected(counts: list[int], every: int) -> dict[str, Any]:
    """The datasets of a recording of these slices, made without a writer."""
    events = concatenate([some_events(k, count) for k, count in enumerate(counts)])
    rows = [slice_rows(k, every) for k in range(len(counts))]
    arrays = {f"events/{name}": getattr(events, name) for name in Events._fields}
    arrays |= {"ms_to_idx": slice_starts(events.t, len(counts)), **STATIC, "truth/sampled_parameters": "{}"}
    for described in (*TRUTH, *GRIPPER):
        column = [row[described.path] for row in rows if described.path in row]
        arrays[described.path] = np.array(column, described.dtype)
    return arrays


def write(path: Path, counts: list[int], cuts: set[int], every: int) -> dict[str, Any]:
    """Append slices with `counts` events, closing a segment before each slice in `cuts`; returns the header."""
    writer = RecordingWriter(path, STATIC)
    for k, count in enumerate(counts):
        if k in cuts:
            writer.close_segment()
        writer.append(some_events(k, count), slice_rows(k, every))
    return writer.finish(RECIPE, {"truth/sampled_parameters": "{}"})


@given(
    st.lists(st.sampled_from([0, 0, 1, 2, 90]), min_size=1, max_size=12),
    st.sets(st.integers(0, 11)),
    st.sets(st.integers(0, 11)),
    st.integers(1, 3),
)
@settings(max_examples=25, deadline=None)
@pytest.mark.slow
def test_joined_is_what_was_appended(counts: list[int], cuts: set[int], other_cuts: set[int], every: int) -> None:
    """Assert that datasets are what was appended, and their digest too, whatever the cuts, and nothing else is left."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        header = write(folder / "a.recording.h5", counts, cuts, every)
        assert everything(folder) == ["a.recording.h5"]
        wanted = expected(counts, every)
        with StageFile(folder / "a.recording.h5", "recording") as file:
            assert file.contents().keys() == wanted.keys()
            for path, value in wanted.items():
                np.testing.assert_array_equal(file.read(path), value, strict=not isinstance(value, str))
            assert file.header == header
            assert header["content"] == content_digest({path: file.read(path) for path in file.contents()})
        again = write(folder / "b.recording.h5", counts, other_cuts, every)
        assert (again["seed"], again["content"], again["id"]) == (None, header["content"], header["id"])


def test_segments_close_by_themselves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a segment is written when enough events wait or enough time has passed, and not before."""
    writer = RecordingWriter(tmp_path / "a.recording.h5", STATIC)
    monkeypatch.setattr(segments, "SEGMENT_EVENTS", 10)
    for k in range(5):
        writer.append(some_events(k, 4))
    assert everything(writer.folder) == ["000000.h5", "lock", "static.h5"]
    monkeypatch.setattr(segments, "SEGMENT_S", 0.0)
    writer.append(empty())
    assert everything(writer.folder) == ["000000.h5", "000001.h5", "lock", "static.h5"]
    assert not (tmp_path / "a.recording.h5").exists()
    writer.close_segment()
    assert len(everything(writer.folder)) == 4
    writer.finish(RECIPE)
    with open_recording(tmp_path / "a.recording.h5") as recording:
        assert [events.size for events in recording] == [4, 4, 4, 4, 4, 0]


KILLED = """
import os, sys
from pathlib import Path
import numpy as np
from evetac_cli.events import Events
from evetac_cli.store.layout import schema
from evetac_cli.store.recordings import segments
segments.SEGMENT_S = 1e9
static = {"sensor/frame_px": np.array([640, 480], np.int32), "sensor/name": "e", "t_offset": np.int64(0)}
writer = segments.RecordingWriter(Path(sys.argv[1]), static)
for k in range(5):
    one = np.ones(1)
    writer.append(Events((1000 * k * one).astype(np.int64), one.astype("u2"), one.astype("u2"), one.astype("u1")))
    if k in (1, 3):
        writer.close_segment()
os.kill(os.getpid(), 9)
"""


@pytest.fixture
def broken_off(tmp_path: Path) -> Path:
    """The path of a recording whose process was killed after two segments."""
    path = tmp_path / "a.recording.h5"
    subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False, timeout=PATIENCE_S, cwd=PACKAGE.parent)
    return path


def test_killed_recorder_leaves_closed_segments(broken_off: Path) -> None:
    """Assert that all closed segments of a killed process are whole, and can be joined as they are."""
    folder = broken_off.parent / "a.recording.part"
    assert everything(broken_off.parent) == [
        "a.recording.part",
        *(f"a.recording.part/{name}" for name in ("000000.h5", "000001.h5", "lock", "static.h5")),
    ]
    segments.join(folder, broken_off, RECIPE, {}, sorted(folder.glob("[0-9]*.h5")))
    with open_recording(broken_off) as recording:
        assert recording.between(0, len(recording)).t.tolist() == [0, 1000, 2000, 3000]


def test_leftover_is_refused(broken_off: Path) -> None:
    """Assert that a recording that broke off is not written over, again and again, and stays as it is."""
    before = {path: path.read_bytes() for path in broken_off.parent.rglob("*.h5")}
    for _ in range(2):
        with pytest.raises(InputError, match="interrupted recording") as refused:
            RecordingWriter(broken_off, STATIC)
        assert "a.recording.part" in str(refused.value)
    assert {path: path.read_bytes() for path in broken_off.parent.rglob("*.h5")} == before


@pytest.mark.parametrize("name", ["notes.txt", "static.txt", "a.recording.h5"])
def test_files_of_others_are_not_deleted(tmp_path: Path, name: str) -> None:
    """Assert that a file that no recording makes is named and stays, and so does all beside it."""
    folder = tmp_path / "a.recording.part"
    folder.mkdir()
    for file in (name, "static.tmp"):
        (folder / file).write_text("x")
    with pytest.raises(InputError, match="not from a recording") as refused:
        RecordingWriter(tmp_path / "a.recording.h5", STATIC)
    assert name in str(refused.value)
    assert everything(folder) == sorted([name, "static.tmp"])


def test_second_writer_is_refused(tmp_path: Path) -> None:
    """Assert that two recordings into one file are refused at the same time, and the first is not disturbed."""
    path = tmp_path / "a.recording.h5"
    first = RecordingWriter(path, STATIC)
    first.append(some_events(0, 5))
    first.close_segment()
    with pytest.raises(InputError, match="another process is recording here"):
        RecordingWriter(path, STATIC)
    with pytest.raises(InputError, match="another process is recording here"):
        segments.refuse_leftover(path)
    first.append(some_events(1, 6))
    first.finish(RECIPE)
    with open_recording(path) as recording:
        assert [events.size for events in recording] == [5, 6]
    RecordingWriter(path, STATIC).discard()


def incomplete(writer: RecordingWriter) -> None:
    writer.append(some_events(0, 3), {"gripper/t_us": 0})


def a_row_too_few(writer: RecordingWriter) -> None:
    writer.append(some_events(0, 3), slice_rows(0, 1))
    writer.append(some_events(1, 3), slice_rows(1, 1))
    writer.append(some_events(2, 3), {})


def wrong_dtype(writer: RecordingWriter) -> None:
    events = some_events(0, 3)
    writer.append(events._replace(x=events.x.astype(np.int64)))


def test_what_is_not_a_recording_is_refused_and_kept(tmp_path: Path) -> None:
    """Assert that a recording against the schema is refused in words, and what was recorded stays in its folder."""
    for number, spoil in enumerate((incomplete, a_row_too_few, wrong_dtype)):
        path = tmp_path / f"{number}.recording.h5"
        writer = RecordingWriter(path, STATIC)
        spoil(writer)
        with pytest.raises(SchemaError, match="not a valid recording"):
            writer.finish(RECIPE)
        assert not path.exists()
        assert everything(writer.folder) == ["000000.h5", "lock", "static.h5"]
        writer.discard()
    assert everything(tmp_path) == []


def test_finish_can_be_tried_again(tmp_path: Path) -> None:
    """Assert that a target that cannot be written costs nothing: all is in the folder, and a second try succeeds."""
    path = tmp_path / "a.recording.h5"
    writer = RecordingWriter(path, STATIC)
    writer.append(some_events(0, 3))
    path.mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        writer.finish(RECIPE)
    path.rmdir()
    writer.finish(RECIPE)
    with open_recording(path) as recording:
        assert recording.event_count == 3
    assert everything(tmp_path) == ["a.recording.h5"]


FULL_DISK = """
import resource, sys
from pathlib import Path
import numpy as np
from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.store.layout import schema
from evetac_cli.store.recordings import segments
from evetac_cli.store.layout.provenance import Recipe
segments.SEGMENT_S = 1e9
static = {"sensor/frame_px": np.array([640, 480], np.int32), "sensor/name": "e", "t_offset": np.int64(0)}
writer = segments.RecordingWriter(Path(sys.argv[1]), static)
rng = np.random.default_rng(0)
def piece(k, count):
    t = np.sort(rng.integers(1000 * k, 1000 * k + 1000, count))
    return Events(t, *(rng.integers(0, 2, count).astype(kind) for kind in ("u2", "u2", "u1")))
writer.append(piece(0, 1000))
writer.close_segment()
writer.append(piece(1, 100000))
limit = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, limit[1]))
for attempt in (writer.close_segment, writer.close_segment):
    try:
        attempt()
    except InputError as error:
        print("segment", "File too large" in str(error), "free some space" in str(error))
print(sorted(path.name for path in writer.folder.iterdir()))
resource.setrlimit(resource.RLIMIT_FSIZE, limit)
writer.close_segment()
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, limit[1]))
try:
    writer.finish(Recipe("recording", 1, {}))
except InputError as error:
    print("join", "File too large" in str(error))
resource.setrlimit(resource.RLIMIT_FSIZE, limit)
writer.finish(Recipe("recording", 1, {}))
"""


def test_full_disk(tmp_path: Path) -> None:
    """Assert that a full disk while recording or joining is an error in words, and nothing is lost when it has room.

    A limit on the size of files stands in for the full disk: the system refuses to write in the same way.
    """
    path = tmp_path / "a.recording.h5"
    run = [sys.executable, "-c", FULL_DISK, str(path)]
    done = subprocess.run(run, capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=PACKAGE.parent)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        "segment True True",
        "segment True True",
        "['000000.h5', 'lock', 'static.h5']",
        "join True",
    ]
    with open_recording(path) as recording:
        assert [events.size for events in recording] == [1000, 100000]
    assert everything(tmp_path) == ["a.recording.h5"]


def test_moved_folder(tmp_path: Path) -> None:
    """Assert that a folder that was moved during a recording is named as the cause, not a full disk."""
    writer = RecordingWriter(tmp_path / "here" / "a.recording.h5", STATIC)
    writer.append(some_events(0, 5))
    (tmp_path / "here").rename(tmp_path / "there")
    with pytest.raises(InputError, match="moved or removed") as refused:
        writer.close_segment()
    assert "free some space" not in str(refused.value)
    writer.leave()


def test_segments_tell_their_place_and_their_bytes(tmp_path: Path) -> None:
    """Assert that a segment says with which slice it begins, and carries a checksum of every dataset."""
    writer = RecordingWriter(tmp_path / "a.recording.h5", STATIC)
    for k in range(5):
        writer.append(some_events(k, 2), {"gripper/t_us": k})
        if k in (1, 3):
            writer.close_segment()
    writer.close_segment()
    firsts = []
    for path in sorted(writer.folder.glob("[0-9]*.h5")):
        with h5py.File(path) as h5:
            firsts.append(int(h5.attrs[segments.FIRST_SLICE]))
            for group in h5.values():
                for dataset in group.values() if isinstance(group, h5py.Group) else [group]:
                    assert dataset.attrs[segments.CRC] == segments.checksum(dataset[()])
    assert firsts == [0, 2, 4]
    writer.discard()


def test_folder_without_a_segment_is_no_loss(tmp_path: Path) -> None:
    """Assert that a recording that broke off before its first segment does not stand in the way of the next."""
    path = tmp_path / "a.recording.h5"
    RecordingWriter(path, STATIC, recipe=RECIPE)._lock.close()  # as if it had been killed
    assert (tmp_path / "a.recording.part" / "static.h5").exists()
    write(path, [1, 2], set(), 1)
    assert everything(tmp_path) == ["a.recording.h5"]


def test_a_recording_thrown_away_leaves_no_folder_that_was_made_for_it(tmp_path: Path) -> None:
    """Assert that folders made for a recording go with it, but not one that was there, nor one that holds a file."""
    RecordingWriter(tmp_path / "new" / "inner" / "a.recording.h5", STATIC).discard()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "old").mkdir()
    RecordingWriter(tmp_path / "old" / "a.recording.h5", STATIC).discard()
    assert [path.name for path in tmp_path.iterdir()] == ["old"]
