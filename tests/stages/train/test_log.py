"""train --log tensorboard: what TensorBoard's own reader finds of a training."""

import math
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.commands.train import Train
from evetac_cli.errors import EvetacError
from evetac_cli.stages import train
from evetac_cli.stages.train.log import for_tensorboard
from evetac_cli.store.files import StageFile
from tests.conftest import Made
from tests.make import run_stage

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of tensorboard's own imports


def scalars(folder: Path) -> dict[str, list[Any]]:
    """Name -> points, as TensorBoard reads them."""
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    read = EventAccumulator(str(folder))
    read.Reload()
    return {tag: read.Scalars(tag) for tag in read.Tags()["scalars"]}


def test_points_are_written_as_they_come(tmp_path: Path) -> None:
    """Assert that losses can be read while the training goes on, under names that say simulated."""
    with for_tensorboard(tmp_path / "log", simulated=True) as point:
        assert point is not None
        point(10, 0.5, None)
        point(20, 0.25, 0.75)
        read = scalars(tmp_path / "log")
    assert [(one.step, one.value) for one in read["loss/training (simulated)"]] == [(10, 0.5), (20, 0.25)]
    assert [(one.step, one.value) for one in read["loss/validation (simulated)"]] == [(20, 0.75)]
    with for_tensorboard(None, simulated=True) as point:
        assert point is None


def test_a_training_is_logged(made: Made, tmp_path: Path) -> None:
    """Assert that the log has the model's loss curve and scores, and that the model is the same as without one."""
    features = [made.beside(path, "features") for path in made.recordings]
    chosen = Train(epochs=30, max_steps=120, preset="adam", validate=str(features[-1]), patience=100, log="tensorboard")
    output, _ = run_stage(train, features, chosen, tmp_path / "a.model.h5")
    log = tmp_path / "a.model.log"
    losses = scalars(log / "network1")
    with StageFile(output) as model, StageFile(made.model) as other:
        curve = losses["loss/training (simulated)"]
        assert [one.step for one in curve] == model.read("curve/step").tolist()
        stored = model.read("curve/loss").tolist()
        assert all(math.isclose(one.value, loss, rel_tol=1e-6) for one, loss in zip(curve, stored, strict=True))
        assert len(losses["loss/validation (simulated)"]) == len(curve)
        assert stored == other.read("curve/loss").tolist()
        scores = scalars(log)["score on validation trajectories (simulated)"]
        assert [one.step for one in scores] == model.read("checkpoint/step").tolist()
    assert (tmp_path / "a.model.csv").is_file()


def test_a_missing_tensorboard_is_named(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a training ends before it begins, with the extra that is missing, and leaves nothing."""
    monkeypatch.setitem(__import__("sys").modules, "torch.utils.tensorboard", None)
    features = [made.beside(path, "features") for path in made.recordings]
    chosen = Train(epochs=1, max_steps=2, log="tensorboard")
    (job,) = train.jobs(features, chosen, tmp_path / "a.model.h5")
    with pytest.raises(EvetacError, match="tensorboard is not installed") as refused:
        train.run(job, chosen)
    assert "[log]" in refused.value.hint
    assert list(tmp_path.iterdir()) == []
