"""Parameters of a command from its flags, from `--config FILE.toml` and from defaults, in this order, all checked.

A config file may be old or somebody else's. So a flag that permits an action which a person must want now (`consent`
of a parameter, for example --arm) can only be given on the command line. A file that sets it is refused, with any
value.
"""

import dataclasses
import sys
import typing
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from evetac_cli import plugins
from evetac_cli.commands import pipeline
from evetac_cli.commands.parameter import Command, flag_of, key_of
from evetac_cli.errors import InputError, did_you_mean
from evetac_cli.text_files import plain_number, read_toml

MOST = 10**12  # limit of a number whose parameter has none: 11 days in us; sums of such numbers do not overflow


def resolve(cls: type, command: str, flag_values: Mapping[str, Any], config: Path | None) -> Any:
    """Return the parameters of a command from the given flags, a config file and defaults; all are checked."""
    table = _read_config(config, cls, command) if config else {}
    values = {**table, **{name: value for name, value in flag_values.items() if value is not None}}
    plain = {name: plain_number(value) if isinstance(value, float) else value for name, value in values.items()}
    params = cls(**plain)
    for item in fields(cls):
        _check(item, getattr(params, item.name))
    return params


def with_config() -> dict[str, Command]:
    """Return the commands that have a table in a config file, such as [track] or [evaluate.slip], by name."""
    from evetac_cli.evaluate import SUBJECTS  # here, as all subjects are imported for it

    return {command.name: command for command in pipeline()} | {f"evaluate {one.name}": one for one in SUBJECTS}


def _read_config(path: Path, cls: type, command: str) -> dict[str, Any]:
    table = read_toml(path)
    words = command.split()
    for depth, word in enumerate(words):
        tables = {name.split()[depth] for name in with_config() if name.split()[:depth] == words[:depth]}
        for key in table:
            if key not in tables:
                raise _unknown("table", key, sorted(tables), where=str(path))
        table = table.get(word, {})
        if not isinstance(table, dict):
            raise InputError(f"`{word}` is not a table", where=str(path), expected=f"[{command.replace(' ', '.')}]")
    items = {key_of(item): item for item in fields(cls)}
    hints = typing.get_type_hints(cls)
    values: dict[str, Any] = {}
    for key, value in table.items():
        item = items.get(key.replace("-", "_"))
        if item is None:
            valid_keys = [name for name, known in items.items() if not known.metadata["consent"]]
            raise _unknown("key", key, valid_keys, where=f"{path}: [{command.replace(' ', '.')}]")
        if item.metadata["consent"]:
            raise InputError(
                "cannot be set in a config file",
                where=f"{path}: {command}.{key}",
                expected=f"{flag_of(item)} on the command line, each time",
                found=f"{key} = {value!r}",
                hint="remove it from the file",
            )
        if item.name in values:
            raise InputError("set twice, with `-` and with `_`", where=f"{path}: {command}.{key}")
        values[item.name] = _coerce(value, hints[item.name], f"{path}: {command}.{key}")
    return values


def _unknown(what: str, name: str, valid_names: list[str], where: str) -> InputError:
    expected, hint = ", ".join(valid_names), did_you_mean(name, valid_names)
    return InputError(f"unknown {what} `{name}`", where=where, expected=expected, hint=hint)


def _coerce(value: Any, hint: Any, where: str) -> Any:
    """Return a TOML value as the type of its field. A bool is not an int; an int may be a float, a str a path."""
    wanted = [option for option in (typing.get_args(hint) or (hint,)) if option is not type(None)]
    for option in wanted:
        if option is Path and isinstance(value, str):
            return Path(value)
        if option is float and type(value) is int and abs(value) < sys.float_info.max:
            return float(value)
        if type(value) is option:
            return value
        if option == list[str] and isinstance(value, list) and all(isinstance(text, str) for text in value):
            return value
    names = " or ".join("list of texts" if option == list[str] else option.__name__ for option in wanted)
    raise InputError("wrong type", where=where, expected=names, found=repr(value))


def _check(item: "dataclasses.Field[Any]", value: Any) -> None:
    about, where = item.metadata, flag_of(item)
    if value is None:
        return
    unit = f" {about['unit']}" if about["unit"] else ""
    choices = about["choices"]
    if choices and value not in choices and about["plugins"]:
        choices += plugins.usable(about["plugins"])
    if choices and value not in choices:
        raise InputError(
            "unknown value",
            where=where,
            expected=", ".join(choices),
            found=str(value),
            hint=did_you_mean(str(value), choices),
        )
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        low, high = about["low"], about["high"]
        least, most = -MOST if low is None else low, MOST if high is None else high
        if not least <= value <= most:
            limits = f"at least {low}" if high is None and value < least else f"{least} to {most}"
            raise InputError("out of range", where=where, expected=f"{limits}{unit}", found=str(value)[:40])
