"""report: what is read of a folder, what stands out, the paper beside it, and the page as a file."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.commands.report import Report
from evetac_cli.commands.view import View
from evetac_cli.jobs import silent
from evetac_cli.pages import report, shared, view
from evetac_cli.pages.report import figures
from evetac_cli.pages.report.study import Study, read_study, remark
from tests.make import evetac
from tests.pages.report.studies import slip_rows, write_report, write_trials
from tests.pages.view.trials import NASTY, ONSET, write_recording


def page_of(folder: Path, out: Path, **chosen: Any) -> str:
    report.run([folder], Report(**chosen), out, force=True)
    return out.read_text(encoding="utf-8")


def test_trials_have_their_onsets(study: Study) -> None:
    """Assert that truth, labels and detections of each trial are its own, also where files have the same name."""
    assert [trial.name for trial in study.trials] == [f"slip-00{number}" for number in range(5)]
    assert {trial.t_s for trial in study.trials} == {ONSET}
    assert [trial.label_error_ms for trial in study.trials] == [2, -1, None, 3, 40]
    assert [trial.late_by for trial in study.trials] == [[0], [-120], [5], [None], [4]]
    assert all(trial.thumbnail is not None and trial.events == 1200 for trial in study.trials)
    assert [path for path, _ in study.unreadable] == ["broken.labels.h5"]
    assert study.files == {"recording": 5, "labels": 5, "report": 2}


@pytest.fixture(scope="module")
def text(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The page of the study."""
    return page_of(folder, tmp_path_factory.mktemp("page") / "r.html")


def test_outliers_come_first(study: Study, text: str) -> None:
    """Assert that a trial stands out by what is wrong with it, and that the table begins with the worst."""
    remarks = [remark(trial)[1] for trial in study.trials]
    assert remarks == [
        "",
        "model 120 ms early",
        "slips, but the labels have no onset",
        "slip not found by the model",
        "labels 40 ms late",
    ]
    rows = re.findall(r"<tr id='trial-0-(\d)'", text)
    assert rows == ["2", "3", "1", "4", "0"]
    assert "4 of 5 trials are outliers" in text


def test_the_page_is_whole(text: str) -> None:
    """Assert that the page has trials, models beside the paper with a mark, and cases; no network."""
    assert "default-src 'none'" in text and "@@" not in text and "\0" not in text
    assert re.findall(r"<(?:script|link|img|iframe)[^>]*(?:src|href)='?\"?(?!data:)[a-z]+:", text) == []
    assert "0.5 <small class='paper'>(0.73, other method)</small>" in text
    assert text.index("<td>thick") < text.index("<td>thin")  # the case that is not ok comes first
    assert "&lt;b&gt;forces&lt;/b&gt; are balanced" in text
    assert "broken.labels.h5" in text
    for present in ("id='slip'", "id='stability'", ">simulated<"):
        assert present in text, present
    assert "id='grasp'" not in text


def test_charts(folder: Path, text: str, tmp_path: Path) -> None:
    """Assert that each point leads to the row of its trial, and that the plot beside a report is in its section."""
    pattern = r'xlink:href="#trial-0-(\d)"'
    labels, models = (re.findall(pattern, chart) for chart in re.findall(r"<svg.*?</svg>", text, re.DOTALL))
    assert (sorted(labels), sorted(models)) == (["0", "1", "3", "4"], ["0", "1", "2", "3", "4"])
    assert "<img alt='plot'" not in text
    shutil.copytree(folder, tmp_path / "again")
    (tmp_path / "again" / "s.slip.report.png").write_bytes(b"pixels")
    (tmp_path / "again" / "sim.stability.report.png").mkdir()
    again = page_of(tmp_path / "again", tmp_path / "r.html")
    assert again.count("src='data:image/png;base64,cGl4ZWxz'") == 1
    assert again.index("id='slip'") < again.index("cGl4ZWxz") < again.index("id='stability'") < again.index("<td>thick")
    assert "sim.stability.report.png" in again[again.index("cannot be read") :]


def test_a_page_of_its_own_is_linked(tmp_path: Path) -> None:
    """Assert that a trial leads to its page of view, from wherever the report lies, and to no other HTML file."""
    (tmp_path / "data").mkdir()
    recording = tmp_path / "data" / "a b.recording.h5"
    write_recording(recording)
    (tmp_path / "data" / "a b.html").write_text("of somebody else")
    assert "<a href='data/" not in page_of(tmp_path / "data", tmp_path / "r.html")
    view.run([recording], View(images=2), None, force=True)
    assert "<a href='data/a%20b.html'>" in page_of(tmp_path / "data", tmp_path / "r.html")
    assert "<a href='a%20b.html'>" in page_of(tmp_path / "data", tmp_path / "data" / "report.html")


def test_one_trial_and_none(tmp_path: Path) -> None:
    """Assert that one recording without truth makes a page, and so does a lone report."""
    write_recording(tmp_path / "a.recording.h5", 7, truth=False)
    text = page_of(tmp_path, tmp_path / "r.html")
    assert "0 of 1 trials are outliers" in text and ">simulated<" not in text
    assert "t_s [ms]</button>" not in text  # a column in which nothing is known is left out
    (tmp_path / "a.recording.h5").unlink()
    write_report(tmp_path / "g.cost.report.h5", "evaluate cost", [{"setting": "a", "error_ms": 1.0}], {})
    text = page_of(tmp_path, tmp_path / "r.html")
    assert "There are no trials here" in text and "id='cost'" in text


