"""scripts/docs: what a user can name has a place in the reference, its snippets run, and a broken site is noticed."""

import re
import shutil
from pathlib import Path
from typing import Any

import pytest

import evetac_cli
from evetac_cli import commands, resources
from evetac_cli.commands.label import Label
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.evaluate import SUBJECTS
from evetac_cli.kernels.grip.control import LAWS
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.kernels.slip.training import ADAPT, PRESETS
from evetac_cli.kernels.tracking import presets
from evetac_cli.sim.setup.parts import PARTS
from evetac_cli.store.layout import schema
from scripts.docs import check_site, command_pages, page_text, pages
from tests import small_files

ROOT = Path(__file__).resolve().parents[3]
SNIPPET = re.compile(r"^( *)```python\n(.*?)^ *```", re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def every() -> dict[str, str]:
    """All reference pages, by their paths."""
    return pages.every_page()


def headings(text: str) -> set[str]:
    """The headings of a page; of those with several words also the last, as in `Tracker preset stable`."""
    named = re.findall(r"^#{2,3} (.+)$", text, re.MULTILINE)
    return {*named, *(heading.split()[-1] for heading in named)}


def choices(of: type, name: str) -> set[str]:
    return set(of.__dataclass_fields__[name].metadata["choices"])  # type: ignore[attr-defined]


def test_every_command_and_option_has_a_place(every: dict[str, str]) -> None:
    """Assert that each command of the program has a page that names all of its options and files."""
    subjects = {f"evaluate {subject.name}" for subject in SUBJECTS}
    assert set(command_pages.every_command()) == {*commands.every(), *subjects}
    for name, command in command_pages.every_command().items():
        text = every[f"commands/{command_pages.page_name(name)}"]
        assert text.startswith(f"{page_text.MADE}# evetac {name}\n")
        missing = [flag for param in command.params for flag in param.opts if flag.startswith("-") and flag not in text]
        assert missing == [], name
        assert f"({command_pages.page_name(name)})" in every["commands/index.md"]


def test_a_page_says_what_a_parameter_is(every: dict[str, str]) -> None:
    """Assert that range, unit, choices and default of a parameter stand in its row."""
    text = every["commands/label.md"]
    (row,) = [line for line in text.splitlines() if line.startswith("| `--look-ahead-ms`")]
    assert row.endswith("| 1 to 100 ms | `4` |")
    (row,) = [line for line in text.splitlines() if line.startswith("| `--method`")]
    assert row.endswith("| `event-flow`, `farneback`, `dis`, `event-count`, `truth` | `event-flow` |")


def test_every_kind_of_file_and_dataset_has_a_place(every: dict[str, str]) -> None:
    """Assert that each kind has a page with all of its datasets, their dtypes and units."""
    for kind in schema.KINDS:
        text = every[f"files/{kind}.md"]
        for row in schema.load(kind).datasets:
            (line,) = [line for line in text.splitlines() if line.startswith(f"| `{row.path}` |")]
            assert ("text" if row.dtype == "utf8" else f"`{row.dtype}`") in line
            assert f"| {row.unit} |" in line


@pytest.mark.parametrize(
    ("page", "names"),
    [
        ("scenes.md", {path.stem for path in resources.SCENES.glob("*.toml")}),
        ("sensors.md", set(resources.table("sensors"))),
        ("presets.md", {*presets.PRESETS, *PRESETS, ADAPT.name, *choices(Label, "method")}),
        ("controllers.md", {*LAWS, "none", "fixed:N"}),
        ("models.md", {*ARCHITECTURES, *choices(TrainForce, "method"), "slip-10ms"}),
    ],
)
def test_every_name_has_a_section(every: dict[str, str], page: str, names: set[str]) -> None:
    """Assert that what can be chosen by name has a section."""
    assert names - headings(every[page]) == set()


def test_every_part_has_a_section_and_keys(every: dict[str, str]) -> None:
    """Assert that parts of scenes and sensors have sections, whose keys are those of the schemas."""
    assert {part.name for part in PARTS} - headings(every["parts.md"]) == set()
    assert "| `leak_hz` | sensor | leak events per second of every pixel | 0 to 10 |" in every["parts.md"]
    assert "| `drop.mass_g` |" in every["scene-keys.md"]
    assert "| `creep.share` |" in every["sensors.md"]


def test_every_public_name_of_python_has_a_place(every: dict[str, str]) -> None:
    """Assert that the page of Python names all of `__all__`, each once."""
    named = re.findall(r"^::: evetac_cli\.(\w+)$", every["python.md"], re.MULTILINE)
    assert sorted(named) == sorted(evetac_cli.__all__)


def test_committed_pages_are_those_of_the_code(every: dict[str, str]) -> None:
    """Assert that docs/reference/ is what scripts/docs/pages.py writes, but for copies of files of the repository."""
    folder = ROOT / "docs" / "reference"
    made = {path: text for path, text in every.items() if path not in pages.OF_THE_REPOSITORY}
    found = {str(path.relative_to(folder)): path.read_text("utf-8") for path in folder.rglob("*.md")}
    assert {path: text for path, text in found.items() if path not in pages.OF_THE_REPOSITORY} == made


def test_every_page_is_in_the_navigation(every: dict[str, str]) -> None:
    """Assert that mkdocs.yml leads to each page of the reference, and to each page of docs/."""
    nav = (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2].split()
    docs = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}
    written = docs | {f"reference/{path}" for path in every}
    assert sorted(written - set(nav)) == []


