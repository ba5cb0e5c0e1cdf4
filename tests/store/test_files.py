"""Stage files that are missing, foreign, damaged, newer or in the way; writing that fails half-way."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.errors import InputError, SchemaError
from evetac_cli.inspect import validate
from evetac_cli.resources import PACKAGE
from evetac_cli.store import files
from evetac_cli.store.files import StageFile, output_path, replacing, up_to_date, write_stage
from evetac_cli.store.hdf5 import disk
from evetac_cli.store.hdf5.chunks import put
from evetac_cli.store.layout.provenance import Header, Recipe
from tests.make import everything, label_arrays
from tests.patience import PATIENCE_S

RECIPE = Recipe("labels", 1, {"threshold_px": 0.5}, parents=(Recipe("recording", 1, {}, seed=1).header(),))
SLICES = 5000


def labels() -> dict[str, Any]:
    """Arrays of a labels file, long enough to be stored in compressed chunks."""
    rng = np.random.default_rng(0)
    label = rng.integers(-1, 2, SLICES).astype(np.int8)
    label[:18] = [0] * 17 + [1]
    return label_arrays(label, 17, rng.normal(size=SLICES))


REPORT = {"command": "evaluate slip", "rows": "[]", "summary": '{"Größe": 1}'}


@pytest.fixture
def labels_file(tmp_path: Path) -> Path:
    """A real labels file."""
    path = tmp_path / "a.labels.h5"
    write_stage(path, RECIPE, labels())
    return path


@pytest.fixture
def locked() -> Iterator[Path]:
    """A folder that this process may not write in, also where the tests run as root."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o555)
    root = os.geteuid() == 0
    if root:
        os.seteuid(65534)
    try:
        yield folder
    finally:
        if root:
            os.seteuid(0)
        folder.chmod(0o755)
        shutil.rmtree(folder)


def edit_header(path: Path, **changes: Any) -> None:
    """Change the header of a file; a key given as ... is left out."""
    with h5py.File(path, "r+") as h5:
        header = {**json.loads(h5.attrs["header"]), **changes}
        h5.attrs["header"] = json.dumps({key: value for key, value in header.items() if value is not ...})


def refusal(path: Path, kind: str | None = None) -> str:
    """What is said of a file that is not opened; it must name the file and end with exit code 2."""
    with pytest.raises(InputError) as refused:
        StageFile(path, kind)
    assert str(refused.value).startswith(f"{path}: ")
    assert refused.value.exit_code == 2
    return str(refused.value)


def test_what_is_written_is_read(labels_file: Path) -> None:
    """Assert that arrays, scalars, text, parts and lengths come back as they were stored, with their dtypes."""
    stored = labels()
    with StageFile(labels_file, "labels") as file:
        assert file.kind == "labels"
        assert file.header["id"] == RECIPE.id
        assert file.contents() == {name: (np.asarray(v).dtype.name, np.shape(v)) for name, v in stored.items()}
        for name, value in stored.items():
            np.testing.assert_array_equal(file.read(name), value, strict=True)
        np.testing.assert_array_equal(file.read("label", 10, 20), stored["label"][10:20])
        assert file.length("label") == SLICES
        assert file.has("label")
        assert not file.has("curve/step")
    report = labels_file.with_name("a.report.h5")
    write_stage(report, Recipe("report", 1, {}), REPORT)
    with StageFile(report, ("model", "report")) as file:
        assert {name: file.read(name) for name in file.contents()} == REPORT


