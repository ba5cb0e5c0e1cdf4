"""The inputs of a benchmark hold no truth, evetac's commands read them, and so does a reader without evetac."""

import csv
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.evaluate.benchmark.data_set import Benchmark
from evetac_cli.store.layout import schema
from tests.conftest import Made
from tests.patience import PATIENCE_S

GROUPS = {"events", "sensor", "gripper", "control"}
DATASETS = {"ms_to_idx", "t_offset"}
PARAMETERS = {"benchmark", "benchmark_version", "recording"}
# Words that only a description of the trial has, in any text of a file.
WORDS = re.compile(
    r"truth|scene|object|mass|friction|seed\W+\d|randomized|modulus|contrast|outcome|tone|texture|onset", re.I
)
NOT_WORDS = ("DIMENSION", "_Netcdf", "CLASS", "NAME", "REFERENCE_LIST")


def texts(file: h5py.File) -> dict[str, str]:
    """Every text of a file by its place: attributes of all objects, text datasets, names of objects."""
    found = {f"attribute {name}": str(value) for name, value in file.attrs.items()}

    def look(name: str, item: Any) -> None:
        found[f"name {name}"] = name
        for key, value in item.attrs.items():
            if not key.startswith(NOT_WORDS) and key not in ("long_name", "units"):
                found[f"attribute {key} of {name}"] = str(value)
        if isinstance(item, h5py.Dataset) and item.dtype.kind == "O":
            found[f"text {name}"] = str(item.asstr()[()])

    file.visititems(look)
    return found


def truth_in(path: Path, arrays: dict[str, np.ndarray]) -> list[str]:
    """What of the truth there is in a file: groups, keys of its header, words, and datasets equal to those of truth."""
    found = []
    with h5py.File(path) as file:
        said = texts(file)
        header = json.loads(file.attrs["header"])
        found += [name for name in file if name not in GROUPS | DATASETS and isinstance(file[name], h5py.Group)]
        found += [f"parameter {name}" for name in header["parameters"] if name not in PARAMETERS]
        found += [name for name in ("seed", "parents", "history") if header[name]]
        found += [f"{place}: {text[:40]}" for place, text in said.items() if WORDS.search(_without_keys(place, text))]
        for name, values in arrays.items():
            file.visititems(
                lambda at, item, values=values, name=name: (
                    found.append(f"{at} is {name}")
                    if isinstance(item, h5py.Dataset)
                    and item.shape == values.shape
                    and np.array_equal(item[()], values)
                    else None
                )
            )
    return found


def _without_keys(place: str, text: str) -> str:
    """A text without what every recording has: the meaning of its kind, the header's own keys, versions."""
    if place != "attribute header":
        return text.replace(schema.load("recording").meaning, "")
    header = json.loads(text)
    return json.dumps([header["parameters"], header["history"], header.get("shared")])


@pytest.mark.parametrize("name", ["r0", "r1", "r2", "r3"])
def test_inputs_hold_no_truth(name: str, bench: Benchmark) -> None:
    """Assert that no group, key, word or dataset of an input is truth."""
    with h5py.File(bench.folder / "truth" / f"{name}.h5") as file:
        arrays = {key: item[()] for key, item in file.items() if item.shape and item.size > 2}
    arrays = {key: values for key, values in arrays.items() if len(np.unique(values)) > 1 and not key.endswith("_ms")}
    assert truth_in(bench.entries[name].path, arrays) == []


def test_the_search_finds_truth(made: Made) -> None:
    """Assert that the same search finds groups, parameters, words and datasets of truth in a simulated recording."""
    path = made.recordings[0]
    with h5py.File(path) as file:
        arrays = {"normal force": file["truth/normal_force_n"][()]}
    found = truth_in(path, arrays)
    assert {"truth", "parameter scene", "truth/normal_force_n is normal force"} <= set(found)
    assert any(line.startswith("attribute header") for line in found)


def test_names_say_nothing(bench: Benchmark) -> None:
    """Assert that public tables have no true sensor and no object."""
    for path in (bench.folder / "recordings.csv", bench.folder / "sensors.csv", *(bench.folder / "queries").iterdir()):
        assert not re.search(r"randomized|new-\d|95\d\d\d", path.read_text()), path


@pytest.mark.parametrize(
    "words",
    [
        "info {}",
        "validate {}",
        "track {} -o {}.tracks.h5",
        "export {} --format csv -o {}.csv",
        "export {} --format text -o {}.txt",
    ],
)
def test_commands_take_an_input(words: str, bench: Benchmark, tmp_path: Path) -> None:
    """Assert that evetac's commands accept an input as any recording."""
    pytest.importorskip("pyarrow")
    recording, *_ = (entry.path for entry in bench.entries.values())
    given = words.replace("{}", str(recording), 1).replace("{}", str(tmp_path / "made"))
    run = CliRunner().invoke(app, given.split())
    assert run.exit_code == 0, run.output


def test_the_reader_needs_no_evetac(bench: Benchmark) -> None:
    """Assert that reader.py, at most twenty lines of code, lists the recordings with h5py and numpy alone."""
    reader = bench.folder / "reader.py"
    assert len([line for line in reader.read_text().splitlines() if line.strip()]) <= 20
    code = f"import sys; sys.modules['evetac_cli'] = None; sys.argv = ['reader.py', {str(bench.folder)!r}]; "
    code += f"exec(compile(open({str(reader)!r}).read(), 'reader.py', 'exec'), {{'__name__': '__main__'}})"
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    lines = done.stdout.splitlines()
    assert [line.split()[0] for line in lines] == list(bench.entries)
    assert all(int(line.split()[4]) > 0 for line in lines)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of rdflib, which mlcroissant uses
def test_croissant_is_valid(bench: Benchmark) -> None:
    """Assert that mlcroissant accepts the metadata and reads the recordings' table by it."""
    mlcroissant = pytest.importorskip("mlcroissant")
    data = mlcroissant.Dataset(jsonld=str(bench.folder / "croissant.json"))
    assert not data.metadata.ctx.issues.errors
    rows = [{key: value.decode() for key, value in row.items()} for row in data.records("recordings")]
    with (bench.folder / "recordings.csv").open() as file:
        known = list(csv.DictReader(file))
    assert [row["recordings/recording"] for row in rows] == [row["recording"] for row in known]
