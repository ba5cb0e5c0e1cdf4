"""The commands: one module each, with its flags, its examples and the name of the stage that it runs.

Of evetac, this package imports only names and errors, which keeps `--help` fast. Stages take their parameters from
here, and a stage is imported only when its command is chosen. The module of a command is also imported on demand, by
`find` and by the tuples of all commands: building the flags of all commands takes noticeable time.
"""

import importlib
from collections.abc import Callable
from functools import cache, partial
from typing import Any

from evetac_cli.commands.parameter import Command

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
# Built on first access.
PIPELINE: tuple[Command, ...]
# Commands whose output is for people; built at each access.
VIEW: Command
EXPORT: Command
DOCTOR: Command
SHARE: Command
REPORT: Command


def find(name: str) -> Command:
    """Return the command that `evetac NAME` runs; `evaluate` is a group and not among them."""
    found: Command = _module(name).COMMAND
    return found


def _module(name: str) -> Any:
    return importlib.import_module(f"{__name__}.{name.replace('-', '_')}")


@cache
def _pipeline() -> tuple[Command, ...]:
    return tuple(map(find, OF_PIPELINE))


_MADE: dict[str, Callable[[], Any]] = {
    "PIPELINE": _pipeline,
    **{name.upper(): partial(find, name) for name in ("view", "export", "doctor", "share", "report")},
}


def __getattr__(name: str) -> Any:
    if name in _MADE:
        return _MADE[name]()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
