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
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.errors import EvetacError, InputError, SchemaError, UnavailableError
from evetac_cli.inspect import validate
from evetac_cli.resources import PACKAGE
from evetac_cli.store import files
from evetac_cli.store.files import StageFile, output_path, put_header, replacing, stem, up_to_date, write_stage
from evetac_cli.store.hdf5 import chunks, disk
from evetac_cli.store.hdf5.chunks import RowWriter, put
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.store.layout.schema import KINDS
from tests.patience import PATIENCE_S

RECIPE = Recipe("labels", 1, {"threshold_px": 0.5}, parents=(Recipe("recording", 1, {}, seed=1).header(),))
SLICES = 5000


def labels() -> dict[str, Any]:
    """Arrays of a labels file, long enough to be stored in compressed chunks."""
    rng = np.random.default_rng(0)
    label = rng.integers(-1, 2, SLICES).astype(np.int8)
    label[:18] = [0] * 17 + [1]
    return {
        "label": label,
        "relative_flow_px": rng.normal(size=SLICES).astype(np.float32),
        "onset_slice": np.int64(17),
        "confidence": np.float64("nan"),
        "flow_pairs_computed": np.int64(3),
    }


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


@pytest.mark.parametrize("path", ["nothing", "curve/step", "label/deeper", ""])
def test_reading_what_is_not_there(labels_file: Path, path: str) -> None:
    """Assert that a dataset that is not there is an error in words, not a KeyError."""
    with StageFile(labels_file) as file, pytest.raises(InputError, match="is not in this labels"):
        file.read(path or "/")


def test_arrays_outlive_the_file(labels_file: Path) -> None:
    """Assert that what was read stays valid when the file is closed, and that closing twice does nothing."""
    file = StageFile(labels_file)
    label = file.read("label")
    file.close()
    file.close()
    np.testing.assert_array_equal(label, labels()["label"])


