"""What a report offers as missing: only what suits the folder, as commands that can be copied and that run."""

import html
import re
import shlex
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli import resources
from evetac_cli.cli.main import app
from evetac_cli.commands.report import Report
from evetac_cli.jobs import silent
from evetac_cli.pages import report
from evetac_cli.pages.report.missing import Lack, missing
from evetac_cli.pages.report.study import read_study
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Header, Recipe
from tests.pages.report.studies import write_report
from tests.pages.view.trials import moving, write_labels, write_recording, write_tracks
from tests.quick import few

QUOTED = 'it\'s "quoted" & $HOME;'


def commands(folder: Path) -> list[str]:
    """The commands that are offered for a folder."""
    return [lack.command for lack in missing(read_study(folder, silent)) if lack.command]


def of_kind(folder: Path, **chosen: Any) -> Header:
    folder.mkdir(parents=True, exist_ok=True)
    name = f"{chosen.get('scene', 'slip')}-{chosen.get('seed', 1)}"
    return write_recording(folder / f"{name}.recording.h5", 20, **chosen)


def slips(folder: Path, seeds: tuple[int, ...] = (1, 2)) -> None:
    """Slips with labels, tracks and labelled features."""
    for seed in seeds:
        recording = of_kind(folder, seed=seed)
        labels = write_labels(folder / f"slip-{seed}.labels.h5", recording, 10, slices=20, begins=2)
        tracks = write_tracks(folder / f"slip-{seed}.tracks.h5", recording, moving(20))
        arrays = {
            "displacement_px": np.zeros((20, 6), np.float32),
            "events_per_dot": np.zeros((20, 6), np.int32),
            "events_total": np.zeros(20, np.int32),
            "events_outside": np.zeros(20, np.int32),
            "label": (np.arange(20) >= 10).astype(np.int8),
            "onset_slice": np.int64(10),
            "dot_shape": np.array([2, 3], np.int32),
        }
        write_stage(
            folder / f"slip-{seed}.features.h5", Recipe("features", 1, {}, parents=(tracks, labels)), arrays, force=True
        )


def test_only_what_suits_the_folder_is_offered(tmp_path: Path) -> None:
    """Assert that each kind of folder is offered its own evaluations, by its own name, and cost and stability never."""
    slips(tmp_path / "slips")
    for number in (1, 2):
        of_kind(tmp_path / "grasps", scene="lift", seed=number, grasp=True)
        of_kind(tmp_path / "tones", scene="vibration", seed=number)
        of_kind(tmp_path / "rates", scene="data-rate", seed=number)
        of_kind(tmp_path / "real", scene="", seed=number, truth=False)
    offered = {
        name: {tuple(words[1:3]) for command in commands(tmp_path / name) if (words := shlex.split(command))}
        for name in ("slips", "grasps", "tones", "rates", "real")
    }
    evaluated = {name: {two[1] for two in words if two[0] == "evaluate"} for name, words in offered.items()}
    assert evaluated["slips"] == {"slip", "labels", "tracking"}
    assert evaluated["grasps"] == {"grasp"}
    assert evaluated["tones"] == {"vibration"}
    assert evaluated["rates"] == {"data-rate"}
    assert evaluated["real"] == {"data-rate"}
    assert not {"label", "track", "featurize"} & {one for one, _ in offered["slips"] | offered["grasps"]}
    assert {one for one, _ in offered["real"]} == {"label", "track", "featurize", "evaluate"}
    of_kind(tmp_path / "real", scene="slip", seed=9)
    assert f"evetac evaluate realism {tmp_path}/real/-1.recording.h5 {tmp_path}/real/slip-9.recording.h5" in commands(
        tmp_path / "real"
    )


def test_what_was_evaluated_is_not_missing(tmp_path: Path) -> None:
    """Assert that an evaluation is offered until its report is there."""
    slips(tmp_path)
    assert any("evaluate labels" in command for command in commands(tmp_path))
    write_report(tmp_path / "a.labels.report.h5", "evaluate labels", [], {"method": "event-flow"})
    assert not any("evaluate labels" in command for command in commands(tmp_path))


