"""One parameter of a command: default, help, unit and range; what of it goes into flags and a recipe.

Fields with `recipe=False` choose files or how to run; they do not change the numbers and are not part of a recipe.
"""

import dataclasses
from collections.abc import Collection
from dataclasses import field, fields
from typing import Any

from evetac_cli.errors import InputError

RUNNING = "Running"  # the panel of --help with what does not change the numbers


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
    """A dataclass field that knows its help text, unit and range (both ends included).

    consent: whether it lets something happen that a person has to want now, such as that a gripper moves: it is typed
    each time, and no file can give it. panel: under which heading `--help` shows it; those that most people need have
    none, and come first. plugins: the group (plugins.py) that may add to the choices. needs: the option has an effect
    only in a run that has one of these (names.py), and is refused in any other; without, it has an effect in every run,
    or its stage checks it.
    """
    about = {"help": help_, "unit": unit, "choices": choices, "low": low, "high": high}
    how = {"recipe": recipe, "consent": consent, "flag": flag, "panel": panel, "plugins": plugins}
    return field(default=default, metadata={**about, **how, "needs": needs})


def recipe_of(params: Any) -> dict[str, Any]:
    """The parameters that determine the numbers, for a header."""
    return {item.name: getattr(params, item.name) for item in fields(params) if item.metadata["recipe"]}


def flag_of(item: "dataclasses.Field[Any]") -> str:
    """The long flag of a field: --step-size for step_size; without dashes it is a positional argument."""
    return str(item.metadata["flag"]) or "--" + item.name.replace("_", "-")


def refuse_unused(params: Any, has: Collection[str], flags: str, *, never: Collection[str] = ()) -> None:
    """InputError for an option that is not at its default, and needs what this run does not have.

    has: what the run has, of names.Capability and its like; flags: those that say so, for the error; never: what no
    run of this command has, and the error need not name.
    """
    for item in fields(params):
        needs = item.metadata["needs"]
        if not needs or getattr(params, item.name) == item.default or not set(has).isdisjoint(needs):
            continue
        raise InputError(
            f"has no effect in this run: it belongs to {' or '.join(need for need in needs if need not in never)}",
            where=flag_of(item),
            found=flags,
            hint=f"leave out {flag_of(item)}",
        )
