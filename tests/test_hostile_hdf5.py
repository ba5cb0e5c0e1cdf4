"""HDF5 files made to harm, given to every command that opens their kind: refused with exit code 2, in words."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.formats.imports import read_events
from evetac_cli.inspect import repair
from evetac_cli.resources import PACKAGE
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings import segments
from evetac_cli.store.recordings.segments import RecordingWriter
from tests.hostile_hdf5 import ANYWHERE, IN_HEADERS, IN_OUR_OWN, Change, X, rows_of
from tests.patience import PATIENCE_S
from tests.quick import few
from tests.small_files import every_kind

EVENTS = 200
STATIC: dict[str, Any] = {
    "sensor/frame_px": np.array([640, 480], np.int32),
    "sensor/name": "evetac",
    "t_offset": np.int64(0),
}


def columns() -> dict[str, Any]:
    """Events of three slices."""
    t = np.arange(EVENTS, dtype=np.int64) * 3000 // EVENTS
    return {
        "events/t": t,
        X: np.arange(EVENTS, dtype=np.uint16),
        "events/y": np.arange(EVENTS, dtype=np.uint16),
        "events/p": np.ones(EVENTS, np.uint8),
    }


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording, a folder that a recording left, and events of somebody else's, all as they should be."""
    folder = tmp_path_factory.mktemp("originals")
    arrays = columns()
    starts = np.searchsorted(arrays["events/t"], [0, 1000, 2000, 3000]).astype(np.int64)
    recipe = Recipe("recording", 1, {}, seed=1, simulated_source=True)
    write_stage(folder / "a.recording.h5", recipe, {**arrays, **STATIC, "ms_to_idx": starts})
    with h5py.File(folder / "foreign.h5", "w") as h5:
        for name, column in arrays.items():
            h5[name] = column
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segments, "SEGMENT_S", 1e9)
        writer = RecordingWriter(folder / "b.recording.h5", STATIC, recipe=recipe)
        for segment in range(2):
            for k in range(3 * segment, 3 * segment + 3):
                events = Events(*arrays.values()).part(int(starts[k % 3]), int(starts[k % 3 + 1]))
                writer.append(events._replace(t=events.t % 1000 + 1000 * k))
            writer.close_segment()
        writer.leave()
    return folder


def hostile(original: Path, folder: Path, change: Change) -> Path:
    """A copy of a file, or of the folder that holds it, changed."""
    path = folder / original.name
    shutil.copy(original, path)
    change(path)
    return path


def refused(path: Path, *words: str) -> str:
    """What a command says on a file; it must end with exit code 2, and in words."""
    result = CliRunner().invoke(app, [*words, str(path)] if "{}" not in " ".join(words) else fill(words, path))
    assert isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code == 2, result.output
    return " ".join(result.output.split())


def read_all(path: Path) -> None:
    """Open a file and read each of its datasets."""
    with StageFile(path) as file:
        for name in file.contents():
            file.read(name)


def fill(words: tuple[str, ...], path: Path) -> list[str]:
    return [word.replace("{}", str(path)) for word in words]


OURS = ANYWHERE | IN_OUR_OWN | IN_HEADERS


def test_the_originals_are_fine(originals: Path, tmp_path: Path) -> None:
    """Assert that the files are read as long as nobody has changed them."""
    StageFile(originals / "a.recording.h5", "recording").close()
    assert read_events(originals / "foreign.h5", frame_px=(640, 480)).events.size == EVENTS
    shutil.copytree(originals / "b.recording.part", tmp_path / "b.recording.part")
    (row,) = repair.run([tmp_path]).rows
    assert (row["fault"], row["slices_kept"], row["events_kept"]) == (None, 6, 2 * EVENTS)


@pytest.mark.parametrize("name", OURS)
def test_a_hostile_recording_is_refused(originals: Path, tmp_path: Path, name: str) -> None:
    """Assert that it is refused when it is opened, or when that is read; `validate` and `info` say the same."""
    change, words = OURS[name]
    path = hostile(originals / "a.recording.h5", tmp_path, change)
    with pytest.raises(InputError, match=words) as error:
        read_all(path)
    assert len(str(error.value)) < 2000
    with pytest.raises(InputError, match=words), StageFile(path) as file:
        file.check()
    said = refused(path, "validate", "--json")
    assert error.value.message.split(":")[0][:40] in said
    assert refused(path, "info")