def test_same_recipe_same_datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that two files of one recipe differ in nothing but the time in their header, which stands still here."""
    now = time.gmtime()
    monkeypatch.setattr(time, "gmtime", lambda: now)
    contents = []
    for name in ("a.labels.h5", "b.labels.h5"):
        write_stage(tmp_path / name, RECIPE, labels())
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]


@pytest.mark.parametrize("shared", [{"a": 1}, 3, None, ["not what the ids are of"], []])
def test_header_whose_shared_parameters_were_edited(tmp_path: Path, shared: Any) -> None:
    """Assert that parameters of several ancestors come back from a file, and that others in their place are refused."""
    long = {"text": "x" * 100}
    parents = tuple(Recipe("recording", 1, {"scene": long, "number": number}).header() for number in range(2))
    path = tmp_path / "a.labels.h5"
    labels_file = write_stage(path, Recipe("labels", 1, {}, parents=parents), labels())
    with StageFile(path) as file:
        assert file.header == labels_file
    with h5py.File(path) as h5:
        assert h5.attrs["header"].count("x" * 100) == 1
    edit_header(path, shared=shared)
    if isinstance(shared, list) and shared:
        assert "the history of" in validate.run([path]).rows[0]["faults"]
    else:
        assert "its header is not valid" in refusal(path)


def test_newer_minor_version(labels_file: Path) -> None:
    """Assert that what a newer minor version adds is let be, while its known datasets are still checked."""
    with h5py.File(labels_file, "r+") as h5:
        h5["added/in_1_99"] = np.arange(3)
    assert "added/in_1_99 is not in the schema" in refusal(labels_file)
    edit_header(labels_file, version="1.99", added="too")
    with StageFile(labels_file, "labels") as file:
        np.testing.assert_array_equal(file.read("added/in_1_99"), np.arange(3))
    with h5py.File(labels_file, "r+") as h5:
        del h5["confidence"]
    message = refusal(labels_file)
    assert "confidence is missing" in message
    assert "added" not in message


def header(**changes: Any) -> Callable[[Path], None]:
    return partial(edit_header, **changes)


def header_text(text: str) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        with h5py.File(path, "r+") as h5:
            h5.attrs["header"] = text

    return change


def without_header(path: Path) -> None:
    with h5py.File(path, "r+") as h5:
        del h5.attrs["header"]


def label(value: Any) -> Callable[[Path], None]:
    """Another value, a group or nothing in place of a dataset."""

    def change(path: Path) -> None:
        with h5py.File(path, "r+") as h5:
            del h5["label"]
            if value is dict:
                h5.create_group("label")
            elif value is not None:
                h5["label"] = value

    return change


def in_place(make: Callable[[Path], Any]) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        path.unlink()
        make(path)

    return change


KEYS = ("kind", "version", "method", "parameters", "seed", "parents", "content", "id", "simulated", "history")
REFUSED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "missing": (Path.unlink, "no such file"),
    "a folder": (in_place(Path.mkdir), "this is a folder"),
    "a pipe": (in_place(os.mkfifo), "not a regular file"),
    "empty": (lambda path: path.write_bytes(b""), "evetac record --from"),
    "text": (lambda path: path.write_bytes(b"t x y p\n0.1 3 4 1\n"), "cannot be opened"),
    "half": (lambda path: os.truncate(path, path.stat().st_size // 2), "cannot be opened"),
    "a byte less": (lambda path: os.truncate(path, path.stat().st_size - 1), "it is truncated"),
    "no header": (without_header, "was not made by evetac"),
    "header that is no object": (header_text("[1]"), "its header is not valid"),
    "header with NaN": (header_text('{"seed": NaN}'), "its header is not valid"),
    **{f"no {key}": (header(**{key: ...}), key) for key in KEYS},
    **{f"{key} of another type": (header(**{key: [1]}), f"its header is not valid: {key}") for key in KEYS[:-1]},
    "an edited header": (header(parameters={"a": 1}), "its header was edited"),
    "an unknown kind": (header(kind="x"), "unknown kind"),
    "a newer version": (header(version="12.3", parents={"new": "form"}, content=...), "made by a newer evetac"),
    "no label": (label(None), "label"),
    "label of another dtype": (label(np.zeros(SLICES, np.int16)), "label"),
    "label of another length": (label(np.zeros(SLICES - 1, np.int8)), "label"),
    "label without a value": (label(h5py.Empty("int8")), "label"),
    "label is a group": (label(dict), "label"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refusals(labels_file: Path, name: str) -> None:
    """Assert that each is refused with its path when it is opened, and as an output unless forced."""
    change, words = REFUSED[name]
    change(labels_file)
    with pytest.raises(InputError, match=words) as refused:
        StageFile(labels_file)
    assert str(refused.value).startswith(f"{labels_file}: ")
    if name not in ("missing", "a folder"):
        with pytest.raises(InputError, match=r"(?s)not a valid evetac file.*--force"):
            up_to_date(labels_file, Recipe("labels", 2, {}))
        assert not up_to_date(labels_file, RECIPE, force=True)


def test_damaged_chunk(labels_file: Path) -> None:
    """Assert that damage in the data of one dataset is an error in words on reading it, and on reading it alone."""
    with h5py.File(labels_file) as h5:
        chunk = h5["relative_flow_px"].id.get_chunk_info(0)
        offset, size = chunk.byte_offset, chunk.size
    damaged = bytearray(labels_file.read_bytes())
    damaged[offset : offset + size] = bytes(size)
    labels_file.write_bytes(damaged)
    with StageFile(labels_file) as file:
        for rows in ((0, None), (0, 1), (SLICES - 1, SLICES)):
            with pytest.raises(InputError, match=r"relative_flow_px cannot be read(.|\n)*damaged; make it again"):
                file.read("relative_flow_px", *rows)
        np.testing.assert_array_equal(file.read("label"), labels()["label"])


def test_up_to_date(labels_file: Path) -> None:
    """Assert that an output is skipped with the same recipe, made if missing, and refused with another recipe."""
    other = Recipe("labels", 1, {"threshold_px": 0.7}, parents=RECIPE.parents)
    assert up_to_date(labels_file, RECIPE)
    assert up_to_date(labels_file, RECIPE, force=True)
    assert not up_to_date(labels_file.with_name("b.labels.h5"), RECIPE)
    assert not up_to_date(labels_file.parent / "new" / "folder" / "b.labels.h5", RECIPE)
    with pytest.raises(InputError) as refused:
        up_to_date(labels_file, other)
    assert "parameters.threshold_px is 0.5 in the file, 0.7" in str(refused.value)
    assert "--force" in str(refused.value)
    assert not up_to_date(labels_file, other, force=True)
    assert not labels_file.parent.joinpath("new").exists()


def test_a_recording_of_devices_in_the_way(tmp_path: Path) -> None:
    """Assert that it is named as what it is, not by the difference of two recipes; an import in the way is not."""
    arrays: dict[str, Any] = {
        **{f"events/{name}": np.empty(0, dtype) for name, dtype in zip("txyp", ("i8", "u2", "u2", "u1"), strict=True)},
        "ms_to_idx": np.zeros(3, np.int64),
        "t_offset": np.int64(0),
        "sensor/frame_px": np.array((640, 480), np.int32),
        "sensor/name": "unknown",
    }
    path = tmp_path / "a.recording.h5"
    wanted = Recipe("recording", 2, {}, content="1")
    write_stage(path, Recipe("recording", 1, {}, content="0"), arrays)
    with pytest.raises(InputError, match="another recipe"):
        up_to_date(path, wanted)
    write_stage(path, Recipe("recording", 1, {}, content="2"), {**arrays, "capture/ended": "interrupted"}, force=True)
    with pytest.raises(InputError, match="a recording of devices, which cannot be made again") as refused:
        up_to_date(path, wanted)
    assert "--force" in str(refused.value) and "method" not in str(refused.value)
    assert not up_to_date(path, wanted, force=True)


def test_output_that_cannot_be_written_is_refused_before_the_work(locked: Path) -> None:
    """Assert that a folder as output and an output in a locked folder are refused at once, --force or not."""
    for force in (False, True):
        with pytest.raises(InputError, match="the output is a folder"):
            up_to_date(locked, RECIPE, force=force)
        with pytest.raises(InputError, match="cannot be written to"):
            up_to_date(locked / "new" / "a.labels.h5", RECIPE, force=force)


@pytest.mark.parametrize("change", [{"label": np.zeros(3)}, {"extra": 1}, {"label": np.zeros(7, np.int8)}])
def test_wrong_arrays_leave_nothing(tmp_path: Path, change: dict[str, Any]) -> None:
    """Assert that arrays against the schema leave no file."""
    with pytest.raises(SchemaError, match=r"schemas/labels\.v1\.json"):
        write_stage(tmp_path / "a.labels.h5", RECIPE, {**labels(), **change})
    assert everything(tmp_path) == []


def test_failing_writes_leave_the_old_file(labels_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that when writing fails half-way, the file that was there stays, and no temporary one."""
    before = labels_file.read_bytes()
    written = []

    def fail_at_third(h5: h5py.File, name: str, value: Any) -> None:
        if len(written) == 2:
            raise OSError(5, "Input/output error")
        written.append(name)
        put(h5, name, value)

    monkeypatch.setattr(files, "put", fail_at_third)
    with pytest.raises(InputError, match="cannot be written: Input/output error"):
        write_stage(labels_file, RECIPE, labels())
    assert labels_file.read_bytes() == before
    assert everything(labels_file.parent) == [labels_file.name]


