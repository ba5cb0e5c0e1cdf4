"""TOML tables as frozen types: each field declares its type, range and meaning once.

msgspec builds the objects and checks types and ranges. This module adds hints for unknown keys, keys that
depend on the kind of scene, ordered lists, and the table as it enters a recipe. scripts/schemas.py makes the JSON
schemas from the same types. The comment `#:` above a field is its description there.

A recipe contains only values that differ from the defaults. So a new part of the types leaves the recipes of all scenes
without that part unchanged. If a changed default changes results, METHOD of the stage is raised. Numbers are converted
to the field's type, so 341 and 341.0 give the same recipe.
"""

import operator
import re
from collections.abc import Mapping
from dataclasses import fields
from typing import Annotated, Any, ClassVar, TypeVar

import msgspec
from msgspec import Meta, inspect

from evetac_cli.errors import InputError, did_you_mean

T = TypeVar("T")
Item = TypeVar("Item")

RISING = Meta(extra_json_schema={"order": "rising"})
STRICTLY_RISING = Meta(extra_json_schema={"order": "strictly rising"})
UNIQUE = Meta(extra_json_schema={"uniqueItems": True})
IN_ORDER = {"rising": operator.le, "strictly rising": operator.lt}

Positive = Annotated[float, Meta(gt=0, le=1000)]
Large = Annotated[float, Meta(gt=0, le=10_000)]
Share = Annotated[float, Meta(ge=0, le=1)]
UpTo100 = Annotated[float, Meta(ge=0, le=100)]
UpTo1000 = Annotated[float, Meta(ge=0, le=1000)]
Seconds = Annotated[float, Meta(ge=0, le=3600)]
Range = Annotated[tuple[Item, Item], RISING, Meta(extra={"one_number": True})]  # or one number, which is both ends


def kinds(*only: str, needed: tuple[str, ...] = ()) -> Meta:
    """Restrict a key to kinds of scene, or of motion (`only`); those in `needed` require it."""
    return Meta(extra={"only": only, "needed": needed})


class Table:
    """A table of a file, as a frozen dataclass.

    COLUMNS: lists with an entry for each row. ALONE: keys of which one is given. NOT_EMPTY: at least one key is given.
    WRITTEN_WHOLE: values at their defaults enter a recipe too.
    """

    COLUMNS: ClassVar[tuple[str, ...]] = ()
    ALONE: ClassVar[tuple[str, ...]] = ()
    NOT_EMPTY: ClassVar = False
    WRITTEN_WHOLE: ClassVar = False

    def __post_init__(self) -> None:
        """Check lists; ValueError if one is out of order, or columns have different lengths."""
        for name, (_, notes) in fields_of(type(self)).items():
            values = getattr(self, name)
            if values and "order" in notes and not all(map(IN_ORDER[notes["order"]], values, values[1:])):
                raise ValueError(f"{name}: expected {notes['order']} values, found {values}")
            if "uniqueItems" in notes and len(set(values)) < len(values):
                raise ValueError(f"{name}: expected each entry once")
        lengths = {name: len(getattr(self, name)) for name in self.COLUMNS}
        for name, length in lengths.items():
            if length != lengths[self.COLUMNS[0]]:
                raise ValueError(f"{name}: expected as many entries as {self.COLUMNS[0]}, found {lengths}")


_FIELDS: dict[type[Any], dict[str, tuple[inspect.Type, dict[str, Any]]]] = {}  # of all types so far


def fields_of(type_: type[Any]) -> dict[str, tuple[inspect.Type, dict[str, Any]]]:
    """Return the type of each field of a table, without None, and what its annotations add."""
    if type_ not in _FIELDS:
        info = inspect.type_info(type_)
        assert isinstance(info, inspect.DataclassType)
        _FIELDS[type_] = {item.name: _bare(item.type) for item in info.fields}
    return _FIELDS[type_]


def _bare(info: inspect.Type) -> tuple[inspect.Type, dict[str, Any]]:
    notes: dict[str, Any] = {}
    while isinstance(info, inspect.Metadata | inspect.UnionType):
        if isinstance(info, inspect.Metadata):
            notes |= {**(info.extra_json_schema or {}), **(info.extra or {})}
        info = info.type if isinstance(info, inspect.Metadata) else info.types[0]
    return info, notes


