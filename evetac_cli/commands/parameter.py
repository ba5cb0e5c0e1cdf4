"""A command, and one parameter of it: its default, help, unit and range, and whether it is part of the recipe.

Fields with `recipe=False` choose files or how a command runs. They do not change the numbers and are not part of a
recipe.
"""

import dataclasses
from collections.abc import Collection
from dataclasses import dataclass, field, fields
from typing import Any

from evetac_cli.errors import InputError

RUNNING = "Running"  # the panel of --help with flags that do not change the numbers
EXPERTS = "Precision and experts"  # the panel that only --help-all shows
STAGE, PAGE, LOOK = "stage", "page", "look"


@dataclass(frozen=True)
class Command:
    """A command: its parameters, its module, its input files, and the unit of its progress bar.

    does: STAGE writes stage files, PAGE files for people and other programs, LOOK prints a result. out, force: help of
    -o and -f; only a STAGE has these flags without it.
    """

    name: str
    params: type
    module: str
    files: str  # help text of the file arguments; empty if the command takes none
    kind: str = "recording"  # kind of the files taken from a folder, * for all; empty: it handles folders itself
    suffix: str = ".h5"  # of an output file named by -o
    unit: str = "slices"  # empty: no progress bar
    files_needed: bool = True
    examples: tuple[str, ...] = ()  # command lines shown by --help
    does: str = STAGE
    out: str = ""
    force: str = ""
    panel: str = ""  # heading under which the help of its group lists it


def parameter(
    default: Any,
    help_: str,
    *,
    unit: str = "",
    choices: tuple[str, ...] = (),
    low: float | None = None,
    high: float | None = None,
    recipe: bool = True,
    consent: bool = False,
    flag: str = "",
    panel: str = "",
    plugins: str = "",
    needs: tuple[str, ...] = (),
) -> Any:
    """Return a dataclass field that stores its help text, unit and range (both ends included) as metadata.

    - consent: the flag permits an action that a person must want now, such as moving a gripper. It must be typed each
      time; a config file cannot set it.
    - panel: heading under which `--help` shows the flag. The flags that most people need have none and come first.
    - plugins: the plug-in group (plugins.py) that may add choices.
    - needs: capabilities (names.py). In a run that has none of them the option is refused, because it would have no
      effect. If empty, the option is always accepted, or its stage checks it.
    """
    about = {"help": help_, "unit": unit, "choices": choices, "low": low, "high": high}
    how = {"recipe": recipe, "consent": consent, "flag": flag, "panel": panel, "plugins": plugins}
    return field(default=default, metadata={**about, **how, "needs": needs})


def recipe_of(params: Any) -> dict[str, Any]:
    """Return the parameters that determine the numbers, for a file's header."""
    return {item.name: getattr(params, item.name) for item in fields(params) if item.metadata["recipe"]}


def flag_of(item: "dataclasses.Field[Any]") -> str:
    """Return the long flag of a field: --step-size for step_size. A name without dashes is a positional argument."""
    return str(item.metadata["flag"]) or "--" + item.name.replace("_", "-")


def key_of(item: "dataclasses.Field[Any]") -> str:
    """Return the key of a field in a config file: its flag without leading dashes, step_size for --step-size."""
    return flag_of(item).removeprefix("--").replace("-", "_").lower()


def refuse_unused(params: Any, has: Collection[str], flags: str, *, never: Collection[str] = ()) -> None:
    """Raise InputError for an option that differs from its default but needs a capability that this run lacks.

    - has: capabilities of the run, such as members of names.Capability.
    - flags: the flags that determine them, for the error.
    - never: capabilities that no run of this command has; the error does not name them.
    """
    for item in fields(params):
        needs = item.metadata["needs"]
        if not needs or getattr(params, item.name) == item.default or not set(has).isdisjoint(needs):
            continue
        raise InputError(
            f"has no effect in this run: it needs {' or '.join(need for need in needs if need not in never)}",
            where=flag_of(item),
            found=flags,
            hint=f"leave out {flag_of(item)}",
        )