def test_ctrl_c_while_writing(labels_file: Path) -> None:
    """Assert that Ctrl-C waits until HDF5 has closed the file, and then leaves the old file and no other."""
    before, handler = labels_file.read_bytes(), signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), replacing(labels_file) as h5:
        signal.raise_signal(signal.SIGINT)
        put(h5, "after", np.random.default_rng(0).random(300_000))
        h5.flush()
        reached = True
    assert reached
    assert labels_file.read_bytes() == before
    assert everything(labels_file.parent) == [labels_file.name]
    assert signal.getsignal(signal.SIGINT) is handler


FULL_DISK = """
import resource, sys
from pathlib import Path
import numpy as np
from evetac_cli.errors import InputError
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.layout.schema import KINDS

rng = np.random.default_rng(0)
arrays = {"label": rng.integers(0, 2, 200000).astype(np.int8), "relative_flow_px": rng.random(200000, np.float32),
          "confidence": np.float64(1), "flow_pairs_computed": np.int64(1)}
arrays["onset_slice"] = np.int64(arrays["label"].argmax())
report = {"command": "x", "rows": "[" + "{}," * 300000 + "{}]", "summary": "{}"}
said = []
for room in (0, 1, 1000, 30000, 400000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
    for recipe, content in ((Recipe("labels", 1, {}), arrays),
                            (Recipe("report", 1, {}), report)):
        try:
            write_stage(Path(sys.argv[1]) / f"a.{recipe.kind}.h5", recipe, content)
        except InputError as error:
            said.append(str(error))
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
write_stage(Path(sys.argv[1]) / "after.labels.h5", Recipe("labels", 1, {}), arrays)
print(len(said), all("cannot be written: File too large" in line for line in said))
"""


