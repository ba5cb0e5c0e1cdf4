"""What `view` and `report` refuse, before they write anything."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.commands.report import Report
from evetac_cli.commands.view import View
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.pages import report, view
from tests.pages.view.trials import write_labels, write_recording, write_trial

REFUSED: dict[str, tuple[str, tuple[str, ...], Any, str | None, str]] = {
    # name: command, inputs, parameters, -o, part of where
    "no time left": ("view", ("a.recording.h5",), View(start_s=0.3), None, "--stop-s"),
    "empty part": ("view", ("a.recording.h5",), View(start_s=0.2, stop_s=0.2), None, "--stop-s"),
    "a folder": ("view", (".",), View(), None, "."),
    "two trials": ("view", ("a.recording.h5", "b.labels.h5"), View(), None, "b.labels.h5"),
    "two recordings": ("view", ("a.recording.h5", "copy.recording.h5"), View(), None, "copy.recording.h5"),
    "truncated": ("view", ("truncated.tracks.h5",), View(), None, "truncated.tracks.h5"),
    "of no kind of page": ("view", ("a.recording.h5",), View(), "x.h5", "--out"),
    "over an input": ("view", ("a.recording.h5",), View(), "a.recording.h5", "--out"),
    "over a folder": ("view", ("a.recording.h5",), View(), "folder.html", "folder.html"),
    "below a file": ("view", ("a.recording.h5",), View(images=1), "a.tracks.h5/x.html", "a.tracks.h5"),
    "too long": ("view", ("a.recording.h5",), View(), "a" * 240 + ".html", "aaa"),
    "nothing there": ("report", ("gone",), Report(), None, "gone"),
    "no folder": ("report", ("a.recording.h5",), Report(), None, "a.recording.h5"),
    "no evetac files": ("report", ("folder.html",), Report(), None, "folder.html"),
    "two folders": ("report", (".", "."), Report(), None, "evetac report"),
    "one to compare": ("report", (".",), Report(compare=True), None, "--compare"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two trials, a copy, a truncated file, and a folder with the name of a page."""
    folder = tmp_path_factory.mktemp("refused")
    trial = write_trial(folder)
    other = write_recording(folder / "b.recording.h5", scene="other")
    write_labels(folder / "b.labels.h5", other)
    shutil.copy(trial, folder / "copy.recording.h5")
    tracks = (folder / "a.tracks.h5").read_bytes()
    (folder / "truncated.tracks.h5").write_bytes(tracks[: len(tracks) // 2])
    (folder / "folder.html" / "a.html").mkdir(parents=True)
    return folder


@pytest.mark.parametrize("name", REFUSED)
def test_refused(folder: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert the type and the place of the error, and that no file is made or changed."""
    monkeypatch.chdir(folder)
    command, inputs, params, out, where = REFUSED[name]
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    module: Any = {"view": view, "report": report}[command]
    with pytest.raises(EvetacError) as raised:
        module.run([Path(one) for one in inputs], params, out and Path(out), force=True)
    assert isinstance(raised.value, InputError) or name == "below a file"
    assert where in raised.value.where
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
