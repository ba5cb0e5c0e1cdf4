"""TOML tables as frozen types: each field declares its range, unit and meaning once.

Everything else is derived from the fields of a type. `schema_of` returns the JSON schema of its table, and `check`
reports errors in a table. `build` returns the object, and `as_table` the table as it enters a recipe.

A recipe contains only values that differ from the defaults. So a new part of the types leaves the recipes of all scenes
without that part unchanged. If a changed default changes results, METHOD of the stage is raised. Numbers are converted
to the field's type, so 341 and 341.0 give the same recipe.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, field, fields
from typing import Any, NamedTuple, TypeVar

from evetac_cli.errors import InputError, did_you_mean

T = TypeVar("T")
Rules = dict[str, Any]  # of JSON schema

LONGEST_S = 3600.0  # longest time that a scene may set
REQUIRED = MISSING  # the default of a field that a table must have
JSON_SCHEMA = "https://json-schema.org/draft/2020-12/schema"
TYPES = {
    "number": "a number",
    "integer": "a whole number",
    "string": "a text",
    "array": "a list",
    "object": "a table",
    "boolean": "true or false",
}
UNKNOWN = "additionalProperties"
FAULTS = {
    "type": "wrong type",
    "enum": "unknown value",
    "minItems": "wrong number of entries",
    "maxItems": "wrong number of entries",
    "minimum": "out of range",
    "maximum": "out of range",
    "exclusiveMinimum": "out of range",
}


class About(NamedTuple):
    """Description of a field, in addition to its type.

    rules: its JSON schema. table: the type of an inner table.

    needed_in, only_in: kinds of scene, or of motion, that require the field, or that alone may have it.

    order: "pair" (the lower end first), "rising" or "strictly rising".
    """

    rules: Rules
    table: type[Any] | None = None
    needed_in: tuple[str, ...] = ()
    only_in: tuple[str, ...] = ()
    order: str = ""


def number(
    meaning: str, least: float | None, most: float, *, above: float | None = None, default: Any = MISSING, **kinds: Any
) -> Any:
    """Declare a number from `least`, or from above `above`, to `most`."""
    return _declared(About({"description": meaning, **_range(least, most, above)}, **kinds), default)


def whole(meaning: str, least: int, most: int, *, default: Any = MISSING, **kinds: Any) -> Any:
    """Declare a whole number."""
    rules = {"description": meaning, "type": "integer", "minimum": least, "maximum": most}
    return _declared(About(rules, **kinds), default)


def flag(meaning: str, *, default: Any = MISSING, **kinds: Any) -> Any:
    """Declare a flag, true or false."""
    return _declared(About({"description": meaning, "type": "boolean"}, **kinds), default)


def one_of(meaning: str, names: Sequence[str], *, default: Any = MISSING, **kinds: Any) -> Any:
    """Declare a text that is one of `names`."""
    return _declared(About({"description": meaning, "enum": list(names)}, **kinds), default)


def words(meaning: str, most: int, *, pattern: str = "", default: Any = MISSING) -> Any:
    """Declare a text of at most `most` characters."""
    rules: Rules = {"description": meaning, "type": "string", "maxLength": most}
    return _declared(About({**rules, "pattern": pattern} if pattern else rules), default)


def constant(meaning: str, value: Any) -> Any:
    """Declare a required field that can only have this value."""
    return _declared(About({"description": meaning, "const": value}), MISSING)


def between(
    meaning: str,
    least: float | None,
    most: float,
    *,
    above: float | None = None,
    or_one: bool = False,
    default: Any = MISSING,
    **kinds: Any,
) -> Any:
    """Declare a range [low, high] from which values are drawn; or_one: a single number sets both ends."""
    ends = _range(least, most, above)
    pair = {"type": "array", "items": ends, "minItems": 2, "maxItems": 2}
    rules = {"description": meaning, **({"anyOf": [ends, pair]} if or_one else pair)}
    return _declared(About(rules, order="pair", **kinds), default)


def numbers(
    meaning: str,
    least: float | None,
    most: float,
    count: int | tuple[int, int],
    *,
    above: float | None = None,
    order: str = "",
    unique: bool = False,
    default: Any = MISSING,
    **kinds: Any,
) -> Any:
    """Declare a list of numbers with `count` entries, or with (fewest, most) entries."""
    return _declared(About(_list(meaning, _range(least, most, above), count, unique), order=order, **kinds), default)


def wholes(
    meaning: str, least: int, most: int, count: int | tuple[int, int], *, order: str = "", default: Any = MISSING
) -> Any:
    """Declare a list of whole numbers."""
    items = {"type": "integer", "minimum": least, "maximum": most}
    return _declared(About(_list(meaning, items, count), order=order), default)


def lists(meaning: str, items: Rules, count: tuple[int, int], *, unique: bool = False, default: Any = MISSING) -> Any:
    """Declare a list of entries that follow the JSON schema `items`."""
    return _declared(About(_list(meaning, items, count, unique)), default)


def table(type_: type[Any], *, default: Any = None, **kinds: Any) -> Any:
    """Declare an inner table; without a default it is None."""
    return _declared(About(rules_of(type_), type_, **kinds), default)


def duration(meaning: str, **more: Any) -> Any:
    """Declare a time in s, of at most an hour."""
    return number(meaning, 0, LONGEST_S, **more)


def pairs(low: float, high: float) -> Rules:
    """Return the JSON schema of [x, y]."""
    return {"type": "array", "items": _range(low, high, None), "minItems": 2, "maxItems": 2}


def _declared(details: About, default: Any) -> Any:
    metadata = {"about": details}
    return field(metadata=metadata) if default is MISSING else field(default=default, metadata=metadata)


def _range(least: float | None, most: float, above: float | None) -> Rules:
    return {"type": "number", **({"minimum": least} if above is None else {"exclusiveMinimum": above}), "maximum": most}


def _list(meaning: str, items: Rules, count: int | tuple[int, int], unique: bool = False) -> Rules:
    fewest, most = (count, count) if isinstance(count, int) else count
    rules = {"description": meaning, "type": "array", "items": items, "minItems": fewest, "maxItems": most}
    return {**rules, "uniqueItems": True} if unique else rules


def about(item: Field[Any]) -> About:
    """Return the description of a field."""
    details: About = item.metadata["about"]
    return details


def rules_of(type_: type[Any]) -> Rules:
    """Return the JSON schema of a type's table; the first paragraph of the type's docstring is its description."""
    meaning = (type_.__doc__ or "").split("\n\n")[0].replace("\n    ", " ").rstrip(".")
    return {
        "description": meaning[:1].lower() + meaning[1:],
        "type": "object",
        "required": [item.name for item in fields(type_) if item.default is MISSING],
        "additionalProperties": False,
        "properties": {item.name: about(item).rules for item in fields(type_)},
        **getattr(type_, "RULES", {}),
    }


def schema_of(type_: type[Any], title: str) -> Rules:
    """Return the JSON schema of a file that contains the table of a type."""
    rules = {key: value for key, value in rules_of(type_).items() if key != "description"}
    return {"$schema": JSON_SCHEMA, "title": title, **rules}


def build(type_: type[T], raw_table: Mapping[str, Any]) -> T:
    """Build an object from an unchecked table; numbers and lists are converted to the types of the fields."""
    details = {item.name: about(item) for item in fields(type_)}  # type: ignore[arg-type]
    return type_(**{name: _value(details[name], value) for name, value in raw_table.items()})


def read_table(type_: type[T], raw_table: Mapping[str, Any], where: str) -> T:
    """Build an object from a table of a file; InputError if the table is invalid."""
    check(type_, raw_table, where)
    try:
        return build(type_, raw_table)
    except ValueError as error:  # a fixed step that is in range but does not divide a slice
        raise InputError(str(error), where=where) from None


def _value(details: About, value: Any) -> Any:
    if details.table is not None:
        return build(details.table, value)
    if details.order == "pair" and not isinstance(value, Sequence):
        return (float(value), float(value))
    return _typed(value, details.rules.get("anyOf", [details.rules])[-1])


def _typed(value: Any, rules: Mapping[str, Any]) -> Any:
    value = rules.get("const", value)
    if isinstance(value, list | tuple):
        return tuple(_typed(item, rules.get("items", {})) for item in value)
    if rules.get("type") == "integer" and value == int(value):  # JSON schema also accepts 5.0 as a whole number
        return int(value)
    return float(value) if rules.get("type") == "number" else value


def as_table(one: Any, kind: str = "") -> dict[str, Any]:
    """Return the table of an object: values other than the defaults, or all values if its type is WRITTEN_WHOLE.

    Of the fields that its type lists in ALONE, only the first that is not None is written. Fields that the kind of
    scene requires are always written. A table that would be empty, but must not be, is written whole.
    """
    kind, alone = getattr(one, "kind", kind), getattr(one, "ALONE", ())
    first = next((name for name in alone if getattr(one, name) is not None), "")
    values = {
        item: value
        for item in fields(one)
        if (value := getattr(one, item.name)) is not None and (item.name not in alone or item.name == first)
    }
    changed = {
        item: value
        for item, value in values.items()
        if _is_whole(one) or _is_whole(value) or value != item.default or kind in about(item).needed_in
    }
    written = changed if changed or "minProperties" not in getattr(one, "RULES", {}) else values
    return {
        item.name: as_table(value, kind) if about(item).table is not None else _plain(value)
        for item, value in written.items()
    }


def _is_whole(one: Any) -> bool:
    return getattr(one, "WRITTEN_WHOLE", False)


def _plain(value: Any) -> Any:
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def check(
    type_: type[Any],
    raw_table: Mapping[str, Any],
    where: str,
    *,
    whole: bool = True,
    needed: tuple[str, ...] = (),
    if_missing: str = "",
    error: type[InputError] = InputError,
) -> None:
    """Raise an InputError that explains why no object of a type can be built from a table.

    whole: require every key without a default, and the keys in `needed`. if_missing: hint for a missing key.
    """
    rules = rules_of(type_)
    required = [*rules["required"], *needed] if whole else []
    try:
        check_rules(raw_table, where, {**rules, "required": required}, if_missing)
        for place, details, value in _entries(type_, raw_table, ""):
            _check_order(place, details, value, where)
        for place, columns, lengths in _columns(type_, raw_table, ""):
            _check_lengths(place, columns, lengths, where)
        _check_kinds(type_, raw_table, where)
    except InputError as refused:
        raise error(
            refused.message, where=refused.where, expected=refused.expected, found=refused.found, hint=refused.hint
        ) from None


def _entries(type_: type[Any], raw_table: Mapping[str, Any], place: str) -> Iterator[tuple[str, About, Any]]:
    """Yield each value of a table and its inner tables, as (path, description of the field, value)."""
    for item in fields(type_):
        if item.name not in raw_table:
            continue
        details, here = about(item), f"{place}{item.name}"
        yield here, details, raw_table[item.name]
        if details.table is not None:
            yield from _entries(details.table, raw_table[item.name], f"{here}.")


def _columns(
    type_: type[Any], raw_table: Mapping[str, Any], place: str
) -> Iterator[tuple[str, tuple[str, ...], dict[str, int]]]:
    """Yield the lists that must have the same length: path of their table, their names, and their lengths by name."""
    columns = getattr(type_, "COLUMNS", ())
    yield place, columns, {name: len(raw_table[name]) for name in columns if name in raw_table}
    for item in fields(type_):
        inner = about(item).table
        if inner is not None and item.name in raw_table:
            yield from _columns(inner, raw_table[item.name], f"{place}{item.name}.")


def _check_order(place: str, details: About, value: Any, where: str) -> None:
    if not details.order or not isinstance(value, list):
        return
    steps = list(zip(value, value[1:], strict=False))
    if details.order == "pair" and value[0] > value[1]:
        raise InputError(f"{place}: expected the lower end first", where=where, found=str(value))
    if details.order == "rising" and any(after < before for before, after in steps):
        raise InputError(f"{place}: expected rising values", where=where, found=str(value))
    if details.order == "strictly rising" and any(after <= before for before, after in steps):
        raise InputError(f"{place}: expected strictly rising values", where=where, found=str(value))


def _check_lengths(place: str, columns: tuple[str, ...], lengths: Mapping[str, int], where: str) -> None:
    if len(set(lengths.values())) <= 1:
        return
    first = next(name for name in columns if name in lengths)
    other = next(name for name in columns if lengths.get(name, lengths[first]) != lengths[first])
    raise InputError(
        f"{place}{other}: lists of different lengths",
        where=where,
        expected=f"one value for each of the {lengths[first]} in {first}",
        found=", ".join(f"{length} in {name}" for name, length in lengths.items()),
    )


def _check_kinds(type_: type[Any], raw_table: Mapping[str, Any], where: str) -> None:
    """Raise InputError if a key that the kind of scene or motion requires is missing, or it has one of another kind."""
    every_field = list(_every_field(type_, raw_table, "", ""))
    needed = {place: kind for place, kind, details, _ in every_field if kind in details.needed_in}
    for place, kind, details, is_named in every_field:
        if place in needed and not is_named:
            expected = ", ".join(needed)
            raise InputError(f"{place} is missing", where=where, expected=expected, found=f"kind {kind}")
        if is_named and details.only_in and kind not in details.only_in:
            expected = f"kind {', '.join(details.only_in)}"
            of_what = "motion" if place.startswith("motion.") else "scene"
            message = f"{place} is for another kind of {of_what}"
            raise InputError(message, where=where, expected=expected, found=f"kind {kind}")


def _every_field(
    type_: type[Any], raw_table: Mapping[str, Any] | None, place: str, kind: str
) -> Iterator[tuple[str, str, About, bool]]:
    """Yield all fields, also of missing tables: path, kind that applies, description, whether the table has it."""
    kind = (raw_table or {}).get("kind", kind)
    for item in fields(type_):
        details, here = about(item), f"{place}{item.name}"
        is_named = raw_table is not None and item.name in raw_table
        yield here, kind, details, is_named
        if details.table is not None:
            inner = raw_table[item.name] if raw_table is not None and is_named else None
            yield from _every_field(details.table, inner, f"{here}.", kind)


def check_rules(raw_table: Mapping[str, Any], where: str, rules: Mapping[str, Any], if_missing: str = "") -> None:
    """Raise a readable InputError if a table violates a schema; if_missing: hint for a missing key."""
    import jsonschema

    errors = jsonschema.Draft202012Validator(rules).iter_errors(raw_table)
    # first a misspelt key: it is also why another is missing
    error = min(errors, key=lambda error: (error.validator != UNKNOWN, *map(str, error.absolute_path)), default=None)
    if error is None:
        return
    schema = error.schema
    if error.validator == "anyOf":  # a number or a range: report the error of the form that the user chose
        meant = 1 if isinstance(error.instance, list) else 0
        error = next(one for one in error.context if one.schema_path[0] == meant)
        schema = {"description": schema["description"], **error.schema}
    place, rule = ".".join(str(step) for step in error.absolute_path), error.validator
    if rule == UNKNOWN:
        known_keys = list(schema["properties"])
        unknown = next(key for key in error.instance if key not in known_keys)
        hint = did_you_mean(unknown, known_keys) or f"known keys: {', '.join(known_keys)}"
        raise InputError(f"unknown key {f'{place}.' if place else ''}{unknown}", where=where, hint=hint)
    if rule == "required":
        missing = [key for key in error.validator_value if key not in error.instance]
        raise InputError(
            f"keys are missing{f' in {place}' if place else ''}",
            where=where,
            expected=", ".join(missing),
            found="none of them",
            hint=if_missing if not place else "",
        )
    found = f"{len(error.instance):,} entries" if rule in ("minItems", "maxItems") else str(error.instance)
    raise InputError(
        f"{place or 'the table'}: {FAULTS.get(rule, 'invalid value')}",
        where=where,
        expected=_expected(rule, schema) + (f" ({schema['description']})" if "description" in schema else ""),
        found=found,
        hint=did_you_mean(found, schema.get("enum", ())),
    )


def _expected(rule: str, schema: Mapping[str, Any]) -> str:
    """Describe the values that a schema accepts, as far as the violated rule is concerned."""
    if "enum" in schema:
        return ", ".join(schema["enum"])
    if schema.get("type") in ("number", "integer"):
        above = "exclusiveMinimum" in schema
        low = schema["exclusiveMinimum" if above else "minimum"]
        return f"{TYPES[schema['type']]}, {'more than ' if above else ''}{low:g} to {schema['maximum']:g}"
    if rule in ("minItems", "maxItems"):
        low, high = schema["minItems"], schema["maxItems"]
        return f"{low} entries" if low == high else f"{low} to {high:,} entries"
    if rule == "type":
        return TYPES[schema["type"]]
    if rule == "uniqueItems":
        return "each entry once"
    if rule == "minProperties":
        return f"at least {schema[rule]} of {', '.join(schema['properties'])}"
    if rule == "oneOf":
        return "either " + " or ".join(", ".join(one["required"]) for one in schema[rule])
    if rule == "not":
        return "one of " + " and ".join(schema[rule]["required"])
    return str(schema[rule])  # const, pattern
