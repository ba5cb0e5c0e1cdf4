"""A benchmark's folder, made by the functions of scripts/benchmark/files.py from the recordings of the session."""

from pathlib import Path
from typing import Any

import pytest

from evetac_cli.evaluate.benchmark import data_set
from evetac_cli.evaluate.benchmark.data_set import Benchmark, Truth
from evetac_cli.sim.setup import object_file, scene_file
from evetac_cli.text_files import as_toml
from scripts.benchmark import files, trials
from tests.conftest import Made

KINDS = ("slip", "slip", "press", "handling")


@pytest.fixture(scope="session")
def bench_folder(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A benchmark of four short recordings of slips; the last is cut before its slip."""
    from evetac_cli.commands.trim import Trim
    from evetac_cli.stages import trim
    from evetac_cli.store.recordings.read import open_recording, true_onset

    said = trials.recipe() | {"dots_every_ms": 100, "force_every_ms": 100}
    folder = tmp_path_factory.mktemp("bench") / "bench"
    folder.mkdir()
    files.prepare(folder)
    paths = [*made.recordings, made.folder / "apart.recording.h5"]
    with open_recording(paths[-1]) as recording:
        onset = true_onset(recording)
    assert onset is not None
    cut = Trim(to_ms=onset - 50)
    (job,) = trim.jobs([paths[-1]], cut, tmp_path_factory.mktemp("cut"))
    trim.run(job, cut)
    rows: list[dict[str, Any]] = []
    for number, (path, kind) in enumerate(zip([*paths[:-1], job.output], KINDS, strict=True)):
        row = files.divide(said, path, folder, f"r{number}", f"sensor-{number % 2}", presses=kind == "press")
        more = {"kind": kind, "split": ("known-sensor", "all-new")[number % 2], "mm_per_px": 0.04}
        true = {"true_sensor": f"randomized:{105000 + number % 2}", "true_object": f"new-{number}", "seed": 105000}
        rows.append({**row, **more, **true, "motion": "slip"})
    lift = {"split": "all-new", "object": "paper-11", "sensor": "evetac", "seed": 0, "lift_s": 1.0, "balance_s": 0.2}
    texts = {"scene": scene_file.changed("lift", {}), "object": object_text(11)}
    for name, text in texts.items():
        (folder / "truth" / "lifts" / f"g0.{name}.toml").write_text(text)
    files.finish(folder, said, "test", rows, {"g0": lift})
    return folder


def object_text(number: int) -> str:
    """An object of the paper's table as an object file."""
    row = {key: value for key, value in vars(object_file.of_number(number)).items() if value is not None}
    return as_toml({"name": f"paper-{number}", **row})


@pytest.fixture(scope="session")
def bench(bench_folder: Path) -> Benchmark:
    """The same folder, read."""
    return data_set.read(bench_folder)


@pytest.fixture(scope="session")
def true(bench: Benchmark) -> dict[str, Truth]:
    """The truth of the folder."""
    return data_set.read_truth(bench)