def test_same_recipe_same_datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that two files of one recipe differ in nothing but the time in their header, which stands still here."""
    now = time.gmtime()
    monkeypatch.setattr(time, "gmtime", lambda: now)
    contents = []
    for name in ("a.labels.h5", "b.labels.h5"):
        write_stage(tmp_path / name, RECIPE, labels())
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]


def test_missing_file(tmp_path: Path) -> None:
    """Assert that a file that is not there is said to be missing, however odd its name."""
    for name in ("no.recording.h5", "no/folder/a.h5", "x" * 300):
        assert "no such file" in refusal(tmp_path / name)


def test_folder(tmp_path: Path) -> None:
    """Assert that a folder is said to be one."""
    assert "this is a folder" in refusal(tmp_path)


def test_pipe(tmp_path: Path) -> None:
    """Assert that a pipe is refused instead of waited for."""
    os.mkfifo(tmp_path / "pipe.h5")
    assert "not a regular file" in refusal(tmp_path / "pipe.h5")


@pytest.mark.parametrize("content", [b"", b"t x y p\n0.1 3 4 1\n", b"\x89HDF\r\n\x1a\n", bytes(4096)])
def test_not_hdf5(tmp_path: Path, content: bytes) -> None:
    """Assert that text, an empty file, a lone signature and zeros are refused with the way to import foreign files."""
    path = tmp_path / "events.recording.h5"
    path.write_bytes(content)
    message = refusal(path)
    assert "cannot be opened" in message
    assert "evetac record --from" in message


@pytest.mark.parametrize("share", [0.001, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 0.9999])
def test_truncated(labels_file: Path, share: float) -> None:
    """Assert that a file that ends early, even by one byte, is refused."""
    whole = labels_file.read_bytes()
    labels_file.write_bytes(whole[: int(len(whole) * share)])
    assert "cannot be opened" in refusal(labels_file)
    labels_file.write_bytes(whole[:-1])
    assert "it is truncated" in refusal(labels_file)


def test_unreadable(locked: Path) -> None:
    """Assert that a file without permission is said to be that, and not to be wrong in any way."""
    locked_file = locked / "a.labels.h5"
    uid = os.geteuid()
    if uid != os.getuid():
        os.seteuid(os.getuid())
    locked.chmod(0o755)
    write_stage(locked_file, RECIPE, labels())
    locked_file.chmod(0)
    os.seteuid(uid)
    with pytest.raises(UnavailableError, match=r"Permission denied(.|\n)*mode 0000"):
        StageFile(locked_file)


def test_hdf5_of_somebody_else(tmp_path: Path) -> None:
    """Assert that HDF5 without our header, or with a header that is no text, is told apart from a damaged file."""
    path = tmp_path / "dsec.h5"
    headers: list[Any] = [None, 3, np.bytes_(b"{}"), np.array([1, 2]), h5py.Empty("f8")]
    for value in headers:
        with h5py.File(path, "w") as h5:
            h5["events/t"] = np.arange(3)
            if value is not None:
                h5.attrs["header"] = value
        assert "was not made by evetac" in refusal(path)


NO_OBJECTS = ("", "{", "3", "null", '"text"', "[1]", "[" * 100000, '{"seed": NaN}', '{"seed": 1e999}')


@pytest.mark.parametrize("text", NO_OBJECTS, ids=lambda text: text[:20])
def test_header_that_is_no_json_object(labels_file: Path, text: str) -> None:
    """Assert that a header that is no JSON object, or one that holds no numbers of JSON, is refused."""
    with h5py.File(labels_file, "r+") as h5:
        h5.attrs["header"] = text
    assert "its header is" in refusal(labels_file)


KEYS = ("kind", "version", "method", "parameters", "seed", "parents", "content", "id", "simulated", "history")


@pytest.mark.parametrize("key", KEYS)
def test_header_without_a_key(labels_file: Path, key: str) -> None:
    """Assert that a header that lacks something is refused by name; `made` alone may be missing."""
    edit_header(labels_file, labels_file=...)
    StageFile(labels_file).close()
    edit_header(labels_file, **{key: ...})
    assert f"no {key}" in refusal(labels_file)


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("value", [[1], {"a": 1}, 0.5, "1", "1.x", "-1.0", "1.0.0"])
def test_header_with_a_wrong_value(labels_file: Path, key: str, value: Any) -> None:
    """Assert that a header value of another type, or of the right type but edited, is refused by name."""
    edit_header(labels_file, **{key: value})
    if (key == "parameters" and value == {"a": 1}) or (key in ("id", "content") and isinstance(value, str)):
        assert "its header was edited" in refusal(labels_file)
    elif key == "kind" and isinstance(value, str):
        assert "unknown kind" in refusal(labels_file)
    else:
        assert f"its header is not valid: {key}" in refusal(labels_file)


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


def test_wrong_kind(labels_file: Path) -> None:
    """Assert that another kind than wanted is refused with both, and any kind is taken where none is wanted."""
    message = refusal(labels_file, "recording")
    assert "expected: recording" in message
    assert "found:    labels" in message
    with pytest.raises(InputError, match="recording or tracks"):
        StageFile(labels_file, ("recording", "tracks"))
    StageFile(labels_file, ("tracks", "labels")).close()
    StageFile(labels_file).close()


def test_newer_major_version(labels_file: Path) -> None:
    """Assert that a newer major version is refused as such, whatever else is new in its header."""
    edit_header(labels_file, version="2.0")
    assert "made by a newer evetac: labels version 2.0" in refusal(labels_file)
    edit_header(labels_file, version="12.3", parents={"new": "form"}, content=...)
    assert "update evetac" in refusal(labels_file)


@pytest.mark.parametrize("kind", KINDS)
def test_files_of_the_first_layout(tmp_path: Path, kind: str) -> None:
    """Assert that a file whose datasets and parameters have the names of the first edition is refused as such."""
    path = tmp_path / f"a.{kind}.h5"
    with replacing(path) as h5:
        h5["sensor/individual"] = "drawn"
        put_header(h5, Recipe(kind, 1, {"individual": "drawn"}, seed=1).header() | {"version": "1.1"})
    message = refusal(path)
    assert "written by an earlier version of evetac and cannot be read" in message
    assert "expected: version 1.2 or newer" in message
    assert f"found:    {kind} version 1.1" in message
    assert "make it again from its recipe" in message
    with pytest.raises(InputError, match="earlier version of evetac") as refused:
        up_to_date(path, RECIPE)
    assert "--force replaces it" in str(refused.value)
    assert not up_to_date(path, RECIPE, force=True)


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


def delete(h5: h5py.File) -> None:
    del h5["label"]


def other_dtype(h5: h5py.File) -> None:
    delete(h5)
    h5["label"] = np.zeros(SLICES, np.int16)


def other_length(h5: h5py.File) -> None:
    delete(h5)
    h5["label"] = np.zeros(SLICES - 1, np.int8)


def empty(h5: h5py.File) -> None:
    delete(h5)
    h5["label"] = h5py.Empty("int8")


def group(h5: h5py.File) -> None:
    delete(h5)
    h5.create_group("label")


CONTENTS = [delete, other_dtype, other_length, empty, group]


@pytest.mark.parametrize("change", CONTENTS, ids=lambda change: change.__name__)
def test_contents_against_the_schema(labels_file: Path, change: Callable[[h5py.File], None]) -> None:
    """Assert that a file whose contents are not those of its schema is refused, with the schema and the dataset."""
    with h5py.File(labels_file, "r+") as h5:
        change(h5)
    with pytest.raises(SchemaError) as refused:
        StageFile(labels_file)
    assert "schemas/labels.v1.json" in str(refused.value)
    assert "label" in str(refused.value).splitlines()[-1]


def chunk_place(path: Path, name: str) -> tuple[int, int]:
    """Where in a file the first chunk of a dataset lies, and how long it is."""
    with h5py.File(path) as h5:
        chunk = h5[name].id.get_chunk_info(0)
        return chunk.byte_offset, chunk.size


def test_damaged_chunk(labels_file: Path) -> None:
    """Assert that damage in the data of one dataset is an error in words on reading it, and on reading it alone."""
    offset, size = chunk_place(labels_file, "relative_flow_px")
    damaged = bytearray(labels_file.read_bytes())
    damaged[offset : offset + size] = bytes(size)
    labels_file.write_bytes(damaged)
    with StageFile(labels_file) as file:
        for rows in ((0, None), (0, 1), (SLICES - 1, SLICES)):
            with pytest.raises(InputError, match=r"relative_flow_px cannot be read(.|\n)*damaged; make it again"):
                file.read("relative_flow_px", *rows)
        np.testing.assert_array_equal(file.read("label"), labels()["label"])


@pytest.mark.parametrize("signature", [b"TREE", b"SNOD", b"HEAP", b"\x89HDF"])
@pytest.mark.parametrize("shift", [0, 4, 8, 16, 24, 40, 80])
def test_damaged_structure(labels_file: Path, signature: bytes, shift: int) -> None:
    """Assert that damage in the structures of HDF5 ends in an error in words or in nothing, never in another error."""
    whole = labels_file.read_bytes()
    place = whole.find(signature)
    assert place >= 0
    while place >= 0:
        damaged = bytearray(whole)
        damaged[place + shift : place + shift + 4] = b"\xff\x85\x00\x7f"
        labels_file.write_bytes(damaged)
        try:
            with StageFile(labels_file) as file:
                for name in file.contents():
                    file.read(name)
        except EvetacError as error:
            assert str(error).startswith(f"{labels_file}: ")
        place = whole.find(signature, place + 1)


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


@pytest.mark.parametrize("content", [b"", b"not a stage file", bytes(3000)])
def test_output_that_is_garbage(tmp_path: Path, content: bytes) -> None:
    """Assert that an output that is no stage file is never replaced without --force, and stays as it is."""
    path = tmp_path / "a.labels.h5"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"(?s)not a valid evetac file.*cannot be opened.*--force"):
        up_to_date(path, RECIPE)
    assert not up_to_date(path, RECIPE, force=True)
    with pytest.raises(InputError, match="not a valid evetac file"):
        write_stage(path, RECIPE, labels())
    assert path.read_bytes() == content
    write_stage(path, RECIPE, labels(), force=True)
    assert up_to_date(path, RECIPE)


def test_truncated_output_is_made_again_only_with_force(labels_file: Path) -> None:
    """Assert that half an output does not count as up to date, though its header may still be there."""
    labels_file.write_bytes(labels_file.read_bytes()[:-100])
    with pytest.raises(InputError, match="truncated"):
        up_to_date(labels_file, RECIPE)
    assert not up_to_date(labels_file, RECIPE, force=True)


def test_output_that_cannot_be_written_is_refused_before_the_work(locked: Path) -> None:
    """Assert that a folder as output and an output in a locked folder are refused at once, --force or not."""
    for force in (False, True):
        with pytest.raises(InputError, match="the output is a folder"):
            up_to_date(locked, RECIPE, force=force)
        with pytest.raises(InputError, match="cannot be written to"):
            up_to_date(locked / "new" / "a.labels.h5", RECIPE, force=force)


def test_file_as_output_folder_is_refused_before_the_work(labels_file: Path) -> None:
    """Assert that a file where the output folder should be is refused at once."""
    with pytest.raises(InputError, match="the output folder is a file"):
        up_to_date(labels_file / "deeper" / "a.labels.h5", RECIPE)


def everything(folder: Path) -> list[str]:
    """Names of all files and folders below."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize("change", [{"label": np.zeros(3)}, {"extra": 1}, {"label": np.zeros(7, np.int8)}])
