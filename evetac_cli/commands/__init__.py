"""The commands: one module each, with its flags, its examples and the name of the stage that it runs.

Of evetac, this package imports only names and errors, which keeps `--help` fast. Stages take their parameters from
here, and a stage is imported only when its command is chosen. The module of a command is also imported on demand, by
`find`, `pipeline` and `every`: building the flags of all commands takes noticeable time.
"""

import importlib
from functools import cache
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
    "train-force",
    "predict-touch",
    "grasp",
)
# The commands under each heading of `evetac --help`; `evaluate` and `doctor` are groups with commands of their own.
PANELS = {
    "Pipeline": (*OF_PIPELINE, "evaluate"),
    "Inspect": ("info", "list", "view", "report", "export", "share", "validate", "doctor"),
}
GROUPS = ("evaluate", "doctor")
MODULES = {"list": "listing"}  # of commands whose name a module cannot have


def find(name: str) -> Command:
    """Return the command that `evetac NAME` runs; `evaluate` alone runs none."""
    found: Command = _module(name).COMMAND
    return found


def parts(group: str) -> tuple[Command, ...]:
    """Return the commands of a group, such as those of `evetac doctor NAME`; not of evaluate."""
    found: tuple[Command, ...] = _module(group).COMMANDS
    return found


def _module(name: str) -> Any:
    return importlib.import_module(f"{__name__}.{MODULES.get(name, name.replace('-', '_'))}")


@cache
def pipeline() -> tuple[Command, ...]:
    """Return the commands of the pipeline, in order."""
    return tuple(map(find, OF_PIPELINE))


@cache
def every() -> dict[str, Command]:
    """Return all commands by the words that call each; the subjects of evaluate are in evaluate."""
    alone = (name for names in PANELS.values() for name in names if name != "evaluate")
    return {name: find(name) for name in alone} | {f"doctor {part.name}": part for part in parts("doctor")}
