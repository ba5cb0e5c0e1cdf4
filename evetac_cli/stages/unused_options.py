"""Refuses options that would have no effect in a run: none is ignored silently."""

from collections.abc import Collection
from dataclasses import fields
from typing import Any

from evetac_cli.errors import InputError
from evetac_cli.params.parameter import flag_of


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
