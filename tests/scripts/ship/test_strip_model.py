"""scripts/ship/strip_model.py: a stripped model is the same detector, and an archive gives back what was packed."""

import shutil
from pathlib import Path

import h5py
import numpy as np

from evetac_cli.commands.grasp import Grasp
from evetac_cli.evaluate.slip import EvaluateSlip
from evetac_cli.evaluate.slip import measure as slip
from evetac_cli.evaluate.slip.models import Model, check, predict_all
from evetac_cli.jobs import silent
from evetac_cli.store.files import StageFile
from evetac_cli.trials import grasp
from scripts.ship import strip_model
from tests.conftest import Made
from tests.make import run_stage


def test_a_stripped_model_is_the_same_detector(made: Made, tmp_path: Path) -> None:
    """Assert equal ids, digests, probabilities bit for bit and reports, without the graphs of other checkpoints."""
    stripped = tmp_path / "stripped.model.h5"
    strip_model.strip(made.model, stripped)
    with StageFile(made.model) as whole, StageFile(stripped, "model") as small:
        assert small.header == whole.header
        assert set(whole.contents()) - set(small.contents()) == {"checkpoint/onnx"}
        small.check()
    assert strip_model.digest(stripped) == strip_model.digest(made.model)
    assert stripped.stat().st_size < made.model.stat().st_size
    features = [made.beside(made.folder / "apart.recording.h5", "features")]
    models = [Model.read(path) for path in (made.model, stripped)]
    (whole_said,), (small_said,) = predict_all(models, features, check(models, features), silent)
    assert np.isfinite(whole_said.probability).any()
    np.testing.assert_array_equal(small_said.probability, whole_said.probability)
    rows = []
    for path in (made.model, stripped):
        _, outcome = run_stage(slip, features, EvaluateSlip(model=path), tmp_path / f"{path.stem}.report.h5")
        rows.append([{k: v for k, v in row.items() if k not in ("file", "model_file")} for row in outcome.rows])
    assert rows[0] == rows[1]


def test_a_grasp_with_a_stripped_model_is_the_same(made: Made, tmp_path: Path) -> None:
    """Assert that a grasp decides the same, slice by slice, with a model and with its stripped copy."""
    stripped = tmp_path / made.model.name
    strip_model.strip(made.model, stripped)
    decided = []
    for name, path in (("whole", made.model), ("small", stripped)):
        params = Grasp(model=path, lift_s=0.1, balance_s=0.0)
        (job,) = grasp.jobs([], params, tmp_path / f"{name}.recording.h5")
        grasp.run(job, params)
        with StageFile(job.output, "recording") as file:
            decided.append({key: file.read(key) for key in file.contents() if key.startswith("control/")})
    assert decided[0].keys() == decided[1].keys() and decided[0]
    for key, values in decided[0].items():
        np.testing.assert_array_equal(values, decided[1][key], err_msg=key)


def test_an_archive_gives_back_what_was_packed(made: Made, tmp_path: Path) -> None:
    """Assert equal digests after packing, equal bytes of two archives, and that models that are there stay."""
    folder = tmp_path / "models"
    folder.mkdir()
    for name in ("a.model.h5", "b.model.h5"):
        shutil.copyfile(made.model, folder / name)
    shutil.copyfile(made.force_model, folder / "c.force-model.h5")
    archives = [tmp_path / name for name in ("1.tar.xz", "2.tar.xz")]
    for archive in archives:
        strip_model.pack(strip_model.models_in(folder), archive)
    assert archives[0].read_bytes() == archives[1].read_bytes()
    slip_models = strip_model.models_in(folder)[:2]
    for number in (1, 2):
        strip_model.pack(slip_models[:number], tmp_path / f"{number}-slip.tar.xz")
    one, two = ((tmp_path / f"{number}-slip.tar.xz").stat().st_size for number in (1, 2))
    assert two < 1.2 * one  # what models share is stored once
    assert strip_model.names_in(tmp_path) >= {"1/a", "1/b", "1/c", "2-slip/b"}
    strip_model.unpack_all(tmp_path)
    assert strip_model.digest(tmp_path / "1" / "b.model.h5") == strip_model.digest(made.model)
    out = tmp_path / "out"
    out.mkdir()
    (out / "a.model.h5").write_bytes(b"mine")
    paths = strip_model.unpack(archives[0], out)
    assert [path.name for path in paths] == ["a.model.h5", "b.model.h5", "c.force-model.h5"]
    assert paths[0].read_bytes() == b"mine"
    assert [strip_model.digest(path) for path in paths[1:]] == [
        strip_model.digest(path) for path in (made.model, made.force_model)
    ]


def test_a_digest_tells_weights_apart(made: Made, tmp_path: Path) -> None:
    """Assert that a model with another weight has another digest."""
    other = tmp_path / "other.model.h5"
    shutil.copyfile(made.model, other)
    with h5py.File(other, "r+") as file:
        name = next(iter(file["weights"]))
        file["weights"][name][...] += np.float32(1e-3)
    assert strip_model.digest(other) != strip_model.digest(made.model)
