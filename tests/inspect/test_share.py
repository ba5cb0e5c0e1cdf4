"""share: folders for the Hugging Face Hub; the Hub's own library reads the cards in a slow test."""

import json
import os
import re
import shlex
import shutil
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.commands.share import Share
from evetac_cli.console import format_value
from evetac_cli.errors import InputError
from evetac_cli.evaluate.slip import EvaluateSlip
from evetac_cli.evaluate.slip import measure as slip
from evetac_cli.formats.write.hub_card import inline
from evetac_cli.inspect import share
from evetac_cli.inspect.share import sections
from evetac_cli.resources import PACKAGE
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests import small_files
from tests.conftest import Made


def fields(folder: Path) -> dict[str, Any]:
    """The front matter of a card: lines of a name and JSON."""
    lines = (folder / "README.md").read_text().splitlines()
    assert lines[0] == "---"
    pairs = (line.partition(": ") for line in lines[1 : lines.index("---", 1)])
    return {name: json.loads(value) for name, _, value in pairs}


def shared(*files: Path, out: Path, **chosen: Any) -> dict[str, Any]:
    (row,) = share.run(list(files), Share(**chosen), out).rows
    assert row["output"] == str(out)
    return row


@pytest.fixture
def trials(tmp_path: Path) -> Path:
    """A data set of one trial: its recording and tracks."""
    folder = tmp_path / "a trial"
    folder.mkdir()
    small_files.tracks(folder / "a.tracks.h5", small_files.recording(folder / "a.recording.h5"))
    return folder


def test_model_card(made: Made, tmp_path: Path) -> None:
    """Assert that the card of a model has its data, seeds and figures, marked as simulated, and the model is there."""
    out = tmp_path / "hub"
    row = shared(made.model, out=out, license="mit")
    assert sorted(path.name for path in out.iterdir()) == ["README.md", "hist10.model.h5", "model.onnx"]
    assert row["files"] == 3
    assert row["size_bytes"] == sum(path.stat().st_size for path in out.iterdir())
    assert (out / "hist10.model.h5").read_bytes() == made.model.read_bytes()
    page = (out / "README.md").read_text()
    with StageFile(made.model) as file:
        assert (out / "model.onnx").read_bytes() == file.read("onnx").tobytes()
        assert f"Recipe id `{file.header['id']}`" in page
        assert f"| threshold | {inline(format_value(float(file.read('threshold'))))} |" in page
        assert f"| preset | {file.header['parameters']['preset']} |" in page
    assert re.findall(
        r"^\| (trained on|validated on) \|.*\| (\d) \| (\d) \| \S+ (?:to \S+ )?\| yes \|$", page, re.M
    ) == [
        ("trained on", "2", "8"),
        ("validated on", "1", "8"),
    ]
    given = fields(out)
    assert given["license"] == "mit"
    assert given["pipeline_tag"] == "robotics"
    assert "simulated" in given["tags"]
    assert "**Simulated.**" in page
    assert "This card has no evaluation" in page
    assert "No license" not in page


@pytest.mark.slow
def test_model_card_with_a_report(made: Made, tmp_path: Path) -> None:
    """Assert that the figures of an evaluation are on the page and in the JSON, and no other model's are."""
    chosen = EvaluateSlip(model=made.model)
    (job,) = slip.jobs([made.folder / "apart.features.h5"], chosen, tmp_path / "apart.slip.report.h5")
    rows = slip.run(job, chosen).rows
    shared(made.model, job.output, out=tmp_path / "hub")
    page = (tmp_path / "hub" / "README.md").read_text()
    first = next(row for row in rows if "f1" in row)  # others are covariates of the slips
    (judged,) = re.findall(r"^\| evaluate slip \|.*\| (\S+) \| yes \|$", page, re.M)
    assert judged == inline(format_value(first["f1"])) and "This card has no evaluation" not in page
    other = tmp_path / "other.slip.report.h5"
    arrays = {"command": "evaluate slip", "rows": "[]", "summary": "{}"}
    write_stage(other, Recipe("report", 1, {}), arrays, force=True)
    with pytest.raises(InputError, match="not on this model"):
        shared(made.model, other, out=tmp_path / "hub2")
    assert not (tmp_path / "hub2").exists()


def test_a_model_that_makes_no_sense_is_not_shared(made: Made, tmp_path: Path) -> None:
    """Assert that what `validate` refuses in a model is refused here, in words, and that nothing is left."""
    shutil.copy(made.model, tmp_path / "own.model.h5")
    with h5py.File(tmp_path / "own.model.h5", "r+") as file:
        file["weights/fc3.weight"][...] = np.nan
    with pytest.raises(InputError, match="cannot be shared") as refused:
        shared(tmp_path / "own.model.h5", out=tmp_path / "hub")
    assert "fc3" in str(refused.value)
    assert not (tmp_path / "hub").exists()