def test_snippets_run(every: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that every snippet in Python reads what the file holds, with its unit and the names of its axes."""
    small_files.every_kind(tmp_path)
    monkeypatch.chdir(tmp_path)
    ran = 0
    for page in ("files/index.md", *(f"files/{kind}.md" for kind in schema.KINDS)):
        for indent, snippet in SNIPPET.findall(every[page]):
            names: dict[str, Any] = {}
            exec(re.sub(rf"^{indent}", "", snippet, flags=re.MULTILINE), names)
            ran += 1
            if page == "files/tracks.md" and "units" in names:
                assert (names["units"], names["dot_xy_px"].shape) == ("px", (24, 12, 2))
            if page == "files/tracks.md" and "xarray" in names:
                assert names["dot_xy_px"].dims == ("slices", "dots", "xy")
            if "frame" in names:
                assert len(names["frame"]) > 0
    assert ran == 1 + 3 * len(schema.KINDS)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the pages were written over themselves."""
    folder = tmp_path_factory.mktemp("pages")
    pages.write(folder)
    assert len(pages.write(folder)) > 30
    return folder


@pytest.mark.parametrize("name", ["thesis.tex", "deep/notes.md", "python.md"])
def test_a_folder_of_other_things_is_not_written_over(name: str, written: Path, tmp_path: Path) -> None:
    """Assert that pages are written over pages alone, and that nothing of somebody else's is removed."""
    shutil.copytree(written, tmp_path, dirs_exist_ok=True)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    before = sorted(path.name for path in tmp_path.rglob("*"))
    with pytest.raises(SystemExit, match=name):
        pages.write(tmp_path)
    assert (tmp_path / name).read_text() == "mine" and sorted(path.name for path in tmp_path.rglob("*")) == before


WHOLE = '<h1 id="top">A</h1><p>text</p><a href="b.html#there">b</a><a href="https://example.org">out</a>'
OTHER = '<h2 id="there">B</h2><img src="a.png">'


@pytest.mark.parametrize(
    ("page", "said"),
    [
        ("", []),
        ('<a href="c.html">c</a>', ["broken link c.html"]),
        ('<a href="b.html#nowhere">c</a>', ["no anchor for b.html#nowhere"]),
        ('<a href="#nowhere">c</a>', ["no anchor for #nowhere"]),
        ('<img src="lost.png">', ["broken link lost.png"]),
        ('<script src="https://example.org/a.js"></script>', ["loads https://example.org/a.js"]),
        ('<link rel="stylesheet" href="//example.org/a.css">', ["loads //example.org/a.css"]),
        ('<link rel="preconnect" href="https://example.org">', ["loads https://example.org"]),
        ('<link rel="canonical" href="https://example.org">', []),
        ('<p style="background: url(https://example.org/a.png)">x</p>', ["loads https://example.org/a.png"]),
        ("<style>@import 'https://example.org/a.css';</style>", ["loads https://example.org/a.css"]),
        ("<p>a list:\n- one\n- two</p>", ["Markdown left as text: 'a list:\\n- one\\n- two'"]),
        ("<p>| a | b |\n| --- | --- |</p>", ["Markdown left as text: '| a | b |\\n| --- | --- |'"]),
        ("<p>a <code>| b |</code> c - d</p>", []),
    ],
)
def test_what_is_wrong_with_a_site_is_noticed(tmp_path: Path, page: str, said: list[str]) -> None:
    """Assert that broken links and anchors, loads from elsewhere and Markdown that nobody rendered are named."""
    (tmp_path / "a.html").write_text(WHOLE + page)
    (tmp_path / "b.html").write_text(OTHER)
    (tmp_path / "a.png").write_bytes(b"")
    assert check_site.problems(tmp_path) == [f"a.html: {line}" for line in said]