def test_text_from_files_is_escaped(tmp_path: Path) -> None:
    """Assert that names, scenes and texts of reports which look like markup stay text."""
    write_recording(tmp_path / "a\"'<img src=x onerror=alert(1)>@@BODY@@ü.recording.h5", 20, scene=NASTY)
    features = write_trials(tmp_path, [1])
    write_report(
        tmp_path / "s.report.h5", "evaluate slip", slip_rows(features, [1], setting=NASTY), {}, tuple(features)
    )
    text = page_of(tmp_path, tmp_path / "r.html")
    assert "document.title='owned'" not in text.replace("\\u003c", "<")
    assert "<img src=x" not in text


@pytest.mark.slow
def test_two_side_by_side(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that trials of the same recipe are matched, that changes come first, and that the name says both."""
    other = tmp_path / "other"
    other.mkdir()
    write_trials(other, [2, -1, 9], names="again-{}")
    monkeypatch.chdir(tmp_path)
    row = report.run([folder, other], Report(compare=True), None).rows[0]
    assert (row["page"], row["trials"]) == ("study-other.report.html", 8)
    text = Path("study-other.report.html").read_text()
    assert "3 pairs of trials: 3 by the same recipe. Without a partner: 2 of 5 of study and 0 of 3 of other." in text
    both = text[text.index("id='both'") : text.index("id='trials'")]
    assert re.findall(r"<tr><td>(slip-00\d)</td>", both) == ["slip-002", "slip-000", "slip-001"]
    studies = [read_study(folder, silent), read_study(other, silent)]
    pairs = figures.matched(studies).pairs
    assert [(one.name, two.name) for one, two in pairs] == [(f"slip-00{n}", f"again-{n}") for n in range(3)]
    for number, trial in enumerate(studies[1].trials):  # the same trials with another sensor
        trial.recording_id, trial.row = f"other-{number}", trial.row._replace(sensor="softer")
    assert figures.matched(studies).pairs == pairs
    assert "3 by the same scene, object, seed and trial number" in figures.matched(studies).words
    studies[1].trials.append(studies[1].trials[0])  # ambiguous
    assert len(figures.matched(studies).pairs) == 2


def test_abstentions_are_not_counted(study: Study) -> None:
    """Assert that a trial whose labels abstain is in no share, is no outlier, and is counted beside them."""
    last = study.trials[4]
    last.doubt, last.t_c, last.late_by, last.not_timed = "the slide stopped", None, [], 1
    of_name = {figure.name: figure for figure in figures.headline(study)}
    labelled, timed = of_name["onsets with a label"], of_name["timing correct, all models"]
    assert (labelled.value, labelled.over) == (3 / 4, "4 of 5 trials that slip; labels abstain in 1")
    assert timed.value == 2 / 4
    assert timed.over.startswith("4 of 5 pairs of trial and model; 1 left out: labels abstain")
    assert remark(last) == (0.0, "")


def test_sensors_of_one_name_are_told_apart(tmp_path: Path) -> None:
    """Assert that the filter has an entry for each of two sensor files without a name.

    So has a comparison of two folders in which each sensor is alone.
    """
    entries = []
    for name, pa in (("soft", 72e3), ("stiff", 290e3)):
        (tmp_path / name).mkdir()
        sensor = {"sensor": "own-sensor", "sensor_row": {"shear_modulus_pa": pa}}
        write_recording(tmp_path / name / f"{name}.recording.h5", 60, sensor=sensor)
        entries.append(f"<option value='own-sensor, shear_modulus_pa {pa:g}'>")
    text = page_of(tmp_path, tmp_path / "r.html")
    assert [text.count(entry) for entry in entries] == [1, 1]
    assert text.count("data-sensor='own-sensor, shear_modulus_pa 72000'") == 1
    report.run([tmp_path / "soft", tmp_path / "stiff"], Report(compare=True), tmp_path / "both.html")
    both = (tmp_path / "both.html").read_text(encoding="utf-8")
    assert [both.count(entry) for entry in entries] == [1, 1]
    assert "1 by the same scene, object, seed and trial number" in both


def test_command(folder: Path, tmp_path: Path) -> None:
    """Assert that the command writes the page, says so in the one shape, and keeps what exists."""
    page = tmp_path / "r.html"
    result = evetac("report", folder, "--json", "-o", page)
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    (row,) = answer["rows"]
    assert (answer["command"], answer["simulated"], row["page"]) == ("report", True, str(page))
    assert (row["trials"], row["outliers"], row["reports"], row["unreadable"]) == (5, 4, 2, 1)
    assert row["size_bytes"] == page.stat().st_size < shared.LARGEST_BYTES
    result = evetac("report", folder, "-o", page)
    assert (result.exit_code, "the output exists" in result.stderr) == (2, True)
