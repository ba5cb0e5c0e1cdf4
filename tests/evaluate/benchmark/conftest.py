"""A benchmark's folder, made by the functions of scripts/benchmark_files.py from the recordings of the session."""

import sys
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.evaluate.benchmark import data_set, truth
from evetac_cli.evaluate.benchmark.data_set import Benchmark
from evetac_cli.evaluate.benchmark.truth import Truth
from tests.conftest import Made

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "scripts"))
import benchmark_files
import benchmark_trials

KINDS = ("slip", "slip", "press", "handling")


@pytest.fixture(scope="session")
def bench_folder(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A benchmark of four short recordings of slips; the last is cut before its slip."""
    from evetac_cli.commands.trim import Trim
    from evetac_cli.stages import trim
    from evetac_cli.store.recordings.read import open_recording, true_onset

    said = benchmark_trials.recipe() | {"dots_every_ms": 100, "force_every_ms": 100}
    folder = tmp_path_factory.mktemp("bench") / "bench"
    folder.mkdir()
    benchmark_files.prepare(folder)
    paths = [*made.recordings, made.folder / "apart.recording.h5"]
    with open_recording(paths[-1]) as recording:
        onset = true_onset(recording)
    assert onset is not None
    cut = Trim(to_ms=onset - 50)
    (job,) = trim.jobs([paths[-1]], cut, tmp_path_factory.mktemp("cut"))
    trim.run(job, cut)
    rows: list[dict[str, Any]] = []
    for number, (path, kind) in enumerate(zip([*paths[:-1], job.output], KINDS, strict=True)):
        row = benchmark_files.divide(said, path, folder, f"r{number}", f"sensor-{number % 2}", presses=kind == "press")
        more = {"kind": kind, "split": ("known-sensor", "all-new")[number % 2], "mm_per_px": 0.04}
        true = {"true_sensor": f"randomized:{95000 + number % 2}", "true_object": f"new-{number}", "seed": 95000}
        rows.append({**row, **more, **true, "motion": "slip"})
    benchmark_files.finish(folder, said, "test", rows, {})
    return folder


@pytest.fixture(scope="session")
def bench(bench_folder: Path) -> Benchmark:
    """The same folder, read."""
    return data_set.read(bench_folder)


@pytest.fixture(scope="session")
def true(bench: Benchmark) -> dict[str, Truth]:
    """The truth of the folder."""
    return truth.read(bench)