def test_wrong_arrays_leave_nothing(tmp_path: Path, change: dict[str, Any]) -> None:
    """Assert that arrays against the schema are refused before anything is written, a folder included."""
    with pytest.raises(SchemaError, match=r"schemas/labels\.v1\.json"):
        write_stage(tmp_path / "new" / "a.labels.h5", RECIPE, {**labels(), **change})
    assert everything(tmp_path) == []


def test_recipe_without_json_leaves_nothing(tmp_path: Path) -> None:
    """Assert that a recipe that has no id leaves no file."""
    with pytest.raises(ValueError, match="JSON"):
        write_stage(tmp_path / "a.labels.h5", Recipe("labels", 1, {"x": float("nan")}), labels())
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


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, MemoryError])
def test_any_end_of_writing_leaves_the_old_file(labels_file: Path, error: type[BaseException]) -> None:
    """Assert that errors from within the block come out as they are, and leave no trace."""
    before = labels_file.read_bytes()
    with pytest.raises(error), replacing(labels_file) as h5:
        put(h5, "half", np.arange(1000))
        raise error
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


def test_unwritable_folder(locked: Path) -> None:
    """Assert that a folder without permission is an error in words that leaves nothing."""
    with pytest.raises(InputError, match="cannot be written: Permission denied"):
        write_stage(locked / "a.labels.h5", RECIPE, labels())
    with pytest.raises(InputError, match="cannot be written: Permission denied"):
        write_stage(locked / "new" / "a.labels.h5", RECIPE, labels())
    assert everything(locked) == []