def test_data_card(trials: Path, tmp_path: Path) -> None:
    """Assert that a folder of files is laid out below data/, with trials, kinds and duration on its card."""
    out = tmp_path / "hub"
    (trials / "a.csv").write_text("of somebody else")
    row = shared(trials, out=out, title='Slips: *one* | "two"\n---')
    names = {path.name for path in trials.glob("*.h5")}
    assert {path.name for path in (out / "data").iterdir()} == names
    for path in trials.glob("*.h5"):
        assert (out / "data" / path.name).read_bytes() == path.read_bytes()
    assert row["license"] == "none chosen"
    given = fields(out)
    assert given["license"] == "other"
    assert given["pretty_name"] == 'Slips: *one* | "two"\n---'
    assert given["task_categories"] == ["robotics"]
    page = (out / "README.md").read_text()
    assert '# Slips: \\*one\\* \\| "two" ---' in page
    assert "No license is chosen" in page
    assert "**Simulated.**" in page
    assert "| trials | 1 |" in page
    assert f"| duration\\_s | {format_value(small_files.SLICES / 1000)} |" in page.replace(
        "| duration_s", "| duration\\_s"
    )
    assert "| recording | 1 |" in page


def test_other_disks_get_a_copy(trials: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that files are copied where they cannot be linked."""

    def refused(*_: object, **__: object) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refused)
    shared(trials, out=tmp_path / "hub")
    source = next(trials.glob("*.recording.h5"))
    copy = tmp_path / "hub" / "data" / source.name
    assert copy.read_bytes() == source.read_bytes()
    assert copy.stat().st_ino != source.stat().st_ino


def test_a_folder_is_never_replaced(trials: Path, tmp_path: Path) -> None:
    """Assert that a folder with anything in it is refused and stays."""
    out = tmp_path / "hub"
    shared(trials, out=out, title="first")
    with pytest.raises(InputError, match="the output exists"):
        shared(trials, out=out, title="second")
    assert fields(out)["pretty_name"] == "first"


REFUSED: dict[str, tuple[str, str, dict[str, Any], str]] = {
    # name: what is shared, -o, flags, part of where
    "no model": ("data/a.tracks.h5", "hub", {}, "a.tracks.h5"),
    "an empty folder": ("empty", "hub", {}, "empty"),
    "into itself": ("data", "data/hub", {}, "data/hub"),
    "over its own folder": ("data", ".", {}, "."),
    "a damaged file": ("damaged", "hub", {}, "b.recording.h5"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case: str, trials: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert the place of the error, and that nothing is made."""
    monkeypatch.chdir(tmp_path)
    trials.rename("data")
    for name in ("empty", "damaged"):
        Path(name).mkdir()
    Path("damaged/b.recording.h5").write_bytes(b"\x89HDF\r\n\x1a\n broken")
    before = {path for path in Path().rglob("*") if not path.name.startswith(".")}
    source, out, flags, where = REFUSED[case]
    with pytest.raises(InputError) as refused:
        shared(Path(source), out=Path(out), **flags)
    assert where in refused.value.where
    assert {path for path in Path().rglob("*") if not path.name.startswith(".")} == before


def test_the_commands_of_the_page(made: Made, trials: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the commands of docs/share.md make the folders that the page describes."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(made.model, "own.model.h5")
    trials.rename("data")
    page = (PACKAGE.parent / "docs" / "share.md").read_text()
    for line in re.findall(r"^```sh\n(.*?)^```", page, re.MULTILINE | re.DOTALL):
        result = CliRunner().invoke(app, shlex.split(line)[1:])
        assert result.exit_code == 0, result.output
    described = set(re.findall(r"^\| `(\S+)` \|", page, re.MULTILINE))
    assert {path.name for path in Path("own-hub").iterdir()} == described
    if find_spec("pyarrow"):
        assert Path("data-hub/tables/train/a.parquet").is_file()
    assert fields(Path("data-hub"))["pretty_name"] == "Slips of glass"


def test_the_paper_is_that_of_citation_cff() -> None:
    """Assert that authors, title, journal and year are those of CITATION.cff."""
    paper = (PACKAGE.parent / "CITATION.cff").read_text().partition("preferred-citation:")[2]
    people = re.findall(r"family-names: (\S+), given-names: (\S+)}", paper)
    assert " and ".join(f"{family}, {given}" for family, given in people) in sections.PAPER
    for name in ("title", "journal"):
        (value,) = re.findall(rf'^  {name}: "(.+)"$', paper, re.MULTILINE)
        assert value in sections.PAPER
    (year,) = re.findall(r"^  year: (\d+)$", paper, re.MULTILINE)
    assert f"year = {{{year}}}" in sections.PAPER


def test_odd_names_stay_in_their_line() -> None:
    """Assert that the name of an author cannot end a block or the page."""
    assert sections.citation("A}\n```\n# B *C*", "model")[-1] == "Authors of this model: A} \\`\\`\\` \\# B \\*C\\*."
