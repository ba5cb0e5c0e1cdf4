"""A model that calls every slice slip, or none: said by train, by who reads it, and refused by grasp."""

import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import evetac_cli as evetac
from evetac_cli import resources
from evetac_cli.cli.main import app
from evetac_cli.commands.grasp import Grasp
from evetac_cli.errors import InputError
from evetac_cli.stages import train
from evetac_cli.stages.model_files import why_useless
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.trials import grasp
from tests.conftest import Made


def rewritten(source: Path, target: Path, **changed: Any) -> Path:
    """A model file with other contents under some names, `__` for a slash."""
    with StageFile(source, "model") as file:
        arrays = {name: file.read(name) for name in file.contents()}
    arrays |= {name.replace("__", "/"): value for name, value in changed.items()}
    write_stage(target, Recipe("model", train.METHOD, {}), arrays)
    return target


@pytest.fixture
def natural_first_try(made: Made, tmp_path: Path) -> tuple[list[str], Path]:
    """Two trials, and a training that is much too short: the words of the command, and the model."""
    features = [made.beside(path, "features") for path in made.recordings[:2]]
    out = tmp_path / "first.model.h5"
    return ["train", *map(str, features), "--max-steps", "2", "--epochs", "1", "-o", str(out)], out


def test_training_on_two_trials_says_what_came_of_it(natural_first_try: tuple[list[str], Path]) -> None:
    """Assert that a threshold of 0 is said in words below the table, also the second time, and stands in the file."""
    words, out = natural_first_try
    for _ in range(2):
        run = CliRunner().invoke(app, words)
        assert run.exit_code == 0, run.stderr
        said = " ".join(run.stdout.split())
        assert f"{out} is not a slip detector: at its threshold, 0, it calls every slice" in said
        assert "`grasp` refuses it. Try: train for more steps" in said
    with StageFile(out, "model") as file:
        assert float(file.read("threshold")) == 0.0
        assert float(file.read("validation/detected_share")) == 1.0
        assert 0.0 < float(file.read("validation/slip_share")) < 1.0
    assert "detected_share" in CliRunner().invoke(app, ["info", str(out)]).stdout


def test_grasp_refuses_it(natural_first_try: tuple[list[str], Path], tmp_path: Path) -> None:
    """Assert that no gripper is moved by it, simulated or virtual, and that the reason and the way out are said."""
    words, out = natural_first_try
    CliRunner().invoke(app, words)
    with pytest.raises(InputError, match="this model is not a slip detector") as refused:
        grasp.jobs([], Grasp(model=out), tmp_path / "a.recording.h5")
    assert "calls every slice" in str(refused.value) and "--validate" in str(refused.value)
    for more in (["--dry-run"], ["--camera", "virtual", "--gripper", "virtual", "--dry-run"], []):
        run = CliRunner().invoke(app, ["grasp", "--model", str(out), "-o", str(tmp_path / "b.recording.h5"), *more])
        assert (run.exit_code, "not a slip detector" in run.stderr) == (2, True), run.stderr
    assert not list(tmp_path.glob("*.recording*"))


def test_whoever_reads_it_is_told(natural_first_try: tuple[list[str], Path], made: Made, tmp_path: Path) -> None:
    """Assert that SlipDetector, `evaluate slip`, `view` and `share` say so, and go on; a card says it first."""
    words, out = natural_first_try
    CliRunner().invoke(app, words)
    with evetac.open_recording(made.recordings[0]) as recording:
        with pytest.warns(UserWarning, match="is not a slip detector"):
            evetac.SlipDetector(recording, out)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            evetac.SlipDetector(recording)
    features = made.beside(made.folder / "apart.recording.h5", "features")
    run = CliRunner().invoke(
        app, ["evaluate", "slip", str(features), "--model", str(out), "-o", str(tmp_path / "r.h5")]
    )
    assert run.exit_code == 0, run.stderr
    assert f"note: {out} is not a slip detector" in run.stderr
    shutil.copy(features, tmp_path / "a.features.h5")
    run = CliRunner().invoke(app, ["view", str(tmp_path / "a.features.h5"), str(out), "--images", "1"])
    assert "is not a slip detector" in run.stdout
    run = CliRunner().invoke(app, ["share", str(out), "-o", str(tmp_path / "hub"), "--json"])
    assert "slip detector: at its threshold" in json.loads(run.stdout)["summary"]["notes"]
    page = (tmp_path / "hub" / "README.md").read_text()
    assert page.index("slip detector:** at its threshold, 0, it calls every slice") < page.index("## The model")


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({}, ""),
        ({"threshold": 0.0, "validation__detected_share": 0.5}, "at its threshold, 0, it calls every slice"),
        ({"threshold": 0.025, "validation__detected_share": 1.0}, "at its threshold, 0.025, it calls every slice"),
        ({"threshold": 1.0, "validation__detected_share": 0.0}, "at its threshold, 1, it calls no slice"),
        ({"validation__detected_share": 0.003}, ""),
        ({"validation__detected_share": 1.0, "validation__slip_share": 1.0}, "have no slice without slip"),
    ],
)
def test_what_is_useless(tmp_path: Path, changed: dict[str, float], why: str) -> None:
    """Assert which models are refused: by the share of slices that they detect, or a threshold of 0 by itself."""
    arrays = {name: np.float64(value) for name, value in changed.items()}
    with StageFile(rewritten(resources.MODEL, tmp_path / "a.model.h5", **arrays), "model") as file:
        said = why_useless(file)
    assert (why in said) and bool(why) == bool(said)
