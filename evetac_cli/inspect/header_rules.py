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


def _follows(value: Any, rules: Rules, definitions: Rules) -> bool:
    """Whether a value follows the rules; NotImplementedError for other keywords. definitions: rules referred to."""
    if unknown := rules.keys() - _KEYWORDS.keys() - {*NOTES}:
        raise NotImplementedError(f"keywords {', '.join(unknown)}")
    return all(
        _KEYWORDS[word](value, requirement, rules, definitions)
        for word, requirement in rules.items()
        if word not in NOTES
    )


def _is_of(value: Any, kind: str) -> bool:
    if kind in TYPES:
        return isinstance(value, TYPES[kind])
    if kind != "integer" or isinstance(value, float):  # 1.0 would count as an integer
        raise NotImplementedError(f"type {kind}")
    return isinstance(value, int) and not isinstance(value, bool)


def _type(value: Any, requirement: str | list[str], rules: Rules, definitions: Rules) -> bool:
    return any(_is_of(value, kind) for kind in ([requirement] if isinstance(requirement, str) else requirement))


def _enum(value: Any, requirement: list[Any], rules: Rules, definitions: Rules) -> bool:
    return any(type(value) is type(one) and value == one for one in requirement)


def _required(value: Any, requirement: list[str], rules: Rules, definitions: Rules) -> bool:
    return not isinstance(value, dict) or all(name in value for name in requirement)


def _properties(value: Any, requirement: Rules, rules: Rules, definitions: Rules) -> bool:
    return not isinstance(value, dict) or all(
        _follows(value[name], each, definitions) for name, each in requirement.items() if name in value
    )


def _additional(value: Any, requirement: Any, rules: Rules, definitions: Rules) -> bool:
    if requirement is not False:
        raise NotImplementedError("additionalProperties with rules")
    return not isinstance(value, dict) or value.keys() <= rules.get("properties", {}).keys()


def _items(value: Any, requirement: Rules, rules: Rules, definitions: Rules) -> bool:
    return not isinstance(value, list) or all(_follows(one, requirement, definitions) for one in value)


def _pattern(value: Any, requirement: str, rules: Rules, definitions: Rules) -> bool:
    return not isinstance(value, str) or re.search(requirement, value) is not None


def _minimum(value: Any, requirement: float, rules: Rules, definitions: Rules) -> bool:
    return isinstance(value, bool) or not isinstance(value, (int, float)) or bool(value >= requirement)


def _ref(value: Any, requirement: str, rules: Rules, definitions: Rules) -> bool:
    start = "#/$defs/"
    if not requirement.startswith(start) or requirement.removeprefix(start) not in definitions:
        raise NotImplementedError(requirement)
    return _follows(value, definitions[requirement.removeprefix(start)], definitions)


def _one_of(value: Any, requirement: list[Rules], rules: Rules, definitions: Rules) -> bool:
    return sum(_follows(value, each, definitions) for each in requirement) == 1


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
