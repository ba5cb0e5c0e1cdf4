"""Parameters: their priority, and every way in which a flag or a config file can be wrong."""

import dataclasses
import math
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

from evetac_cli.cli.config import resolve, with_config
from evetac_cli.commands import pipeline
from evetac_cli.commands.doctor import DoctorHardware
from evetac_cli.commands.label import Label
from evetac_cli.commands.parameter import flag_of, recipe_of
from evetac_cli.commands.record import Record
from evetac_cli.commands.track import Track
from evetac_cli.commands.train import Train
from evetac_cli.errors import InputError
from evetac_cli.evaluate import SUBJECTS
from evetac_cli.evaluate.labels import EvaluateLabels
from evetac_cli.evaluate.slip import EvaluateSlip

EVERY = {command.name: command.params for command in pipeline()}
EVERY |= {f"evaluate {command.name}": command.params for command in SUBJECTS}
ALL_FIELDS = [(command, item) for command, cls in EVERY.items() for item in dataclasses.fields(cls)]
ENDS = [(command, item, end) for command, item in ALL_FIELDS for end in ("low", "high")]
RANGED = [(command, item, end) for command, item, end in ENDS if item.metadata[end] is not None]


def config(folder: Path, text: str) -> Path:
    """A config file."""
    path = folder / "evetac.toml"
    path.write_text(text)
    return path


def refusal(cls: type, command: str, given: dict[str, Any], path: Path | None = None) -> str:
    """What is said of wrong parameters; exit code 2."""
    with pytest.raises(InputError) as refused:
        resolve(cls, command, given, path)
    assert refused.value.exit_code == 2
    return str(refused.value)


@pytest.mark.parametrize("command", EVERY)
def test_defaults_are_valid(command: str) -> None:
    """Assert that what a command does without flags is within its own ranges."""
    cls = EVERY[command]
    assert resolve(cls, command, {}, None) == cls()
    assert resolve(cls, command, {item.name: None for item in dataclasses.fields(cls)}, None) == cls()


def test_every_command_has_a_table() -> None:
    """Assert that a config file can have a table for each command, and for no other."""
    assert set(EVERY) == set(with_config())


def test_flag_beats_config_beats_default(tmp_path: Path) -> None:
    """Assert the priority of flag, config file and default, for each parameter by itself."""
    path = config(tmp_path, '[track]\npreset = "paper"\nstep_size = 0.25\n[label]\nconfirm_ms = 9\n')
    assert resolve(Track, "track", {}, path) == Track(preset="paper", step_size=0.25)
    assert resolve(Track, "track", {"step_size": 0.5}, path) == Track(preset="paper", step_size=0.5)
    assert resolve(Track, "track", {"preset": "stable", "step_size": None}, path) == Track(step_size=0.25)
    assert resolve(Label, "label", {}, path).confirm_ms == 9
    assert resolve(Train, "train", {}, path) == Train()


def test_types_of_toml(tmp_path: Path) -> None:
    """Assert that text becomes a path, and a whole number a float, where that is wanted, and nothing else changes."""
    path = config(tmp_path, '[track]\nstep_size = 1\ncalibration = "grid.json"\n[record]\nsort = true\nstream = "0"\n')
    chosen = resolve(Track, "track", {}, path)
    assert chosen.calibration == Path("grid.json")
    assert type(chosen.step_size) is float
    assert resolve(Record, "record", {}, path) == Record(sort=True, stream="0")


def test_a_key_is_the_name_of_a_flag(tmp_path: Path) -> None:
    """Assert that a key is what its flag is called, with - or _, and not the name of the parameter in the code."""
    text = '[record]\nobject = "9"\ntolerance = 0.5\ntone = "200"\nfrom = "a.raw"\nhold-s = 2\nclosing_ma = 9\n'
    chosen = Record(objects="9", tolerance_um=0.5, tones="200", source=Path("a.raw"), hold_s=2.0, closing_ma=9)
    assert resolve(Record, "record", {}, config(tmp_path, text)) == chosen
    message = refusal(Record, "record", {}, config(tmp_path, '[record]\nobjects = "9"\n'))
    assert "expected: scene, object, count" in message and "did you mean object?" in message
    assert "set twice" in refusal(Record, "record", {}, config(tmp_path, "[record]\nhold-s = 2\nhold_s = 3\n"))


def test_nested_table(tmp_path: Path) -> None:
    """Assert that `evaluate slip` reads [evaluate.slip], and `slip` or `evaluate` alone mean nothing else."""
    path = config(tmp_path, "[evaluate.slip]\nthreshold = 0.25\n[evaluate.labels]\n")
    assert resolve(EvaluateSlip, "evaluate slip", {}, path).threshold == 0.25
    assert resolve(EvaluateLabels, "evaluate labels", {}, path) == EvaluateLabels()


