"""The word `shipped` names the package's model wherever a model is taken, on the command line and from Python."""

import dataclasses
import inspect
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import evetac_cli as evetac
from evetac_cli.cli.main import app
from evetac_cli.commands import every
from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.train import Train
from evetac_cli.errors import InputError
from evetac_cli.evaluate import SUBJECTS
from evetac_cli.evaluate.benchmark import own_methods
from evetac_cli.evaluate.cost import EvaluateCost
from evetac_cli.evaluate.cost import command as cost
from evetac_cli.evaluate.slip import EvaluateSlip
from evetac_cli.evaluate.slip import measure as slip
from evetac_cli.resources import MODEL, SHIPPED, model_file, with_shipped
from evetac_cli.stages import train
from evetac_cli.trials.grasp.settings import GraspSettings
from tests.conftest import Made

COMMANDS = every() | {f"evaluate {command.name}": command for command in SUBJECTS}
# Parameters that name a slip detector's file; `train --model` names an architecture, and of forces there is no model.
TAKES_A_MODEL = [
    (name, item)
    for name, command in COMMANDS.items()
    for item in dataclasses.fields(command.params)
    if item.name in ("model", "adapt") and not item.metadata["choices"]
    if name not in ("predict-touch", "evaluate force")
]


@pytest.mark.parametrize(("command", "item"), TAKES_A_MODEL, ids=lambda value: getattr(value, "name", value))
def test_help_names_it_wherever_a_model_is_taken(command: str, item: "dataclasses.Field[Any]") -> None:
    """Assert that each flag for a model says that there is one in the package."""
    assert f"`{SHIPPED}`" in item.metadata["help"], command


def test_stages_take_the_packages_model(made: Made, tmp_path: Path) -> None:
    """Assert that every stage that takes a model finds the package's by this word."""
    features = [made.beside(path, "features") for path in made.recordings]
    named = Path(SHIPPED)
    assert slip.jobs(features, EvaluateSlip(model=named), tmp_path)[0].inputs[-1] == MODEL
    assert slip.jobs([*features, named], EvaluateSlip(), tmp_path)[0].inputs[-1] == MODEL
    both = slip.jobs([*features, named], EvaluateSlip(model=made.model), tmp_path)[0]
    assert set(both.inputs[-both.models :]) == {MODEL, made.model}
    assert train.jobs(features, Train(adapt=SHIPPED), tmp_path)[0].output.name.endswith("10ms.model.h5")
    for params in (Grasp(model=named), Grasp()):
        assert (detector := GraspSettings.of(params).detector) is not None
        assert detector.path == MODEL
    assert cost.jobs([], EvaluateCost(part="grasp", model=named), tmp_path)[0].inputs == (MODEL,)
    of_benchmark = own_methods.methods_of("stable", model_file(named), None, "none", None)
    assert of_benchmark.slip is not None and of_benchmark.slip.path == MODEL


@pytest.mark.slow
def test_the_packages_detector_on_recordings_of_ones_own(made: Made, tmp_path: Path) -> None:
    """Assert that `evaluate slip FILES --model shipped` judges trials of one's own, as its own file does by path."""
    features, recordings = str(tmp_path / "features"), map(str, made.recordings[:2])
    run = CliRunner().invoke(app, ["featurize", *recordings, "--sticking-share", "-o", features])
    assert run.exit_code == 0, run.stderr
    answers = []
    for number, model in enumerate((SHIPPED, str(MODEL))):
        out = str(tmp_path / f"{number}.report.h5")
        run = CliRunner().invoke(app, ["evaluate", "slip", features, "--model", model, "-o", out, "--json"])
        assert run.exit_code == 0, run.stderr
        answers.append(json.loads(run.stdout)["rows"])
    assert answers[0] == answers[1]


def test_from_python(made: Made) -> None:
    """Assert that the detector, its model file and the Gymnasium environment take the word."""
    gymnasium = pytest.importorskip("gymnasium")
    import evetac_cli.gym  # noqa: F401  registers the environment

    with evetac.open_recording(made.recordings[0]) as recording:
        named, default = (evetac.SlipDetector(recording, *model) for model in ((SHIPPED,), ()))
        for events, _ in zip(recording, range(60), strict=False):
            assert np.array_equal(named.step(events), default.step(events), equal_nan=True)
    with evetac.open_model(SHIPPED) as model:
        assert model.path == MODEL
    assert gymnasium.make("evetac/Lift-v0", model=SHIPPED).unwrapped._model == MODEL
    assert "shipped" in str(inspect.getdoc(evetac.SlipDetector))


@pytest.mark.parametrize("typo", ["shiped"])
def test_a_typo_says_what_was_meant(typo: str, made: Made, tmp_path: Path) -> None:
    """Assert that a name that is near to the word is refused with it, and exit code 2."""
    with pytest.raises(InputError, match="did you mean shipped"):
        model_file(typo)
    features = str(made.beside(made.recordings[0], "features"))
    run = CliRunner().invoke(app, ["evaluate", "slip", features, "--model", typo, "-o", str(tmp_path / "a.report.h5")])
    assert run.exit_code == 2
    assert "did you mean shipped" in run.stderr


def test_files_that_are_called_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a folder of this name among the files is that folder, and that other names are left alone."""
    monkeypatch.chdir(tmp_path)
    assert with_shipped([Path("a.h5"), Path("b.h5")]) == [Path("a.h5"), Path("b.h5")]
    assert with_shipped([Path(SHIPPED), Path("a.h5")]) == [Path("a.h5"), MODEL]
    (tmp_path / SHIPPED).mkdir()
    assert with_shipped([Path(SHIPPED), Path("a.h5")]) == [Path(SHIPPED), Path("a.h5")]
    assert model_file("other.model.h5") == Path("other.model.h5")  # what is missing is said by who opens it