def test_full_disk(tmp_path: Path) -> None:
    """Assert that running out of room is an error in words at any point, and the process lives on to write again.

    A limit on the size of files stands in for the full disk: the system refuses to write in the same way.
    """
    run = [sys.executable, "-c", FULL_DISK, str(tmp_path)]
    done = subprocess.run(run, capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=PACKAGE.parent)
    assert (done.returncode, done.stdout, done.stderr) == (0, "10 True\n", "")
    assert everything(tmp_path) == ["after.labels.h5"]
    with StageFile(tmp_path / "after.labels.h5") as file:
        assert file.read("label").shape == (200000,)


@pytest.mark.parametrize("in_blocks", [False, True])
def test_of_two_runs_onto_one_output_the_second_ends_as_if_it_came_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_blocks: bool
) -> None:
    """Assert that it is refused, skipped for the same recipe, or replaces the file with --force, and says so."""
    path, other, held = tmp_path / "a.labels.h5", Recipe("labels", 1, {"other": 1}), disk.locked
    arrays = labels()
    late = {"label": arrays.pop("label")} if in_blocks else None
    blocks, lengths = ([], None) if late is None else ([late], {"label": SLICES})

    def second(recipe: Recipe, *, force: bool = False) -> Header | None:
        """Write, while the first run puts its file there just before."""
        path.unlink(missing_ok=True)
        first = [labels()]

        def locked(target: Path) -> AbstractContextManager[None]:
            if first:
                write_stage(path, RECIPE, first.pop())
            return held(target)

        monkeypatch.setattr(disk, "locked", locked)
        return write_stage(path, recipe, arrays, blocks, lengths, force=force)

    with pytest.raises(InputError, match="another recipe"):
        second(other)
    assert up_to_date(path, RECIPE)
    assert second(RECIPE) is None
    assert second(other, force=True) is not None
    assert up_to_date(path, other)
    assert everything(tmp_path) == ["a.labels.h5"]