@pytest.mark.parametrize("name", few(["plain", "with space", QUOTED, "-dash", "ünï", "glob[*]"], QUOTED, "-dash"))
def test_commands_can_be_copied(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a command is in code type, is a shell's words with the folder as one of them, and is no markup."""
    monkeypatch.chdir(tmp_path)
    slips(Path(name))
    report.run([Path(name)], Report(), tmp_path / "r.html", force=True)
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    section = text[text.index("id='missing'") : text.index("<footer>")]
    shown = [html.unescape(one) for one in re.findall(r"<code class='command'>(.*?)</code>", section)]
    assert len(shown) >= 3
    for command in shown:
        words = shlex.split(command)
        assert words[0] == "evetac" and Path(name) in [Path(word) for word in words[2:]], command
    assert "FOLDER" not in section and "PART" not in section


def test_commands_name_the_folders_where_files_lie(tmp_path: Path) -> None:
    """Assert that files in folders below are named by their folders, for commands do not look below."""
    for seed, name in enumerate(("a", "b")):
        of_kind(tmp_path / name, truth=False, seed=seed)
    assert f"evetac track {tmp_path}/a {tmp_path}/b" in commands(tmp_path)
    assert f"evetac label {tmp_path}/a {tmp_path}/b" in commands(tmp_path)


def test_a_recording_that_a_stage_refuses_is_not_named(tmp_path: Path) -> None:
    """Assert that beside recordings of which nothing can be made those of which it can are named one by one."""
    of_kind(tmp_path, seed=1)
    of_kind(tmp_path, seed=2)
    recording = of_kind(tmp_path, seed=3, scene="own")
    with h5py.File(tmp_path / "own-3.recording.h5", "r+") as file:  # a camera without a gel
        for name in ("dot_xy_px", "dot_radius_px", "window_px"):
            del file[f"sensor/{name}"]
    assert recording["id"]
    named = " ".join(f"{tmp_path}/slip-{seed}.recording.h5" for seed in (1, 2))
    assert commands(tmp_path)[:3] == [f"evetac {stage} {named}" for stage in ("track", "label", "featurize")]


def test_a_model_that_has_seen_the_trials_is_not_offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that slip is to be evaluated with models that never saw these trials: those in the folder, else the
    package's, and that where there is none a sentence says so.
    """
    slips(tmp_path / "data")
    (slip,) = [one for one in commands(tmp_path / "data") if "evaluate slip" in one]
    assert slip.endswith("--model shipped")
    seen = of_kind(tmp_path / "data", seed=1)
    other = of_kind(tmp_path / "elsewhere", seed=77)
    monkeypatch.setattr(
        "evetac_cli.pages.report.missing.trained_on",
        lambda path: {"package": {seen["id"]}, "fresh": {other["id"]}, "used": {seen["id"]}}[
            "package" if path == resources.MODEL else path.name.split(".")[0]
        ],
    )
    lacks = missing(read_study(tmp_path / "data", silent))
    (lack,) = [lack for lack in lacks if "Slip detection" in lack.says]
    assert lack == Lack(lack.says) and "may have been trained on these trials" in lack.says
    for name in ("fresh", "used"):
        (tmp_path / "data" / f"{name}.model.h5").write_bytes(resources.MODEL.read_bytes())
    (slip,) = [one for one in commands(tmp_path / "data") if "evaluate slip" in one]
    assert slip.endswith(f"--model {tmp_path}/data/fresh.model.h5")


@pytest.mark.slow
def test_the_commands_run(tmp_path: Path) -> None:
    """Assert that what is offered for a recording, from its first stage to its evaluations, ends without an error."""
    run = CliRunner()
    assert (
        run.invoke(
            app, ["record", "--scene", "slip", "--object", "8", "--seed", "70123", "-o", str(tmp_path)]
        ).exit_code
        == 0
    )
    for _ in range(4):
        offered = commands(tmp_path)
        for command in offered:
            result = run.invoke(app, shlex.split(command)[1:])
            assert result.exit_code == 0, (command, result.output)
        if not offered:
            break
    assert commands(tmp_path) == []