@pytest.mark.parametrize("name", ANYWHERE)
def test_hostile_events_are_not_imported(originals: Path, tmp_path: Path, name: str) -> None:
    """Assert that the import of other people's HDF5 refuses the same."""
    change, words = ANYWHERE[name]
    path = hostile(originals / "foreign.h5", tmp_path, change)
    with pytest.raises(InputError, match=words):
        read_events(path, frame_px=(640, 480))


@pytest.mark.parametrize("name", ANYWHERE | IN_OUR_OWN)
def test_a_hostile_segment_is_left_out(originals: Path, tmp_path: Path, name: str) -> None:
    """Assert that repair names the segment and what is wrong with it, and keeps the other."""
    change, _ = (ANYWHERE | IN_OUR_OWN)[name]
    folder = tmp_path / "b.recording.part"
    shutil.copytree(originals / folder.name, folder)
    change(folder / "000001.h5")
    (row,) = repair.run([folder]).rows
    assert (row["status"], row["slices_kept"], row["segments_unreadable"]) == ("repaired", 3, 1)
    assert str(row["unreadable"]).startswith("000001: ")


@pytest.mark.parametrize("name", ["external link", "virtual", "2^33 rows", "text without end"])
def test_a_hostile_start_is_refused(originals: Path, tmp_path: Path, name: str) -> None:
    """Assert that repair makes nothing of a folder whose start was changed, and keeps it."""
    folder = tmp_path / "b.recording.part"
    shutil.copytree(originals / folder.name, folder)
    with h5py.File(folder / "static.h5", "r+") as h5:
        h5[X] = np.arange(9, dtype=np.uint16)
        h5["events/y"] = np.arange(9, dtype=np.uint16)
    (ANYWHERE | IN_OUR_OWN)[name][0](folder / "static.h5")
    assert "start of the recording cannot be read" in refused(folder, "repair", "--json")
    assert sorted(path.name for path in tmp_path.glob("b.*")) == [folder.name]


# Commands that open a recording; {} stands for it.
ON_RECORDINGS = [
    "validate --json",
    "info",
    "label",
    "track",
    "featurize",
    "trim",
    "calibrate",
    "track-rgb",
    "view",
    "export",
    "export --format dsec",
    "export --format text",
    "export --format calibration",
    "export --format parquet",
    "export --format lerobot -o out",
    "evaluate vibration",
    "evaluate data-rate",
    "evaluate grasp",
    "record --camera replay:{}",
]
SAMPLE = ["external storage", "virtual", "soft link", "2^33 packed rows", "compound", "length without end"]


