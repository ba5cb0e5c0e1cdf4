"""repair: a valid recording of what broke off, nothing lost by trying, and figures that add up."""

import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.inspect import validate
from evetac_cli.resources import PACKAGE
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings import segments
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.store.recordings.segments import RecordingWriter
from tests.patience import until
from tests.store.recordings.test_recovery import RECIPE, STATIC, broken_off, events_of


@pytest.fixture(autouse=True)
def no_timer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Segments are closed by the tests, not by the time that passes."""
    monkeypatch.setattr(segments, "SEGMENT_S", 1e9)


def gripper(k: int) -> dict[str, float]:
    """A row of every second slice."""
    names = ("current_target_ma", "current_written_ma", "current_ma", "position_ticks")
    return {"gripper/t_us": 1000 * k, **{f"gripper/{name}": k for name in names}} if k % 2 == 0 else {}


def test_repaired_is_what_was_recorded(tmp_path: Path) -> None:
    """Assert that all closed segments are in a valid file, whose header says whence and that it broke off."""
    folder = broken_off(tmp_path, [2, 3, 1], gripper)
    result = validate.repair([folder])
    (row,) = result.rows
    assert (row["status"], row["slices_kept"], row["slices_lost"], row["events_kept"]) == ("repaired", 6, 0, 18)
    assert row["gripper_rows_kept"] == 3
    assert not folder.exists()
    path = tmp_path / "a.recording.h5"
    assert validate.run([path]).rows[0]["faults"] is None
    with open_recording(path) as recording:
        for k, events in enumerate(recording):
            assert all((one == other).all() for one, other in zip(events, events_of(k), strict=True))
        assert recording.read("gripper/t_us").tolist() == [0, 2000, 4000]
        assert recording.read("capture/ended") == validate.ENDED
        assert not recording.has("capture/lost_slices")
        header = recording.header
    assert header["parameters"] == RECIPE.parameters
    assert header["simulated"]  # as the recording that was replayed
    assert header["content"] is not None
    assert [header["parents"]] == [[parent["id"] for parent in RECIPE.parents]]


def test_gap_stays_in_time(tmp_path: Path) -> None:
    """Assert that the slices of a lost segment exist, empty and named, and later events keep their time."""
    folder = broken_off(tmp_path, [2, 3, 4], lambda k: {"control/probability": k / 10} | control(k))
    (folder / "000001.h5").write_bytes(b"")
    (row,) = validate.repair([tmp_path]).rows
    assert (row["slices_kept"], row["slices_lost"], row["segments_unreadable"]) == (6, 3, 1)
    with open_recording(tmp_path / "a.recording.h5") as recording:
        assert [events.size for events in recording] == [3, 3, 0, 0, 0, 3, 3, 3, 3]
        assert (recording[5].t == events_of(5).t).all()
        assert recording.read("capture/lost_slices").tolist() == [[2, 5]]
        probability = recording.read("control/probability")
    assert np.isnan(probability[2:5]).all()
    np.testing.assert_allclose(probability[5:], [0.5, 0.6, 0.7, 0.8], rtol=1e-6)
    assert validate.run([tmp_path / "a.recording.h5"]).rows[0]["faults"] is None


def control(k: int) -> dict[str, float]:
    """What a controller did; every second slice."""
    from evetac_cli.store.layout import schema

    named = (row for row in schema.load("recording").datasets if row.path.startswith("control/") and row.dims)
    return {row.path: 1 for row in named if row.dims == ("control_steps",) and not row.optional} if k % 2 == 0 else {}


def test_invalid_result_costs_nothing(tmp_path: Path) -> None:
    """Assert that rows that do not make a recording are reported, and leave the folder as it was and no file."""
    folder = broken_off(tmp_path, [2], lambda k: {"gripper/t_us": 1000 * k})
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    result = validate.repair([folder])
    assert result.summary["invalid"] == 1
    assert "gripper/current_ma is missing" in str(result.rows[0]["fault"])
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.recording.part"]


def test_existing_recording_is_not_replaced(tmp_path: Path) -> None:
    """Assert that what was left beside a recording that exists is kept, and the recording too."""
    folder = broken_off(tmp_path, [2])
    validate.repair([folder])
    before = (tmp_path / "a.recording.h5").read_bytes()
    again = broken_off(tmp_path, [3])
    (row,) = validate.repair([again]).rows
    assert row["status"] == "not repaired"
    assert "exists" in str(row["fault"])
    assert again.is_dir()
    assert (tmp_path / "a.recording.h5").read_bytes() == before


def test_folder_of_a_complete_recording_is_removed(tmp_path: Path) -> None:
    """Assert that a folder that was only not removed goes, once the recording is found valid; else it stays."""
    folder = broken_off(tmp_path, [2])
    validate.repair([folder])
    folder = broken_off(tmp_path, [2])
    (folder / segments.JOINED).touch()
    assert validate.repair([folder]).rows[0]["status"] == "was complete"
    assert not folder.exists()
    folder = broken_off(tmp_path, [2])
    (folder / segments.JOINED).touch()
    (tmp_path / "a.recording.h5").write_bytes(b"")
    assert validate.repair([folder]).rows[0]["status"] == "not repaired"
    assert folder.is_dir()


def test_kill_while_joining(tmp_path: Path) -> None:
    """Assert that what a join that was killed left goes too, and nothing else of that folder."""
    broken_off(tmp_path, [2])
    dead = f"{platform.node()}.999999999.ab.tmp"
    (tmp_path / f".a.recording.h5.{dead}").write_bytes(b"half")
    others = [f".b.recording.h5.{dead}", ".a.recording.h5.elsewhere.999999999.ab.tmp", ".a.recording.h5.notes.tmp"]
    for name in others:
        (tmp_path / name).write_bytes(b"of another")
    assert validate.repair([tmp_path]).rows[0]["status"] == "repaired"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*others, "a.recording.h5"])


@pytest.mark.parametrize("name", ["notes.txt", "7.h5", "plots/a.png"])
def test_what_no_recorder_wrote_stays(name: str, tmp_path: Path) -> None:
    """Assert that a file of somebody else's in the folder outlives `repair` and a new recording, and is named."""
    folder = broken_off(tmp_path, [2])
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text("mine")
    (row,) = validate.repair([folder]).rows
    assert row["status"] == "repaired"
    assert row["left_in_folder"] == name.partition("/")[0]
    assert [path.name for path in folder.iterdir()] == [name.partition("/")[0]]
    (tmp_path / "a.recording.h5").unlink()
    with pytest.raises(InputError, match="not from a recording"):
        RecordingWriter(tmp_path / "a.recording.h5", STATIC)
    assert (folder / name).read_text() == "mine"
    assert [path.name for path in folder.iterdir()] == [name.partition("/")[0]]


