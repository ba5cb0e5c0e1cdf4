"""HDF5 files made to harm, given to every command that opens their kind: refused with exit code 2, in words."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.errors import InputError
from evetac_cli.formats.imports import read_events
from evetac_cli.resources import PACKAGE
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.hostile_hdf5 import ANYWHERE, IN_HEADERS, IN_OUR_OWN, Change, X, rows_of
from tests.patience import PATIENCE_S
from tests.store.recordings.test_segments import STATIC

EVENTS = 200


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
    """A recording and events of somebody else's, as they should be."""
    folder = tmp_path_factory.mktemp("originals")
    arrays = columns()
    starts = np.searchsorted(arrays["events/t"], [0, 1000, 2000, 3000]).astype(np.int64)
    recipe = Recipe("recording", 1, {}, seed=1, simulated_source=True)
    write_stage(folder / "a.recording.h5", recipe, {**arrays, **STATIC, "ms_to_idx": starts})
    with h5py.File(folder / "foreign.h5", "w") as h5:
        for name, column in arrays.items():
            h5[name] = column
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


def test_the_originals_are_fine(originals: Path) -> None:
    """Assert that the files are read as long as nobody has changed them."""
    StageFile(originals / "a.recording.h5", "recording").close()
    assert read_events(originals / "foreign.h5", frame_px=(640, 480)).events.size == EVENTS


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


# Commands that open a recording; {} stands for it.
ON_RECORDINGS = [
    "label",
    "track",
    "featurize",
    "export",
    "export --format lerobot -o out",
    "evaluate vibration",
    "record --camera replay:{}",
]


@pytest.mark.parametrize("command", ON_RECORDINGS)
def test_every_command_refuses_a_hostile_recording(
    originals: Path, tmp_path: Path, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that no command that reads recordings reads this one, and none leaves a file."""
    monkeypatch.chdir(tmp_path)
    path = hostile(originals / "a.recording.h5", tmp_path, OURS["external storage"][0])
    before = sorted(tmp_path.iterdir())
    said = refused(path, *command.split())
    assert "a.recording.h5" in said
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