def test_parent_is_a_file(labels_file: Path) -> None:
    """Assert that a file where the output folder should be is named and stays as it is."""
    before = labels_file.read_bytes()
    for path in (labels_file / "a.labels.h5", labels_file / "deeper" / "a.labels.h5"):
        with pytest.raises(InputError, match=f"{path.parent}: the output folder is a file"):
            write_stage(path, RECIPE, labels())
    assert labels_file.read_bytes() == before


def test_target_is_a_folder(tmp_path: Path) -> None:
    """Assert that a folder is never replaced by a file."""
    (tmp_path / "a.labels.h5" / "precious").mkdir(parents=True)
    with pytest.raises(InputError, match="cannot be written"):
        write_stage(tmp_path / "a.labels.h5", RECIPE, labels())
    assert everything(tmp_path) == ["a.labels.h5", "a.labels.h5/precious"]


@pytest.mark.parametrize("length", [255, 300])
def test_name_too_long(tmp_path: Path, length: int) -> None:
    """Assert that a name the file system does not take is an error in words."""
    with pytest.raises(InputError, match="File name too long"):
        write_stage(tmp_path / f"{'x' * (length - 3)}.h5", RECIPE, labels())
    assert everything(tmp_path) == []


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
        while (state := Path(f"/proc/{killed.pid}/stat")).exists() and state.read_text().split()[2] != "Z":
            time.sleep(0.01)
        write_stage(tmp_path / "a.labels.h5", RECIPE, labels())
        assert everything(tmp_path) == ["a.labels.h5"]  # though nobody has waited for the process yet
    (tmp_path / unfinished).write_bytes(b"half")
    others = [unfinished.replace("a.labels", "b.labels"), ".a.labels.h5.elsewhere.4194305.tmp", ".a.labels.h5.x.tmp"]
    for name in others:
        (tmp_path / name).write_bytes(b"")
    write_stage(tmp_path / "a.labels.h5", RECIPE, labels())
    assert everything(tmp_path) == sorted([*others, "a.labels.h5"])


def test_files_need_no_plugin(labels_file: Path) -> None:
    """Assert that data lie in gzip chunks of at most 1 MiB, and small arrays in one piece."""
    with h5py.File(labels_file) as h5:
        assert (h5["label"].compression, h5["label"].shuffle, h5["label"].compression_opts) == ("gzip", True, 1)
        assert h5["onset_slice"].chunks is None
    with h5py.File("none", "w", driver="core", backing_store=False) as h5:
        wide = RowWriter(h5, "wide", np.float32, (300, 2), 10_000).dataset
        assert wide.chunks[0] * 300 * 2 * 4 <= chunks.CHUNK_BYTES
        assert wide.chunks[1:] == (300, 2)


