"""Exports: what other programs read of them, and that a recording comes back from them as it was."""

import json
import pickle
import resource
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.formats.calibration_files import read_pickle
from evetac_cli.formats.exports import FORMATS, export, target_path
from evetac_cli.formats.imports import read_events
from evetac_cli.formats.note import Note, read_note
from evetac_cli.formats.write import event_files
from evetac_cli.kernels import event_drawing
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import Recording
from tests.importing import FRAME, same
from tests.make import event_arrays, write_recording
from tests.patience import PATIENCE_S

ROUND_TRIPS = ("aedat4", "dsec", "text", "raw", "mcap")
# To write or to read a format.
NEEDS = {
    "mcap": "mcap",
    **dict.fromkeys(("aedat4", "raw"), "faery"),
    **dict.fromkeys(("parquet", "csv"), "pyarrow"),
}
DOTS = np.stack(np.meshgrid(100.0 + 62.5 * np.arange(8), 50.0 + 62.5 * np.arange(7)), axis=2)


def drawn(count: int, first_us: int = 0, seed: int = 1, gap_us: int = 400) -> Events:
    """Random events in order of time, the corners of the frame among them."""
    rng = np.random.default_rng(seed)
    t = first_us + np.cumsum(rng.integers(0, gap_us, count))
    x, y, p = (rng.integers(0, most, count) for most in (640, 480, 2))
    if count > 1:
        x[:2], y[:2] = (0, 639), (0, 479)
    return Events(t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))


def write(
    path: Path, events: Events, slices: int, t_offset: int = 0, *, simulated: bool = False, more: Any = None
) -> Path:
    arrays = event_arrays(events, slices, FRAME, t_offset) | (more or {})
    return write_recording(path, arrays, simulated=simulated)


def needs(format_: str) -> None:
    if format_ in NEEDS:
        pytest.importorskip(NEEDS[format_])


def refusal(call: Callable[[], Any]) -> str:
    with pytest.raises(InputError) as caught:
        call()
    return str(caught.value)


@pytest.mark.parametrize("format_", ROUND_TRIPS)
@pytest.mark.parametrize(
    ("events", "slices", "t_offset", "simulated"),
    [
        (drawn(20_000), 4100, 1_700_000_000_000_000, False),
        (drawn(300, first_us=5_500), 400, 0, True),  # silence before and after
        (drawn(1, first_us=2_000), 3, -7, False),
        (drawn(0), 12, 99, True),
        (drawn(0), 0, 0, False),
    ],
    ids=["many", "silence", "one", "none", "nothing"],
)
def test_a_recording_comes_back_as_it_was(
    tmp_path: Path, format_: str, events: Events, slices: int, t_offset: int, simulated: bool
) -> None:
    """Assert that events, slices, clock, frame and the word simulated survive the way out and in again."""
    needs(format_)
    source = write(tmp_path / "a.recording.h5", events, slices, t_offset, simulated=simulated)
    target = target_path(source, format_, None)
    if format_ == "mcap" and t_offset < 0:
        assert "ROS messages" in refusal(lambda: export(source, format_, target))
        return
    row = export(source, format_, target)
    assert (row["events"], row["slices"], row["left_out"]) == (events.size, slices, None)
    imported = read_events(target)
    assert same(imported.events, events)
    assert (imported.slices, imported.t_offset_us, imported.frame_px) == (slices, t_offset, FRAME)
    assert (imported.simulated, imported.notes, sum(imported.counts.values())) == (simulated, [], 0)
    assert [path.name for path in tmp_path.iterdir() if path != target] == ["a.recording.h5"]


