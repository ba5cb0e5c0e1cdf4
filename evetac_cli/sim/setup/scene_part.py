"""A part of a simulated scene: one class that knows its name, its keys, and the plan without it.

A scene pays run time only for the parts that scene and sensor name. A part that simulates something is built by `of`,
in the one place where it acts. A part that is a value of another part has nothing to build. `evetac_cli.sim.parts`
lists all of them, for dry runs, docs and tests. A Timer measures the calls that represent a part.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, ClassVar, Protocol, Self, TypeVar

import numpy as np

from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.tables import as_table

MOST_SHOWN = 4  # values of a list; longer ones are not shown

Settings = TypeVar("Settings")


class ScenePart:
    """A part of a scene; NAME is empty for a base of parts.

    KEYS: the keys that name it, of a plan's sensor or scene, for example `scene.drop.mass_g`. By default, a plan has
    the part if one of them differs from its default.

    MEASURED: whether it costs run time and can be left out alone, so that a dry run measures its cost.
    """

    NAME: ClassVar[str] = ""
    KEYS: ClassVar[tuple[str, ...]] = ()
    MEASURED: ClassVar[bool] = True

    def __init__(self, plan: Plan, rng: np.random.Generator | None = None) -> None:
        """Build the part of a plan that has it; rng: its own random stream, for a part that draws from one."""

    @classmethod
    def of(cls, plan: Plan, rng: np.random.Generator | None = None) -> Self | None:
        """Return the part of a plan; None if neither its scene nor its sensor names it."""
        return cls(plan, rng) if cls.is_in(plan) else None

    @classmethod
    def is_in(cls, plan: Plan) -> bool:
        """Return whether a plan has the part."""
        return any(_at(plan, key) != _default(plan, key) for key in cls.KEYS)

    @classmethod
    def describe(cls, plan: Plan) -> str | None:
        """Return the values of the part's keys, without tables and long lists; None if the plan lacks the part."""
        if not cls.is_in(plan):
            return None
        tables = {"sensor": as_table(plan.sensor), "scene": as_table(plan.scene)}
        found = []
        for owner, path in (key.split(".", 1) for key in cls.KEYS):
            value: Any = tables[owner]
            for name in path.split("."):
                value = value.get(name) if isinstance(value, dict) else None
            if not (value is None or isinstance(value, dict) or (isinstance(value, list) and len(value) > MOST_SHOWN)):
                found.append(f"{name} {_shown(value)}")
        return ", ".join(found)

    @classmethod
    def without(cls, plan: Plan) -> Plan:
        """Return the same plan without the part: its keys have their defaults."""
        for key in cls.KEYS:
            plan = _reset(plan, key)
        return plan

    @classmethod
    def switched(cls, plan: Plan) -> Plan | None:
        """Return the plan with which the part's cost is measured; None if it is not measured."""
        return cls.without(plan) if cls.MEASURED and cls.is_in(plan) else None


class Essential(ScenePart):
    """A part without which its kind of scene is none, or whose time is measured by its calls."""

    MEASURED = False

    @classmethod
    def is_in(cls, plan: Plan) -> bool:
        """Return whether a plan has the part."""
        return True


class OfGripper(ScenePart):
    """A part of scenes in which a gripper holds an object."""

    MEASURED = False

    @classmethod
    def is_in(cls, plan: Plan) -> bool:
        """Return whether a plan has the part."""
        return plan.scene.is_gripped and super().is_in(plan)


def _at(one: Any, key: str) -> Any:
    """Return the value at a dotted key; None if a table on the way to it is left out."""
    for name in key.split("."):
        one = None if one is None else getattr(one, name)
    return one


def _default(one: Any, key: str) -> Any:
    """Return the default of a dotted key; None if a table on the way to it is left out by default."""
    name, _, inner = key.partition(".")
    default = next(item.default for item in fields(one) if item.name == name)
    value = getattr(one, name)
    if not inner or value is None or default is None:
        return default
    return _default(value, inner)


def _reset(one: Settings, key: str) -> Settings:
    """Return settings with the value at a dotted key, or the optional table that holds it, as by default."""
    name, _, inner = key.partition(".")
    item = next(item for item in fields(one) if item.name == name)  # type: ignore[arg-type]
    if inner and item.default is not None:
        return replace(one, **{name: _reset(getattr(one, name), inner)})  # type: ignore[type-var]
    return replace(one, **{name: item.default})  # type: ignore[type-var]


def _shown(value: Any) -> str:
    if isinstance(value, list):
        if len(value) == 2 and value[0] == value[1]:
            return _shown(value[0])  # a range of one number
        return f"[{', '.join(map(_shown, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


Call = TypeVar("Call", bound=Callable[..., Any])


class Timer(Protocol):
    """Measures the calls that belong to a part; code that makes such calls wraps them once and keeps the result."""

    def __call__(self, part: str, call: Call) -> Call:
        """Return the call, wrapped so that its time is counted for the part."""


def untimed(part: str, call: Call) -> Call:
    """Return the call itself: nothing is measured, so it costs nothing."""
    return call
