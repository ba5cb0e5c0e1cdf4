"""evetac evaluate benchmark: own methods, tables made without evetac, equal numbers, and refusals."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.evaluate.benchmark.data_set import Benchmark
from evetac_cli.store.files import header_of
from tests.conftest import Made
from tests.patience import PATIENCE_S

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "benchmark_counts.py"


def scored(*words: str | Path) -> dict[str, Any]:
    """What the command prints as JSON."""
    run = CliRunner().invoke(app, ["evaluate", "benchmark", *map(str, words), "--json"])
    assert run.exit_code == 0, run.output
    return dict(json.loads(run.stdout))


def test_own_methods(bench: Benchmark, made: Made, tmp_path: Path) -> None:
    """Assert figures of all tasks, equal from the tables that the run wrote, and a report that says simulated."""
    first = scored(bench.folder, "--model", made.model, "-o", tmp_path / "first.report.h5")
    assert {row["task"] for row in first["rows"]} == {"onset", "warning", "force", "dots"}
    assert first["simulated"]
    header = header_of(tmp_path / "first.report.h5", "report")
    assert header["simulated"] and header["method"] >= 1
    tables = tmp_path / "first.files" / "predictions"
    assert scored(bench.folder, "--predictions", tables, "-o", tmp_path / "third.report.h5")["rows"] == first["rows"]
    alone = scored(bench.folder, "--predictions", tables / "dots.csv", "-o", tmp_path / "dots.report.h5")
    assert alone["rows"] == [row for row in first["rows"] if row["task"] == "dots"]
    assert alone["summary"]["onset"] is None


def test_a_table_made_without_evetac(bench: Benchmark, tmp_path: Path) -> None:
    """Assert that the example, which cannot import evetac, writes tables that are scored."""
    code = "import sys, runpy; sys.modules['evetac_cli'] = None; sys.argv = sys.argv[1:]; "
    code += f"runpy.run_path({str(EXAMPLE)!r}, run_name='__main__')"
    words = ["example", str(bench.folder), "--out", str(tmp_path / "mine")]
    subprocess.run([sys.executable, "-P", "-c", code, *words], check=True, timeout=PATIENCE_S)
    found = scored(bench.folder, "--predictions", tmp_path / "mine", "-o", tmp_path / "a.report.h5")
    force = [row for row in found["rows"] if row["task"] == "force" and row["split"] == "all"]
    assert force[0]["value"] == pytest.approx(force[0]["true_force_n"])  # it predicts none


def test_a_controller_plays_the_lifts(bench: Benchmark, tmp_path: Path) -> None:
    """Assert that a law plays every lift in closed loop."""
    words = ["--model", "none", "--shear-force", "none", "--controller", "fixed:10", "-o", tmp_path / "a.report.h5"]
    (grip, _) = (row for row in scored(bench.folder, *words)["rows"] if row["task"] == "grip")
    assert grip["n"] == 1 and grip["kept_low"] <= grip["kept"] <= grip["kept_high"]
    assert (tmp_path / "a.files" / "lifts" / "g0.recording.h5").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["{}", "--predictions", "{}", "--tracker", "paper"], "--tracker"),
        (["{}", "--shear-force", "network"], "--force-model"),
        (["{}", "--controller", "unknown"], "--controller"),
        (["{}/inputs"], "benchmark.json"),
        (["{}/recordings.csv"], "one folder"),
        (["{}", "--predictions", "{}/inputs"], "onset.csv"),
    ],
)
def test_refusals(words: list[str], said: str, bench: Benchmark, tmp_path: Path) -> None:
    """Assert that contradictions and folders that are no benchmark are refused, and nothing is written."""
    given = [word.replace("{}", str(bench.folder)) for word in words]
    run = CliRunner().invoke(app, ["evaluate", "benchmark", *given, "-o", str(tmp_path / "a.report.h5")])
    assert run.exit_code == 2
    assert said in run.output
    assert list(tmp_path.iterdir()) == []
