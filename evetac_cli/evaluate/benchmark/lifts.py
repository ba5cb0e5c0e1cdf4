"""Closed-loop lifts of a benchmark: played by a law of evetac or of a plug-in, or read from anyone's recordings."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from evetac_cli.commands.grasp import Grasp
from evetac_cli.errors import InputError
from evetac_cli.evaluate import grasp as grasp_evaluation
from evetac_cli.evaluate.benchmark.data_set import MADE_BY, Benchmark
from evetac_cli.evaluate.benchmark.own_methods import made_or_kept
from evetac_cli.jobs import Progress, Row, Rows, silent
from evetac_cli.sim.setup import object_file, scene_file
from evetac_cli.sim.setup.tables import as_table
from evetac_cli.store.files import header_of
from evetac_cli.text_files import MOST_JSON_BYTES, parse_json, read_text
from evetac_cli.trials import grasp

FLAGS = ("sensor", "seed", "lift_s", "balance_s")


def read(benchmark: Benchmark) -> dict[str, Row]:
    """Return the lifts by name: split, object, and the flags of `evetac grasp`."""
    path = benchmark.folder / "truth" / "lifts.json"
    if not path.exists():
        raise InputError("the lifts are missing", where=str(path), hint=MADE_BY)
    try:
        found = parse_json(read_text(path, MOST_JSON_BYTES))
    except ValueError as error:
        raise InputError(f"not valid JSON: {error}", where=str(path)) from None
    wanted = {"split", "object", *FLAGS}
    if not isinstance(found, dict) or any(not isinstance(row, dict) or set(row) != wanted for row in found.values()):
        raise InputError("not the lifts of a benchmark", where=str(path), expected=", ".join(sorted(wanted)))
    return found


def asked(benchmark: Benchmark, name: str, lift: Row, **chosen: Any) -> Grasp:
    """Return the flags of `evetac grasp` that play a lift; chosen: controller, model and others."""
    folder = benchmark.folder / "truth" / "lifts"
    flags = {flag: lift[flag] for flag in FLAGS}
    scene, touched = (str(folder / f"{name}.{what}.toml") for what in ("scene", "object"))
    return Grasp(scene=scene, objects=touched, **flags, **chosen)


def play(
    benchmark: Benchmark, lifts: Mapping[str, Row], chosen: Mapping[str, Any], folder: Path, progress: Progress = silent
) -> Rows:
    """Play every lift with the chosen controller and detector, and return the outcomes.

    folder: of the recordings; those that exist are not made again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for number, (name, lift) in enumerate(lifts.items()):
        params = asked(benchmark, name, lift, **chosen)
        (job,) = grasp.jobs([], params, folder / f"{name}.recording.h5")
        made_or_kept(grasp.run, job, params)
        progress(number + 1, len(lifts), "lifts")
    return outcomes(benchmark, lifts, folder)


def outcomes(benchmark: Benchmark, lifts: Mapping[str, Row], folder: Path) -> Rows:
    """Return the outcome of each lift from its recording NAME.recording.h5 in a folder.

    InputError if one is missing, or is another grasp: of another scene, object, sensor, seed or duration.
    """
    rows = []
    for name, lift in lifts.items():
        path = folder / f"{name}.recording.h5"
        if not path.exists():
            raise InputError(
                "a lift is missing", where=str(path), expected=f"{len(lifts)} recordings, {name} among them"
            )
        header = header_of(path, "recording")
        _require_same(benchmark, name, lift, header, path)
        outcome = grasp_evaluation.trial_row(path, header)
        rows.append({**outcome, "name": name, **{key: lift[key] for key in ("split", "object", "sensor")}})
    return rows


def _require_same(benchmark: Benchmark, name: str, lift: Row, header: Mapping[str, Any], path: Path) -> None:
    folder = benchmark.folder / "truth" / "lifts"
    _, touched = object_file.read(folder / f"{name}.object.toml")
    parameters = header["parameters"]
    wanted = {
        "scene": as_table(scene_file.load(str(folder / f"{name}.scene.toml"))),
        "object_row": as_table(touched),
        **{flag: lift[flag] for flag in FLAGS if flag != "seed"},
    }
    found = {key: parameters.get(key) for key in wanted} | {"seed": header["seed"]}
    for key, value in (wanted | {"seed": lift["seed"]}).items():
        if _plain(found[key]) != _plain(value):
            raise InputError(
                f"another lift: {key} differs",
                where=str(path),
                expected=str(value)[:100],
                found=str(found[key])[:100],
                hint="docs/benchmark.md has the command for each lift",
            )


def _plain(value: Any) -> Any:
    """Return a value with tuples as lists, as JSON has them."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