def read_table(
    type_: type[T],
    raw_table: Mapping[str, Any],
    where: str,
    *,
    needed: tuple[str, ...] = (),
    if_missing: str = "",
    error: type[InputError] = InputError,
) -> T:
    """Build an object from a table of a file; InputError if the table is invalid.

    needed: keys that are required besides those without a default. if_missing: hint for a missing key.
    """
    if not isinstance(raw_table, Mapping):
        raise error("not a table", where=where, found=str(raw_table)[:100])
    try:
        plain = _plain_table(type_, raw_table, "", "", needed, if_missing)
    except InputError as refused:
        raise error(refused.message, where=where, expected=refused.expected, hint=refused.hint) from None
    try:
        return msgspec.convert(plain, type_)
    except msgspec.ValidationError as fault:
        text, _, place = str(fault).removesuffix("`").partition(" - at `$")
    place = re.sub(r"\[(\d+)\]", r".\1", place).removeprefix(".")
    if not text.startswith(("Expected", "Invalid")):  # by __post_init__ of a table
        raise error(f"{place}.{text}".removeprefix("."), where=where)
    found: Any = plain
    for step in place.split("."):
        found = found[int(step) if step.isdigit() else step]
    expected = text.removeprefix("Expected ").replace("`", "")
    raise error(f"{place}: invalid value", where=where, expected=expected, found=str(found)[:100])


def _plain_table(
    type_: type[Any], raw_table: Mapping[str, Any], place: str, kind: str, needed: tuple[str, ...], if_missing: str
) -> dict[str, Any]:
    """Return a table as msgspec takes it; InputError if it has unknown keys or lacks keys that its kind requires."""
    known, kind = fields_of(type_), raw_table.get("kind", kind)
    for key in raw_table:
        if key not in known:
            raise InputError(
                f"unknown key {place}{key}", hint=did_you_mean(key, known) or f"known keys: {', '.join(known)}"
            )
        only = known[key][1].get("only")
        if kind and only and kind not in only:
            raise InputError(f"{place}{key}: not for kind {kind}", expected=f"kind {', '.join(only)}")
    required = {item.name for item in fields(type_) if item.default is item.default_factory}
    missing = [
        f"{place}{name}"
        for name, (_, notes) in known.items()
        if name not in raw_table and (name in required or name in needed or kind in notes.get("needed", ()))
    ]
    given = [name for name in type_.ALONE if name in raw_table]
    if missing:
        raise InputError("keys are missing", expected=", ".join(missing), hint=if_missing)
    if len(given) > 1 or (type_.NOT_EMPTY and not raw_table):
        raise InputError(f"{place.rstrip('.')}: invalid table", expected=f"one of {', '.join(given or known)}")
    return {key: _plain(*known[key], value, f"{place}{key}", kind) for key, value in raw_table.items()}


def _plain(info: inspect.Type, notes: Mapping[str, Any], value: Any, place: str, kind: str) -> Any:
    match info:
        case inspect.DataclassType() if isinstance(value, Mapping):
            return _plain_table(info.cls, value, f"{place}.", kind, (), "")
        case inspect.TupleType() if "one_number" in notes and isinstance(value, int | float):
            return _plain(info, {}, [value, value], place, kind)
        case inspect.TupleType() | inspect.VarTupleType() if isinstance(value, list | tuple):
            of_item = _bare(info.item_types[0] if isinstance(info, inspect.TupleType) else info.item_type)
            return [_plain(*of_item, item, place, kind) for item in value]
        case inspect.IntType() if isinstance(value, float) and value.is_integer():
            return int(value)
        case inspect.FloatType() if isinstance(value, float):
            return float(value)  # of numpy
        case inspect.LiteralType() if isinstance(value, str) and value not in info.values:
            names = [str(name) for name in info.values]
            raise InputError(
                f"{place}: unknown value {value}", expected=", ".join(names), hint=did_you_mean(value, names)
            )
    return value


def as_table(one: Table, kind: str = "") -> dict[str, Any]:
    """Return the table of an object: values other than the defaults, or all values if its type is WRITTEN_WHOLE.

    Of the keys in ALONE, only the first that is not None is written. Keys that the kind of scene requires are always
    written. A table that would be empty, but must not be, is written whole.
    """
    kind, known = getattr(one, "kind", kind), fields_of(type(one))
    first = next((name for name in one.ALONE if getattr(one, name) is not None), "")
    values = {
        item: value
        for item in fields(one)  # type: ignore[arg-type]
        if (value := getattr(one, item.name)) is not None and (item.name not in one.ALONE or item.name == first)
    }
    changed = {
        item: value
        for item, value in values.items()
        if one.WRITTEN_WHOLE
        or getattr(value, "WRITTEN_WHOLE", False)
        or value != item.default
        or kind in known[item.name][1].get("needed", ())
    }
    written = changed or (values if one.NOT_EMPTY else {})
    return {
        item.name: as_table(value, kind) if isinstance(value, Table) else _listed(value)
        for item, value in written.items()
    }


def _listed(value: Any) -> Any:
    return [_listed(item) for item in value] if isinstance(value, tuple) else value