@pytest.mark.parametrize(
    ("text", "key", "near"),
    [
        ("[label]\nthreshold = 0.5\n", "unknown key `threshold`", "threshold_px"),
        ("[label]\nxyzzy = 1\n", "unknown key `xyzzy`", ""),
        ("[label.deeper]\nconfirm_ms = 1\n", "unknown key `deeper`", ""),
        ("[labels]\nconfirm_ms = 1\n", "unknown table `labels`", "label"),
        ("[trak]\n", "unknown table `trak`", "track"),
    ],
)
def test_unknown_names(tmp_path: Path, text: str, key: str, near: str) -> None:
    """Assert that a key or table that does not exist is refused, with what there is and the nearest name, if any."""
    message = refusal(Label, "label", {}, config(tmp_path, text))
    assert message.startswith(str(tmp_path / "evetac.toml"))
    assert key in message
    assert "expected: " in message
    assert (f"did you mean {near}?" in message) if near else ("try:" not in message)


CONSENTS = [(command, item.name) for command, item in ALL_FIELDS if item.metadata["consent"]]
STORED = ["true", "false", '"yes"', "1"]


@pytest.mark.parametrize("value", STORED)
@pytest.mark.parametrize(("command", "name"), CONSENTS)
def test_consent_is_not_taken_from_a_file(tmp_path: Path, command: str, name: str, value: str) -> None:
    """Assert that no config file moves a gripper, whatever it says of it, also where the flag is given as well."""
    path = config(tmp_path, f"[{command}]\nseed = 3\n{name} = {value}\n")
    for given in ({}, {name: True}, {name: False}):
        message = refusal(EVERY[command], command, given, path)
        assert f"{path}: {command}.{name}" in message
        assert f"expected: {flag_of_name(command, name)} on the command line, each time" in message


def flag_of_name(command: str, name: str) -> str:
    return next(flag_of(item) for each, item in ALL_FIELDS if (each, item.name) == (command, name))


def test_who_asks_for_consent() -> None:
    """Assert that the flags that let a gripper move, or leave out a question, are those marked as consent."""
    assert CONSENTS == [("record", "arm"), ("grasp", "arm")]
    assert [item.name for item in dataclasses.fields(DoctorHardware) if item.metadata["consent"]] == ["arm", "yes"]
    for command, name in CONSENTS:
        assert name not in recipe_of(EVERY[command]())


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("confirm_ms", "5.0", "int"),
        ("confirm_ms", "true", "int"),
        ("confirm_ms", '"5"', "int"),
        ("threshold_px", '"0.5"', "float"),
        ("threshold_px", "false", "float"),
    ],
)
def test_wrong_types(tmp_path: Path, key: str, value: str, expected: str) -> None:
    """Assert that a value of another type is refused with its place and both types: no truth value is a number."""
    message = refusal(Label, "label", {}, config(tmp_path, f"[label]\n{key} = {value}\n"))
    assert f"label.{key}: wrong type" in message
    assert f"expected: {expected}" in message


def test_both_ends_of_every_range() -> None:
    """Assert that the ends belong to the range and the next value does not; flag, end and unit are said."""
    for command, item, end in RANGED:
        cls, edge = EVERY[command], item.metadata[end]
        wanted = (get_args(get_type_hints(cls)[item.name]) or (get_type_hints(cls)[item.name],))[0]
        away = math.inf if end == "high" else -math.inf
        assert getattr(resolve(cls, command, {item.name: wanted(edge)}, None), item.name) == edge
        outside = math.nextafter(edge, away) if wanted is float else edge + int(math.copysign(1, away))
        message = refusal(cls, command, {item.name: outside})
        assert message.startswith(f"{flag_of(item)}: out of range")
        assert str(edge) in message
        assert item.metadata["unit"] in message
        assert f"found:    {outside}" in message


def test_fields_are_described() -> None:
    """Assert that every parameter has a sentence of help, a unit if its name ends in one, and a default it allows."""
    for _, item in ALL_FIELDS:
        about = item.metadata
        assert about["help"][0].isupper() or about["help"].split(":")[0] in about["choices"]
        assert about["help"].endswith(".")
        ending = item.name.rsplit("_", 1)[-1]
        if ending in ("px", "ms", "s", "ma"):
            rate = "1/" if item.name.endswith(f"_per_{ending}") else ""
            assert about["unit"] == rate + {"ma": "mA"}.get(ending, ending)
        if about["choices"] and item.default is not None:
            assert item.default in about["choices"]


@pytest.mark.parametrize("command", EVERY)
def test_flags_are_unique(command: str) -> None:
    """Assert that no two parameters of a command have one flag, and none has that of a running option."""
    flags = [flag_of(item) for item in dataclasses.fields(EVERY[command])]
    running = {"--out", "--force", "--jobs", "--config", "--json", "--quiet", "--verbose", "--help"}
    assert len(set(flags)) == len(flags)
    assert not running & set(flags)
    assert all((flag.startswith("--") and "_" not in flag) or flag.isupper() for flag in flags)
