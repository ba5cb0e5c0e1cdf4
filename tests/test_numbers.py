"""Numbers from outside, in files and on the command line: finite, no 0 with a sign, no truth values, no overflow."""

import math
import typing
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from evetac_cli.cli.config import MOST, resolve, with_config
from evetac_cli.cli.main import app
from evetac_cli.commands import Command, every, pipeline
from evetac_cli.commands.parameter import flag_of
from evetac_cli.errors import InputError, SceneError
from evetac_cli.evaluate import SUBJECTS
from evetac_cli.resources import SCENES
from evetac_cli.sim.camera.gel_camera import dot_grid
from evetac_cli.sim.setup import scene_file, sensor_file
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.text_files import as_toml, parse_json, read_toml
from tests import small_files
from tests.quick import few

ALL = (*every().values(), *SUBJECTS)
NUMBERS = [
    pytest.param(command, item.name, id=f"{command.name} {flag_of(item)}")
    for command in ALL
    for item in fields(command.params)
    if {int, float} & {*typing.get_args(hint := typing.get_type_hints(command.params)[item.name]), hint}
]


def is_plain(value: Any) -> bool:
    """Whether a number, or all in a list or table, can be computed with: finite, and no -0.0."""
    if isinstance(value, dict):
        return all(map(is_plain, value.values()))
    if isinstance(value, list | tuple):
        return all(map(is_plain, value))
    return not isinstance(value, float) or (math.isfinite(value) and not (value == 0 and math.copysign(1, value) < 0))


@pytest.mark.parametrize(("command", "name"), NUMBERS)
def test_a_flag_is_a_plain_number_or_refused(command: Command, name: str) -> None:
    """Assert that no number reaches a stage that overflows, is none, or has a sign that a 0 should not have."""
    for value in (-0.0, math.nan, -math.inf, 1e308, 10**400):
        try:
            params = resolve(command.params, command.name, {name: value}, None)
        except InputError as error:
            assert error.where.startswith(("--", flag_of(next(f for f in fields(command.params) if f.name == name))))
            assert len(error.found) < 100
        else:
            given = getattr(params, name)
            assert is_plain(given) and abs(given) <= max(MOST, 2**64)


@pytest.mark.parametrize("text", ["-0.0", "nan", "1e400", "true", "9223372036854775808"])
@pytest.mark.parametrize("command", [one for one in pipeline() if one.name in with_config()], ids=lambda one: one.name)
def test_a_config_file_has_plain_numbers(command: Command, text: str, tmp_path: Path) -> None:
    """Assert the same of each number that a config file sets; a truth value is no number."""
    hints = typing.get_type_hints(command.params)
    for item in fields(command.params):
        wanted = {*typing.get_args(hints[item.name]), hints[item.name]}
        if not {int, float} & wanted:
            continue
        path = tmp_path / "c.toml"
        path.write_text(f"[{command.name}]\n{item.name} = {text}\n")
        try:
            params = resolve(command.params, command.name, {}, path)
        except InputError:
            continue
        value = getattr(params, item.name)
        assert type(value) in (int, float) and is_plain(value)


UNBOUNDED = (
    "trim a.recording.h5 --from-ms {n} -o out",
    "label a.recording.h5 --method event-count --after-ms {n} -o out",
    "label a.recording.h5 --after-ms {n} -o out",
    "track a.recording.h5 --step-size {n} -o out",
    "evaluate data-rate a.recording.h5 --around-s {n} -o out",
    "view a.recording.h5 --start-s {n} -o out",
    "attach a.recording.h5 --stream pose=pose.csv --offset pose={n} -o out",
    "record --scene vibration --tone {n} --dry-run",
    "record --from events.txt --frame-size {n}x480 -o out",
    "record --camera virtual:prepared={n} --seconds 0.01 --dry-run",
    "label a.recording.h5 --jobs {n} -o out",
)


@pytest.mark.parametrize(
    "number",
    few(
        ["-0.0", "0", "1e12", "1000000000000", "1e308", "nan", "inf", "9" * 400, "1_0", "true"], "-0.0", "1e308", "nan"
    ),
)
@pytest.mark.parametrize("command", UNBOUNDED)
def test_what_a_flag_may_be_can_be_computed_with(
    command: str, number: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that the largest numbers which flags without limits take, and texts that hold numbers, end in words."""
    monkeypatch.chdir(tmp_path)
    small_files.recording(tmp_path / "a.recording.h5")
    (tmp_path / "pose.csv").write_text("t_ms,x_m\n1,2\n3,4\n")
    (tmp_path / "events.txt").write_text("1 2 3 1\n")
    result = CliRunner().invoke(app, command.format(n=number).split())
    assert result.exit_code in (0, 1, 2), result.output
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception


def of_scene(tmp_path: Path, text: str) -> Scene:
    (tmp_path / "own.toml").write_text(text)
    return scene_file.load(str(tmp_path / "own.toml"))


@pytest.mark.parametrize("value", ["-0.0", "-0e0", "-0.0e-5"])
def test_no_zero_of_a_scene_or_sensor_has_a_sign(value: str, tmp_path: Path) -> None:
    """Assert that 0 is 0, wherever it stands: in a scene, in a sensor, and what is made from it."""
    table = read_toml(SCENES / "slip.toml")
    numbers = [(group, key) for group, row in table.items() if isinstance(row, dict) for key, v in row.items()
               if isinstance(v, float)]  # fmt: skip
    assert len(numbers) > 5
    for group, key in numbers:
        changed = {**table, group: {**table[group], key: 12345.0}}
        try:
            assert is_plain(asdict(of_scene(tmp_path, as_toml(changed).replace("12345.0", value))))
        except SceneError:
            continue  # 0 is too small for it
    kept = 0
    for key in [key for key, entry in asdict(one_sensor("evetac")).items() if isinstance(entry, float)]:
        (tmp_path / "own.sensor.toml").write_text(f'like = "evetac"\n{key} = {value}\n')
        try:
            _, own = sensor_file.read(tmp_path / "own.sensor.toml", one_sensor)
        except InputError:
            continue
        kept += 1
        assert is_plain(asdict(own))
        dot_grid(own, cut=False)
    assert kept > 3


def test_plain_numbers_of_toml_and_json(tmp_path: Path) -> None:
    """Assert what the two parsers make of odd numbers, at any depth."""
    (tmp_path / "a.toml").write_text("a = -0.0\nb = [[-0.0, 0.0]]\n[c]\nd = {e = -0.0, f = -1.5}\n")
    table = read_toml(tmp_path / "a.toml")
    assert is_plain(table) and table["c"]["d"]["f"] == -1.5
    for text in ("1e400", "-1e400", "1" + "0" * 400 + ".0", "1e0400"):
        with pytest.raises(ValueError, match="too large a number"):
            parse_json(f'{{"a": [{text}]}}')
    assert parse_json('{"e400": "1e400", "b": 1e300, "c": -1.5e-400}') == {"e400": "1e400", "b": 1e300, "c": 0.0}
