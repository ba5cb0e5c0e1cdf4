"""Check whether a header follows the rules of schemas/header.v1.json, without jsonschema.

Reason: importing jsonschema takes as long as validating a file. It is used only if a header does not follow the rules,
for its error message, or if the rules use keywords that are not implemented here.
"""

import re
from collections.abc import Callable, Mapping
from typing import Any

NOTES = ("$schema", "$defs", "title", "description")  # keywords without requirements
TYPES: Mapping[str, type] = {"object": dict, "array": list, "string": str, "boolean": bool, "null": type(None)}
Rules = Mapping[str, Any]


def follows(value: Any, rules: Rules) -> bool:
    """Whether a JSON value follows the rules of a JSON schema (draft 2020-12); False also if that is unknown."""
    try:
        return _follows(value, rules, rules.get("$defs", {}))
    except NotImplementedError:
        return False


def _follows(value: Any, rules: Rules, named: Rules) -> bool:
    """Whether a value follows the rules; NotImplementedError for other keywords. named: rules that others refer to."""
    if unknown := rules.keys() - _KEYWORDS.keys() - {*NOTES}:
        raise NotImplementedError(f"keywords {', '.join(unknown)}")
    return all(_KEYWORDS[word](value, asked, rules, named) for word, asked in rules.items() if word not in NOTES)


def _is_of(value: Any, kind: str) -> bool:
    if kind in TYPES:
        return isinstance(value, TYPES[kind])
    if kind != "integer" or isinstance(value, float):  # 1.0 would count as an integer
        raise NotImplementedError(f"type {kind}")
    return isinstance(value, int) and not isinstance(value, bool)


def _type(value: Any, asked: str | list[str], rules: Rules, named: Rules) -> bool:
    return any(_is_of(value, kind) for kind in ([asked] if isinstance(asked, str) else asked))


def _enum(value: Any, asked: list[Any], rules: Rules, named: Rules) -> bool:
    return any(type(value) is type(one) and value == one for one in asked)


def _required(value: Any, asked: list[str], rules: Rules, named: Rules) -> bool:
    return not isinstance(value, dict) or all(name in value for name in asked)


def _properties(value: Any, asked: Rules, rules: Rules, named: Rules) -> bool:
    return not isinstance(value, dict) or all(
        _follows(value[name], each, named) for name, each in asked.items() if name in value
    )


def _additional(value: Any, asked: Any, rules: Rules, named: Rules) -> bool:
    if asked is not False:
        raise NotImplementedError("additionalProperties with rules")
    return not isinstance(value, dict) or value.keys() <= rules.get("properties", {}).keys()


def _items(value: Any, asked: Rules, rules: Rules, named: Rules) -> bool:
    return not isinstance(value, list) or all(_follows(one, asked, named) for one in value)


def _pattern(value: Any, asked: str, rules: Rules, named: Rules) -> bool:
    return not isinstance(value, str) or re.search(asked, value) is not None


def _minimum(value: Any, asked: float, rules: Rules, named: Rules) -> bool:
    return isinstance(value, bool) or not isinstance(value, (int, float)) or bool(value >= asked)


def _ref(value: Any, asked: str, rules: Rules, named: Rules) -> bool:
    start = "#/$defs/"
    if not asked.startswith(start) or asked.removeprefix(start) not in named:
        raise NotImplementedError(asked)
    return _follows(value, named[asked.removeprefix(start)], named)


def _one_of(value: Any, asked: list[Rules], rules: Rules, named: Rules) -> bool:
    return sum(_follows(value, each, named) for each in asked) == 1


_KEYWORDS: dict[str, Callable[[Any, Any, Rules, Rules], bool]] = {
    "type": _type,
    "enum": _enum,
    "required": _required,
    "properties": _properties,
    "additionalProperties": _additional,
    "items": _items,
    "pattern": _pattern,
    "minimum": _minimum,
    "$ref": _ref,
    "oneOf": _one_of,
}