LEFT = """
import sys
from pathlib import Path
from evetac_cli.store.hdf5.disk import taking_the_place_of

with taking_the_place_of(Path(sys.argv[1]) / "a.labels.h5") as unfinished:
    unfinished.write_bytes(b"half")
    print("here", flush=True)
    sys.stdin.read()
"""


def test_what_a_killed_process_left_goes_with_the_next(tmp_path: Path) -> None:
    """Assert that its unfinished file is removed, and those of live processes, other machines and names are not."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", LEFT, str(tmp_path)], **pipes, cwd=PACKAGE.parent) as killed:
        assert killed.stdout is not None
        killed.stdout.readline()
        (unfinished,) = everything(tmp_path)
        write_stage(tmp_path / "a.labels.h5", RECIPE, labels())
        assert everything(tmp_path) == [unfinished, "a.labels.h5"]
        killed.kill()
    (tmp_path / unfinished).write_bytes(b"half")
    others = [unfinished.replace("a.labels", "b.labels"), ".a.labels.h5.elsewhere.4194305.tmp", ".a.labels.h5.x.tmp"]
    for name in others:
        (tmp_path / name).write_bytes(b"")
    write_stage(tmp_path / "a.labels.h5", RECIPE, labels())
    assert everything(tmp_path) == sorted([*others, "a.labels.h5"])


def test_output_path() -> None:
    """Assert that outputs lie beside the input, in a folder, or in the file that is named."""
    source = Path("in/a.recording.h5")
    assert output_path(source, "tracks", None) == Path("in/a.tracks.h5")
    assert output_path(source, "tracks", Path("out")) == Path("out/a.tracks.h5")
    assert output_path(source, "tracks", Path("out/x.h5")) == Path("out/x.h5")
    assert output_path(source, "tracks", Path("v1.5")) == Path("v1.5/a.tracks.h5")


def test_ctrl_c_removes_the_folders_that_were_made_for_a_file(tmp_path: Path) -> None:
    """Assert that Ctrl-C takes the folders along that were made for a file, but none that holds something."""
    old = tmp_path / "old"
    old.mkdir()
    with pytest.raises(KeyboardInterrupt), replacing(old / "new" / "inner" / "a.labels.h5"):
        raise KeyboardInterrupt
    assert list(old.iterdir()) == []
    with pytest.raises(KeyboardInterrupt), replacing(old / "new" / "inner" / "a.labels.h5"):
        (old / "new" / "notes.txt").touch()
        raise KeyboardInterrupt
    assert [path.name for path in (old / "new").iterdir()] == ["notes.txt"]
    with replacing(tmp_path / "kept" / "a.labels.h5"):
        pass
    assert (tmp_path / "kept" / "a.labels.h5").exists()