def test_nothing_to_repair(tmp_path: Path) -> None:
    """Assert that a folder without a segment, and what is no folder, are refused in words; an empty search is none."""
    writer = RecordingWriter(tmp_path / "a.recording.h5", STATIC, recipe=RECIPE)
    writer._lock.close()  # as if it had been killed
    assert "no slice of this recording" in str(validate.repair([writer.folder]).rows[0]["fault"])
    with pytest.raises(InputError, match="no such file"):
        validate.repair([tmp_path / "nothing"])
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="not the folder of an interrupted recording"):
        validate.repair([tmp_path / "file"])
    (tmp_path / "file.part").write_text("")
    none, file, empty = validate.repair([tmp_path / f"{name}.part" for name in ("no", "file", "a.recording")]).rows
    assert "no such file" in none["fault"]
    assert "not the folder" in file["fault"]
    assert "no slice" in empty["fault"]
    (tmp_path / "sub").mkdir()
    assert validate.repair([tmp_path / "sub"]).rows == []


@pytest.mark.parametrize("after_s", [0.05, pytest.param(0.35, marks=pytest.mark.slow)])
def test_killed_recording_is_repaired(after_s: float, long_recording: Path, tmp_path: Path) -> None:
    """Assert that a device-like recording that was killed is repaired, and holds the first slices of what was played.

    scripts/attack/kill_recordings.py does this many times and measures the loss.
    """
    output = tmp_path / "k.recording.h5"
    arguments = [
        "record",
        "--camera",
        f"replay:{long_recording}",
        "--expected-event-rate",
        "1e5",
        "-o",
        str(output),
    ]
    run = subprocess.Popen([sys.executable, "-m", "evetac_cli", *arguments], cwd=PACKAGE.parent)
    assert until(lambda: (output.with_suffix(".part") / "000000.h5").exists() or run.poll() is not None)
    time.sleep(after_s)
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    (row,) = validate.repair([tmp_path]).rows
    assert row["status"] == "repaired"
    with open_recording(output) as repaired, open_recording(long_recording) as played:
        assert 0 < len(repaired) <= len(played)
        whole, part = played.between(0, len(repaired)), repaired.between(0, len(repaired))
        assert all((one == other).all() for one, other in zip(whole, part, strict=True))
    with StageFile(output) as file, StageFile(long_recording) as parent:
        assert file.header["parents"] == [parent.header["id"]]