@pytest.mark.parametrize("name", SAMPLE)
@pytest.mark.parametrize("command", ON_RECORDINGS)
def test_every_command_refuses_a_hostile_recording(
    originals: Path, tmp_path: Path, command: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that no command that reads recordings reads this one, and none leaves a file."""
    monkeypatch.chdir(tmp_path)
    path = hostile(originals / "a.recording.h5", tmp_path, OURS[name][0])
    before = sorted(tmp_path.iterdir())
    said = refused(path, *command.split())
    assert "a.recording.h5" in said
    assert sorted(tmp_path.iterdir()) == before


# Commands that open files of the other kinds; {} stands for the file.
ON_OTHERS = [
    ("labels", "evaluate labels"),
    ("labels", "view"),
    ("tracks", "evaluate tracking"),
    ("tracks", "evaluate force"),
    ("tracks", "train-force"),
    ("tracks", "predict-touch"),
    ("features", "train"),
    ("features", "evaluate slip --model {}"),
    ("features", "evaluate cost model"),
    ("model", "evaluate slip --model {}"),
    ("model", "grasp --model"),
    ("force-model", "predict-touch {} --model"),
    *((kind, command) for kind in schema.KINDS if kind != "recording" for command in ("validate", "info")),
]


def unwritten(path: Path, name: str) -> None:
    with h5py.File(path, "r+") as h5:
        dtype = h5[name].dtype
        del h5[name]
        h5.create_dataset(name, (2**33,), dtype if dtype.kind in "iuf" else np.int64)


def from_elsewhere(path: Path, name: str) -> None:
    with h5py.File(path, "r+") as h5:
        dtype = h5[name].dtype
        del h5[name]
        h5.create_dataset(name, (80,), dtype if dtype.kind in "iuf" else "S8", external=[("/etc/passwd", 0, 640)])


@pytest.mark.parametrize("change", few([unwritten, from_elsewhere], from_elsewhere), ids=lambda change: change.__name__)
@pytest.mark.parametrize(("kind", "command"), ON_OTHERS)
def test_every_command_refuses_hostile_files_of_other_kinds(
    tmp_path: Path, kind: str, command: str, change: Callable[[Path, str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that whatever a command reads, it does not read rows that were never written, nor another file."""
    monkeypatch.chdir(tmp_path)
    path = every_kind(tmp_path)[kind]
    for other in tmp_path.iterdir():
        if other != path:
            other.unlink()
    with StageFile(path) as file:
        name = next(name for name, (dtype, _) in file.contents().items())
    change(path, name)
    before = sorted(tmp_path.iterdir())
    assert refused(path, *command.split())
    assert sorted(tmp_path.iterdir()) == before


IN_LITTLE_MEMORY = """
import resource, sys
from pathlib import Path
from evetac_cli.errors import InputError
from evetac_cli.store.files import StageFile
limit = 400 << 20
now = int(next(line for line in open("/proc/self/status") if line.startswith("VmSize")).split()[1]) << 10
resource.setrlimit(resource.RLIMIT_AS, (now + limit, resource.RLIM_INFINITY))
for path in sys.argv[1:]:
    try:
        with StageFile(Path(path)) as file:
            for name in file.contents():
                file.read(name)
        print(path)
    except InputError as error:
        words = str(error)
        assert "memory" not in words.lower() and "allocate" not in words.lower(), words
"""


def test_refusing_takes_little_memory(originals: Path, tmp_path: Path) -> None:
    """Assert that files are refused for what they announce, and not because the memory for it was not there."""
    paths = []
    for number, (change, _) in enumerate(OURS.values()):
        folder = tmp_path / str(number)
        folder.mkdir()
        paths.append(str(hostile(originals / "a.recording.h5", folder, change)))
    run = [sys.executable, "-c", IN_LITTLE_MEMORY, *paths]
    done = subprocess.run(run, capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=PACKAGE.parent)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_numbers_of_another_machine_are_read(originals: Path, tmp_path: Path) -> None:
    """Assert that columns in the other byte order are read as the same numbers, in the order of this machine."""

    def swapped(path: Path) -> None:
        rows = rows_of(path)
        with h5py.File(path, "r+") as h5:
            values = h5[X][()]
            del h5[X]
            h5.create_dataset(X, data=values.astype(">u2"), shape=(rows,))

    with StageFile(hostile(originals / "a.recording.h5", tmp_path, swapped)) as file:
        column = file.read(X)
    assert column.dtype == np.uint16 and column.dtype.isnative
    np.testing.assert_array_equal(column, np.arange(EVENTS))


def test_names_of_dimensions_cost_nothing(originals: Path, tmp_path: Path) -> None:
    """Assert that a netCDF dimension, a length without any stored row, is no dataset, and in its place no fault."""

    def named(path: Path) -> None:
        with h5py.File(path, "r+") as h5:
            scale = h5.create_dataset("slice", (3000,), ">f4")
            scale.make_scale("This is a netCDF dimension but not a netCDF variable      3000")

    with StageFile(originals / "a.recording.h5") as file:
        assert "events/events" not in file.contents() and not file.has("slices")
        assert len(file.read(X)) == EVENTS
        with pytest.raises(InputError, match="slices is not in this recording"):
            file.read("slices")
    with pytest.raises(InputError, match="slice is not in the schema"):
        StageFile(hostile(originals / "a.recording.h5", tmp_path, named))
