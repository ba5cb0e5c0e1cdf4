"""grasp: which detector it feels with. What it does with it is in the contract of stages and in evaluate grasp."""

import json
from pathlib import Path

import pytest

from evetac_cli.errors import InputError
from evetac_cli.inspect import validate
from evetac_cli.params import Grasp
from evetac_cli.resources import MODEL
from evetac_cli.stages import grasp
from evetac_cli.stages.train import ahead_of, detector_of
from evetac_cli.store.files import StageFile


def test_the_package_has_a_detector() -> None:
    """Assert that a grasp needs no --model: the package's is whole, runs, and its report is of this very file."""
    assert grasp.model_of(Grasp()) == MODEL
    assert [row["faults"] for row in validate.run([MODEL]).rows] == [None]
    made = json.loads(MODEL.with_name("fast-slow-10ms.json").read_text())
    with StageFile(MODEL, "model") as model:
        assert detector_of(model).architecture.name == made["model"] == "fast-slow"
        assert ahead_of(model) == made["ahead_ms"] == 10
        assert float(model.read("threshold")) == made["threshold"]
        assert model.header["id"] == made["id"]
    assert made["simulated"]
    assert made["unseen_objects"]["trajectories"] > 0


def test_no_detector_without_the_controller(tmp_path: Path) -> None:
    """Assert that a model is refused where none is used, and that none is taken then."""
    assert grasp.model_of(Grasp(controller="none")) is None
    with pytest.raises(InputError, match="no detector is used"):
        grasp.jobs([], Grasp(controller="none", model=tmp_path / "slip.model.h5"), tmp_path)