def test_m5_a_segment_with_a_huge_number_ends_in_words(tmp_path: Path) -> None:
    """Assert that a file whose name is a number that no recording reaches is one line, not a wait without end."""
    folder = broken_off(tmp_path, [2, 3])
    (folder / "99999999999.h5").touch()
    (row,) = validate.repair([folder]).rows
    assert (row["status"], row["slices_kept"], row["slices_lost"]) == ("repaired", 5, 0)
    assert "99999999999" in row["unreadable"]
    assert len(row["unreadable"]) < 500


def group_for_a_dataset(h5: h5py.File) -> None:
    del h5["events/t"]
    h5.create_group("events/t")


def far_in_the_future(h5: h5py.File) -> None:
    """A segment without an event, so that no time contradicts its place."""
    h5.attrs["first_slice"] = 2**40
    h5["events_per_slice"][...] = 0
    h5["events_per_slice"].attrs["crc32"] = segments.checksum(h5["events_per_slice"][()])
    for name in "txyp":
        dtype = h5[f"events/{name}"].dtype
        del h5[f"events/{name}"]
        h5[f"events/{name}"] = np.empty(0, dtype)
        h5[f"events/{name}"].attrs["crc32"] = 0


@pytest.mark.parametrize("change", [group_for_a_dataset, far_in_the_future], ids=lambda change: change.__name__)
def test_m4_a_senseless_segment_is_left_out_in_words(tmp_path: Path, change: Callable[[h5py.File], None]) -> None:
    """Assert that a segment that no recorder wrote is named with what is wrong, and the others are kept."""
    folder = broken_off(tmp_path, [2, 3, 4])
    with h5py.File(folder / "000002.h5", "r+") as h5:
        change(h5)
    (row,) = validate.repair([folder]).rows
    assert (row["status"], row["slices_kept"], row["segments_unreadable"]) == ("repaired", 5, 1)
    assert "000002: " in str(row["unreadable"])


@pytest.mark.parametrize(
    "recipe", ["[1]", "{}", '{"kind": ["recording"], "method": 1, "parameters": {}, "parents": []}']
)
def test_m4_a_senseless_recipe_ends_in_words(tmp_path: Path, recipe: str) -> None:
    """Assert that a folder whose recipe was edited is reported, and kept."""
    folder = broken_off(tmp_path, [2])
    with h5py.File(folder / "static.h5", "r+") as h5:
        h5.attrs["recipe"] = recipe
    (row,) = validate.repair([folder]).rows
    assert "cannot be read" in str(row["fault"])
    assert len(str(row["fault"])) < 1000
    assert folder.is_dir()