@pytest.mark.parametrize(
    ("name", "trial"),
    [
        ("a.recording.h5", "a"),
        ("a.b.recording.h5", "a.b"),
        ("a.slip.report.h5", "a.slip"),
        ("a.h5", "a"),
        ("a.v2.h5", "a.v2"),
        ("events.aedat4", "events"),
        ("events.tar.gz", "events.tar"),
        ("events", "events"),
        ("recording.h5", "recording"),
        (".recording.h5", ".recording"),
        ("a.recording.recording.h5", "a.recording"),
    ],
)
def test_stem(name: str, trial: str) -> None:
    """Assert that the name of a trial is the file name without its kind, and only a kind is taken off."""
    assert stem(Path("folder") / name) == trial


def test_output_path() -> None:
    """Assert that outputs lie beside the input, in a folder, or in the file that is named."""
    source = Path("in/a.recording.h5")
    assert output_path(source, "tracks", None) == Path("in/a.tracks.h5")
    assert output_path(source, "tracks", Path("out")) == Path("out/a.tracks.h5")
    assert output_path(source, "tracks", Path("out/x.h5")) == Path("out/x.h5")
    assert output_path(source, "tracks", Path("v1.5")) == Path("v1.5/a.tracks.h5")


def test_more_than_fits_is_not_read_at_once(labels_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a dataset that is too long to be read whole says so, and is read in blocks."""
    monkeypatch.setattr(files, "MOST_READ_BYTES", 4 * SLICES - 1)
    with StageFile(labels_file) as file:
        with pytest.raises(InputError, match="relative_flow_px is too large"):
            file.read("relative_flow_px")
        blocks = [file.read("relative_flow_px", start, start + 1000) for start in range(0, SLICES, 1000)]
    np.testing.assert_array_equal(np.concatenate(blocks), labels()["relative_flow_px"])


@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
def test_m9_leftovers_are_removed_though_another_process_has_the_number_now(tmp_path: Path) -> None:
    """Assert that a number that was given away again does not keep what a dead process left, but a live one does."""
    path = tmp_path / "a.labels.h5"
    with replacing(path):
        (temporary,) = tmp_path.iterdir()
        started = temporary.name.split(".")[-3].partition("-")[2]
        assert started
        other = temporary.with_name(temporary.name.replace(f"-{started}", f"-{int(started) + 1}"))
        other.touch()
        assert disk.temporary_name(path, "") != temporary
        assert temporary.exists()
        assert not other.exists()


def test_nobody_can_guess_the_name_of_an_unfinished_file(tmp_path: Path) -> None:
    """Assert that names of the same file by the same process have nothing in common that is known beforehand.

    In a folder that others may write to, a link of that name would lead to any file of this user's.
    """
    path = tmp_path / "a.labels.h5"
    names = {disk.temporary_name(path).name for _ in range(50)}
    assert len(names) == 50
    assert len({name.split(".")[-2] for name in names}) == 50
    assert all(len(name.split(".")[-2]) >= 16 for name in names)


@pytest.mark.parametrize("target", ["precious", "nothing", "folder"])
def test_a_new_file_is_new(tmp_path: Path, target: str) -> None:
    """Assert that HDF5 is written neither through a link, nor over a file that is there."""
    (tmp_path / "precious").write_text("x")
    (tmp_path / "folder").mkdir()
    before = everything(tmp_path)
    (tmp_path / "a.tmp").symlink_to(tmp_path / target)
    for path in (tmp_path / "a.tmp", tmp_path / "precious"):
        with pytest.raises(FileExistsError), disk.new_file(path) as h5:
            h5["x"] = 1
    (tmp_path / "a.tmp").unlink()
    assert everything(tmp_path) == before and (tmp_path / "precious").read_text() == "x"


@pytest.mark.parametrize("blocked", ["a file in the folder", "a file of that name appears"])
def test_what_is_in_the_way_is_named_as_what_it_is(tmp_path: Path, blocked: str) -> None:
    """Assert that "the output folder is a file" is said of folders alone."""
    if blocked == "a file in the folder":
        (tmp_path / "out").touch()
        with (
            pytest.raises(InputError, match="the output folder is a file"),
            replacing(tmp_path / "out" / "a.labels.h5"),
        ):
            pass
        return
    with (
        pytest.raises(InputError, match="cannot be written: File exists"),
        disk.taking_the_place_of(tmp_path / "a.labels.h5") as temporary,
    ):
        temporary.touch()
        temporary.touch(exist_ok=False)
    assert everything(tmp_path) == []


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
