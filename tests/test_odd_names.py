"""Files and folders whose names are not UTF-8, or are formulas to other programs: every command works with them."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from evetac_cli.resources import SCENES
from evetac_cli.store.files import StageFile
from evetac_cli.text_files import as_utf8
from tests import small_files
from tests.make import answer_of
from tests.quick import few

NAMES = {
    "no UTF-8": os.fsdecode(b"f\xe9\xffrst"),
    "all of it": os.fsdecode(b"\xff\xfe\xfd"),
    "a line and a sign": "a\nb\x1b[31m",
    "a mark of our pages": "@@STYLE@@<b>&",
}
COMMANDS = {
    "info": ("info {n}.recording.h5", "info ."),
    "info, some": ("info . --where path={n}.recording.h5", "info . --where path={n}.recording.h5,none"),
    "validate": ("validate .", "validate {n}.tracks.h5"),
    "report": ("report . -o page.html",),
    "view": ("view {n}.recording.h5 -f", "view {n}.tracks.h5 -o {n}.page.html"),
    "text": ("export {n}.recording.h5 --format text", "record --from {n}.txt --frame-size 640x480 -o out"),
    "aedat4": ("export {n}.recording.h5 --format aedat4", "record --from {n}.aedat4 -o out"),
    "dsec": ("export {n}.recording.h5 --format dsec", "record --from {n}.dsec.h5 -o out"),
    "calibration": ("export {n}.recording.h5 --format calibration", "calibrate --import {n}.calibration.json -o out"),
    "parquet": ("export {n}.recording.h5 --format parquet -f", "export . --format parquet -o {n}"),
    "share": ("share . -o ../{n}-hub --title {n}", "share . -o ../{n}-hub2"),
    "attach": (
        "attach {n}.recording.h5 --stream a={n}.csv -o out",
        "attach {n}.recording.h5 --stream b={n}.parquet -o out2",
    ),
    "label": ("label {n}.recording.h5 --method event-count -o out",),
    "evaluate": ("evaluate data-rate {n}.recording.h5 -o out", "evaluate data-rate . -o out2", "report out2"),
    "sensor": ("record --sensor {n}.sensor.toml --scene {n}.scene.toml --dry-run", "track . --config {n}.toml -o out"),
}


@pytest.fixture
def folder(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A trial, and files of other programs, of this name, in a folder of this name."""
    name = NAMES[request.param]
    folder = tmp_path / name
    folder.mkdir()
    header = small_files.recording(folder / f"{name}.recording.h5")
    small_files.tracks(folder / f"{name}.tracks.h5", header)
    (folder / f"{name}.csv").write_text("t_ms,x_m\n1,2\n3,4\n")
    table = pyarrow.table({"t_ms": np.arange(5), "x_m": np.arange(5.0)})
    with (folder / f"{name}.parquet").open("wb") as file:
        pyarrow.parquet.write_table(table, file)
    (folder / f"{name}.toml").write_text('[track]\npreset = "paper"\n')
    (folder / f"{name}.sensor.toml").write_text('like = "evetac"\n')
    shutil.copy(SCENES / "slip.toml", folder / f"{name}.scene.toml")
    return folder


def answer_with(words: str, name: str) -> Any:
    """The answer of a command, with the name put in after it was taken apart."""
    return answer_of(*(word.replace("{n}", name) for word in words.split()))


@pytest.mark.parametrize("folder", few(NAMES, "no UTF-8"), indirect=True)
@pytest.mark.parametrize("command", COMMANDS)
def test_commands_work_with_odd_names(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that each reads and writes them, that names come back as they are, and that what is written is valid."""
    monkeypatch.chdir(folder)
    name = folder.name
    if command == "attach" and as_utf8(name) != name:
        pytest.skip("pyarrow opens no file of such a name")
    for words in COMMANDS[command]:
        if "--import" in words and not as_utf8(name).isprintable():
            continue
        shown = answer_with(words, name)
        for row in shown["rows"]:
            for key in ("output", "page", "file"):
                if isinstance(row.get(key), str) and "{n}" in words:
                    assert name in row[key]
        if "path=" in words:
            assert [row["path"] for row in shown["rows"]] == [f"{name}.recording.h5"]
    for made in [*Path("out").glob("*.h5"), *Path("out2").glob("*.h5")]:
        StageFile(made).close()
    assert not [path for path in folder.rglob("*") if path.name.endswith(".tmp")]


@pytest.mark.parametrize("folder", NAMES, indirect=True)
def test_what_tables_and_cards_say_of_a_name(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the trial's name in a table is text, with odd bytes spelt out, and that a card is UTF-8."""
    monkeypatch.chdir(folder)
    name = folder.name
    answer_with("export {n}.recording.h5 --format parquet -o t.parquet", name)
    assert set(pyarrow.parquet.read_table("t.parquet")["trial"].to_pylist()) == {as_utf8(name)}
    answer_with("share . -o ../hub --title {n}", name)
    page = (folder.parent / "hub" / "README.md").read_text(encoding="utf-8")
    assert f"pretty_name: {as_utf8(json.dumps(name, ensure_ascii=False))}" in page
    assert (folder.parent / "hub" / "data" / f"{name}.recording.h5").exists()
    answer_with("report . -o page.html", name)
    Path("page.html").read_text(encoding="utf-8")


def test_text_in_a_file_that_is_no_utf8(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a unit and a name in a recording's own texts do no harm to tables and to the page."""
    small_files.recording(tmp_path / "a.recording.h5")
    with h5py.File(tmp_path / "a.recording.h5", "r+") as file:
        about = '{"what": "pose \\udcff", "units": {"x_m": "\\ud800"}}'
        del file["streams/arm/about"]
        file["streams/arm/about"] = about
    monkeypatch.chdir(tmp_path)
    for words in ("info a.recording.h5", "view a.recording.h5"):
        answer_with(words, "")
    for format_ in ("csv", "parquet", "mcap"):
        answer_with(f"export a.recording.h5 --format {format_}", "")
