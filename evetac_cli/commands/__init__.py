"""The commands: a module each, with its flags, its examples and the name of the stage that it runs.

Why so: nothing of ours but names and errors is imported here, so that `--help` is light, and stages take their
parameters from here; a stage is imported when its command is chosen. So is the module of a command, since the flags of
all take as long to make as those of one take to read: `find` imports it, and so do the tuples of all of them.
"""

import importlib
from collections.abc import Callable
from functools import cache, partial
from typing import Any

from evetac_cli.commands.command import Command

OF_PIPELINE = (
    "record",
    "trim",
    "attach",
    "calibrate",
    "identify",
    "label",
    "track",
    "featurize",
    "train",
    "track-rgb",
    "train-force",
    "predict-touch",
    "grasp",
)
# Made when they are asked for.
PIPELINE: tuple[Command, ...]
EVALUATE: tuple[Command, ...]
# For people, made again whenever asked for.
VIEW: Command
EXPORT: Command
DOCTOR: Command
SHARE: Command
REPORT: Command
# A table of a config file for each: [track], [evaluate.slip].
WITH_CONFIG: dict[str, Command]


def find(name: str) -> Command:
    """The command of a name, `evaluate` not among them, as `evetac NAME` runs it."""
    found: Command = _module(name).COMMAND
    return found


def _module(name: str) -> Any:
    return importlib.import_module(f"{__name__}.{name.replace('-', '_')}")


@cache
def _pipeline() -> tuple[Command, ...]:
    return tuple(map(find, OF_PIPELINE))


def _evaluate() -> tuple[Command, ...]:
    found: tuple[Command, ...] = _module("evaluate").COMMANDS
    return found


@cache
def _with_config() -> dict[str, Command]:
    named = {command.name: command for command in _pipeline()}
    return named | {f"evaluate {command.name}": command for command in _evaluate()}


_MADE: dict[str, Callable[[], Any]] = {
    "PIPELINE": _pipeline,
    "EVALUATE": _evaluate,
    "WITH_CONFIG": _with_config,
    **{name.upper(): partial(find, name) for name in ("view", "export", "doctor", "share", "report")},
}


def __getattr__(name: str) -> Any:
    if name in _MADE:
        return _MADE[name]()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