@settings(max_examples=15, deadline=None)
@given(
    t=st.lists(st.integers(0, 30_000), max_size=40).map(sorted),
    silence=st.integers(0, 20),
    piece=st.integers(1, 50),
    format_=st.sampled_from(["dsec", "text"]),
)
def test_any_cut_into_pieces_gives_the_same_file(
    tmp_path_factory: pytest.TempPathFactory, t: list[int], silence: int, piece: int, format_: str
) -> None:
    """Assert that whatever is read at once, the whole recording comes back."""
    folder = tmp_path_factory.mktemp("pieces")
    events = drawn(len(t))._replace(t=np.array(t, np.int64))
    slices = (t[-1] // 1000 + 1 if t else 0) + silence
    source = write(folder / "a.recording.h5", events, slices)
    target = target_path(source, format_, folder / "out")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(event_files, "PIECE_EVENTS", piece)
        patch.setattr(event_files, "LINES", 7)
        export(source, format_, target)
    imported = read_events(target)
    assert same(imported.events, events) and imported.slices == slices


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A simulated recording with a dot grid, of which one dot is missing, and with all that exports leave out."""
    dots = DOTS.copy()
    dots[2, 3] = np.nan
    commands = 3
    more = {
        "sensor/dot_xy_px": dots,
        "sensor/dot_radius_px": np.float64(20.5),
        "sensor/window_px": np.array([560, 0, 640, 480], np.int32),
        "gripper/t_us": np.arange(commands, dtype=np.int64),
        "gripper/current_target_ma": np.zeros(commands),
        "gripper/current_written_ma": np.zeros(commands, np.int32),
        "gripper/current_ma": np.zeros(commands, np.float32),
        "gripper/position_ticks": np.zeros(commands, np.int32),
    }
    return write(tmp_path / "b.recording.h5", drawn(5000), 1100, 5_000_000, simulated=True, more=more)


def test_dv_processing_reads_ours(source: Path) -> None:
    """Assert that the maker's library finds camera, frame and every event, with times of the source's clock."""
    dv = pytest.importorskip("dv_processing")
    target = target_path(source, "aedat4", None)
    row = export(source, "aedat4", target)
    assert row["left_out"] == "gripper sensor/dot_xy_px sensor/window_px"
    recording = dv.io.MonoCameraRecording(str(target))
    assert recording.getEventResolution() == FRAME
    assert recording.getCameraName() == "evetac"
    parts = []
    while (packet := recording.getNextEventBatch()) is not None:
        parts.append(packet.numpy())
    rows = np.concatenate(parts)
    events = drawn(5000)
    for ours, theirs in zip(events, ("timestamp", "x", "y", "polarity"), strict=True):
        assert np.array_equal(rows[theirs], ours.astype(np.int64) + (5_000_000 if theirs == "timestamp" else 0))


def test_dsec_is_as_in_the_data_set(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert names, types, units and the rule of ms_to_idx: event ms_to_idx[k] is the first at k ms or later."""
    target = target_path(source, "dsec", None)
    export(source, "dsec", target)
    with h5py.File(target) as file:
        assert sorted(file) == ["events", "ms_to_idx", "t_offset"]
        types = {name: file["events"][name].dtype for name in file["events"]}
        assert types == {"t": np.uint32, "x": np.uint16, "y": np.uint16, "p": np.uint8}
        assert {file["events/t"].compression, file["ms_to_idx"].dtype} == {"gzip", np.dtype(np.uint64)}
        assert int(file["t_offset"][()]) == 5_000_000
        named = ("events/t", "events/x", "events/p", "ms_to_idx", "t_offset")
        assert [file[name].attrs["units"] for name in named] == ["us", "px", "1", "1", "us"]
        assert all(file[name].attrs["long_name"] for name in named)
        t, index = file["events/t"][:].astype(np.int64), file["ms_to_idx"][:].astype(np.int64)
    assert np.array_equal(t, drawn(5000).t)
    for ms in range(len(index)):
        assert (t[index[ms] :] >= 1000 * ms).all() and (t[: index[ms]] < 1000 * ms).all()
    monkeypatch.setattr(event_files, "SHORT_MS", 1000)
    export(source, "dsec", target, force=True)
    with h5py.File(target) as file:
        assert file["events/t"].dtype == np.int64
    assert same(read_events(target).events, drawn(5000))


def test_the_grid_comes_back_from_json(source: Path, tmp_path: Path) -> None:
    """Assert that --calibration takes what was written: dots, the missing one, radius, frame and window."""
    target = target_path(source, "calibration", None)
    assert target.name == "b.calibration.json"
    export(source, "calibration", target)
    calibration = read_calibration(target, FRAME)
    expected = DOTS.copy()
    expected[2, 3] = np.nan
    np.testing.assert_array_equal(calibration.dot_xy_px, expected)
    assert (calibration.dot_radius_px, calibration.window_px) == (20.5, (560, 0, 640, 480))
    assert json.loads(target.read_text())["provenance"]["simulated"] is True


def test_the_official_software_reads_our_pickle(source: Path, tmp_path: Path) -> None:
    """Assert that it is a tuple of centres and diameters, under names that numpy 1 and 2 know, and comes back."""
    target = tmp_path / "grid.pkl"
    export(source, "calibration", target)
    content = target.read_bytes()
    assert b"numpy._core" not in content and b"numpy.core.multiarray" in content
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # numpy 2 knows the old names, and would like new ones
        centres, radii = pickle.loads(content)
    expected = np.delete(DOTS.reshape(-1, 2), 19, axis=0)
    np.testing.assert_array_equal(centres, expected)
    np.testing.assert_array_equal(radii, np.full((55, 1), 41.0))
    ours, radius = read_pickle(target)
    np.testing.assert_array_equal(ours, expected)
    assert radius == 20.5


def test_a_recording_without_dots_has_no_grid(tmp_path: Path) -> None:
    """Assert that there is no calibration where there is no grid."""
    bare = write(tmp_path / "a.recording.h5", drawn(3), 9)
    assert "no dot grid" in refusal(lambda: export(bare, "calibration", tmp_path / "a.json"))
    assert not (tmp_path / "a.json").exists()


# Of those that write single trials; the writer of frames is that of the other images, too.
ONE_BY_ONE = set(FORMATS) - {"lerobot", "histogram", "voxels", "surface"}


@pytest.mark.parametrize("format_", sorted(ONE_BY_ONE))
def test_what_exists_stays(source: Path, tmp_path: Path, format_: str) -> None:
    """Assert that a file that exists is refused, and replaced only on demand; a folder and the input never."""
    needs(format_)
    target = target_path(source, format_, tmp_path)
    target.write_text("mine")
    assert "--force" in refusal(lambda: export(source, format_, target))
    assert target.read_text() == "mine"
    export(source, format_, target, force=True)
    assert target.stat().st_size > 4
    assert "is a folder" in refusal(lambda: export(source, format_, tmp_path, force=True))
    assert "replace the recording" in refusal(lambda: export(source, format_, source, force=True))
    assert "output folder is a file" in refusal(lambda: export(source, format_, target / target.name))


OF_IMAGES: dict[str, dict[str, Any]] = {
    "frames": {"size": (64, 48), "polarity": "signed", "window_ms": 20},
    "histogram": {"size": (32, 24), "bins": 3},
    "voxels": {"size": (64, 48), "bins": 2},
    "surface": {"size": (16, 12), "decay_ms": 5.0},
}


@pytest.mark.parametrize("kind", OF_IMAGES)
def test_images_are_those_of_python(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a file of images holds what `Recording.frames` and the like give, and what they show."""
    monkeypatch.setattr(event_drawing, "AT_ONCE_BYTES", 50_000)  # several blocks
    source = write(tmp_path / "a.recording.h5", drawn(3_000), 1_300, simulated=True)
    target, options = tmp_path / "a.npz", OF_IMAGES[kind]
    row = export(source, kind, target, {"fps": 100, **options})
    with np.load(target) as arrays:
        images, end_us, said = arrays["images"], arrays["end_us"], json.loads(str(arrays["evetac"]))
    with Recording(source) as recording:
        named = {name: value for name, value in options.items() if name != "size"}
        of = recording.representation(kind, 100.0, options["size"], **named)  # type: ignore[arg-type]
        blocks = list(recording.images(of))
    assert len(blocks) > 1
    np.testing.assert_array_equal(images, np.concatenate([block.images for block in blocks]))
    assert images.dtype == of.dtype
    assert end_us.tolist() == list(range(10_000, 1_300_001, 10_000))
    shown = said["representation"]
    assert (shown["kind"], shown["rate_hz"], shown["size_px"]) == (kind, 100.0, list(options["size"]))
    assert said["simulated"] is row["simulated"] is True
    assert row["left_out"] is None


def test_names_of_outputs(tmp_path: Path) -> None:
    """Assert that an output is named after the recording, and one with the ending of another format is refused."""
    source = tmp_path / "a.recording.h5"
    assert target_path(source, "dsec", None) == tmp_path / "a.dsec.h5"
    assert target_path(source, "text", tmp_path) == tmp_path / "a.txt"
    assert target_path(source, "aedat4", tmp_path / "new") == tmp_path / "new" / "a.aedat4"
    assert target_path(source, "text", tmp_path / "b.txt") == tmp_path / "b.txt"
    assert target_path(source, "dsec", tmp_path / "b.h5") == tmp_path / "b.h5"
    assert "ends in .aedat4" in refusal(lambda: target_path(source, "aedat4", tmp_path / "b.txt"))


FULL = """
import sys
from pathlib import Path
from evetac_cli.errors import InputError
from evetac_cli.formats.exports import export
try:
    export(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
except InputError as error:
    print(error)
"""


def _little_room() -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))


@pytest.mark.parametrize(
    "format_",
    ["dsec", *(pytest.param(name, marks=pytest.mark.slow) for name in ("aedat4", "text", "raw", "mcap", "csv"))],
)
def test_a_full_disk_is_said_and_leaves_nothing(source: Path, tmp_path: Path, format_: str) -> None:
    """Assert that a disk without room gives words, and no part of a file."""
    needs(format_)
    target = tmp_path / "out" / target_path(source, format_, None).name
    call = [sys.executable, "-c", FULL, str(source), format_, str(target)]
    done = subprocess.run(
        call, capture_output=True, text=True, timeout=PATIENCE_S, preexec_fn=_little_room, check=False
    )
    assert "File too large" in done.stdout, done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    assert list(target.parent.iterdir()) == []


def test_aedat4_has_no_times_before_0(tmp_path: Path) -> None:
    """Assert that a recording whose source's clock begins before 0 is refused rather than written with other times."""
    pytest.importorskip("faery")
    source = write(tmp_path / "a.recording.h5", drawn(10), 50, -100_000)
    assert "times before 0" in refusal(lambda: export(source, "aedat4", tmp_path / "x.aedat4"))
    assert [path.name for path in tmp_path.iterdir()] == ["a.recording.h5"]


@pytest.mark.parametrize(
    "text",
    [
        "nonsense",
        "{}",
        Note(0, 5, FRAME, simulated=False).text().replace("5", str(10**300)),
        Note(0, 5, FRAME, simulated=False).text().replace("false", "1"),
        Note(0, 5, FRAME, simulated=False).text().replace("[640, 480]", "640"),
        Note(0, 5, FRAME, simulated=False, events=1 << 62).text(),
    ],
)
def test_edited_notes_are_refused(tmp_path: Path, text: str) -> None:
    """Assert that a note that says anything else is not believed, and an honest one is read back."""
    note = Note(-3, 5, FRAME, simulated=True)
    assert read_note(note.text(), "x") == note
    path = tmp_path / "a.txt"
    path.write_text(f"# evetac {text}\n0 1 2 1\n")
    assert "note that evetac wrote" in refusal(lambda: read_events(path))


def test_notes_that_do_not_fit_the_events_are_refused(tmp_path: Path) -> None:
    """Assert that events before the start are refused, and later ones reach past the slices of the note."""
    path = tmp_path / "a.txt"
    path.write_text(f"# evetac {Note(1000, 2, FRAME, simulated=False).text()}\n999 1 2 1\n")
    assert "before the start" in refusal(lambda: read_events(path))
    path.write_text(f"# evetac {Note(1000, 2, FRAME, simulated=False).text()}\n9000 1 2 1\n")
    imported = read_events(path)
    assert (imported.slices, imported.events.t.tolist(), imported.t_offset_us) == (9, [8000], 1000)


@pytest.mark.parametrize("format_", ["aedat4", "text"])
def test_an_export_that_was_cut_ends_with_its_last_event(
    tmp_path: Path, format_: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that what was cut off is not made up as silence, whatever the note in the file's head says."""
    needs(format_)
    events = drawn(40_000)  # in 5 packets
    source = write(tmp_path / "a.recording.h5", events, 9000, 1_000)
    target = target_path(source, format_, None)
    export(source, format_, target)
    whole = target.read_bytes()
    for share in (0.3, 0.6, 0.9):
        length = round(share * len(whole))
        target.write_bytes(whole[: whole.rindex(b"\n", 0, length) + 1] if format_ == "text" else whole[:length])
        imported = read_events(target)
        count = imported.events.size
        assert 0 < count < 40_000 and same(imported.events, events.part(0, count))
        assert imported.slices == int(events.t[count - 1]) // 1000 + 1
        assert any(f"{count} events" in note for note in imported.notes)
    target.write_bytes(b"".join(whole.splitlines(True)[:2]) if format_ == "text" else whole[: len(whole) // 50])
    words = {"text": "has no events", "aedat4": "the file is damaged"}[format_]
    assert words in refusal(lambda: read_events(target))


def test_from_the_command_line(source: Path, tmp_path: Path) -> None:
    """Assert that export and record --from make the same recording of it, which still says that it was simulated."""
    run = CliRunner().invoke(app, ["export", str(source), "--format", "dsec", "-o", str(tmp_path / "out"), "--json"])
    assert run.exit_code == 0, run.output
    result = json.loads(run.stdout)
    assert (result["simulated"], result["rows"][0]["events"]) == (True, 5000)
    back = tmp_path / "back.recording.h5"
    run = CliRunner().invoke(app, ["record", "--from", result["rows"][0]["output"], "-o", str(back), "--json"])
    assert run.exit_code == 0, run.output
    assert json.loads(run.stdout)["simulated"] is True
    with StageFile(back, "recording") as file:
        assert file.header["simulated"] is True
    with h5py.File(source) as one, h5py.File(back) as other:
        for name in ("events/t", "events/x", "events/y", "events/p", "ms_to_idx", "t_offset", "sensor/frame_px"):
            assert np.array_equal(one[name][()], other[name][()]), name


@pytest.mark.parametrize("error", [KeyboardInterrupt(), InputError("not this one")])
def test_several_are_written_together(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Any
) -> None:
    """Assert that an export that stops at its second recording leaves no file, so the same command works afterwards.

    What exists is refused before anything is written.
    """
    other = write(tmp_path / "z.recording.h5", drawn(100), 50)
    out, writer = tmp_path / "out", FORMATS["text"]
    command = ["export", str(source), str(other), "--format", "text", "-o", str(out)]

    def stops(recording: Recording, path: Path, progress: Any) -> None:
        if recording.event_count == 100:
            raise error
        writer.write(recording, path, progress)  # type: ignore[misc]

    with monkeypatch.context() as patch:
        patch.setitem(FORMATS, "text", writer._replace(write=stops))
        assert CliRunner().invoke(app, command).exit_code in (130, 2)
    assert not out.exists() or not list(out.iterdir())
    assert CliRunner().invoke(app, command).exit_code == 0
    assert sorted(path.name for path in out.iterdir()) == ["b.txt", "z.txt"]
    (out / "b.txt").unlink()
    assert CliRunner().invoke(app, command).exit_code == 2
    assert [path.name for path in out.iterdir()] == ["z.txt"]
