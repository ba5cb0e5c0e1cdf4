"""Headers against their rules: what is said to follow them is what jsonschema finds nothing wrong with."""

import copy
import json
from typing import Any

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.inspect.header_rules import follows
from evetac_cli.resources import schemas

RULES: dict[str, Any] = json.loads((schemas() / "header.v1.json").read_text())
ID = "0123456789abcdef" * 4
HEADER: dict[str, Any] = {
    "kind": "tracks",
    "version": "1.6",
    "method": 4,
    "parameters": {"preset": "stable"},
    "seed": None,
    "parents": [ID],
    "content": None,
    "id": ID,
    "simulated": True,
    "history": {ID: {}},
    "made": {"at": "today"},
}
ANYTHING = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 3),
    st.floats(),
    st.sampled_from(["", "1.6", "1.6\n", "1.x", ID, ID[1:], ID.upper(), "tracks"]),
    st.lists(st.sampled_from([ID, "x", 1, None]), max_size=2),
    st.dictionaries(st.sampled_from(["a", "b"]), st.integers(), max_size=2),
)


def is_valid(value: Any, rules: Any) -> bool:
    """What jsonschema says."""
    return next(jsonschema.Draft202012Validator(rules).iter_errors(value), None) is None


def test_a_header_follows_them() -> None:
    """Assert that the rules use nothing that is unknown here: jsonschema is not needed for a header as it should be."""
    assert follows(HEADER, RULES)
    assert follows(HEADER | {"seed": 3, "content": ID, "parents": [], "shared": []}, RULES)


@given(st.sampled_from([*HEADER, "shared", "more"]), ANYTHING)
def test_one_value_changed(name: str, value: Any) -> None:
    """Assert the same verdict as jsonschema's, but for a number with a fraction of 0, which is left to it."""
    header = HEADER | {name: value}
    assert follows(header, RULES) <= is_valid(header, RULES)
    if not isinstance(value, float):
        assert follows(header, RULES) == is_valid(header, RULES)


@pytest.mark.parametrize("name", HEADER)
def test_each_is_needed(name: str) -> None:
    """Assert that a header that lacks an entry does not follow them, except where jsonschema says that it does."""
    header = copy.deepcopy(HEADER)
    del header[name]
    assert follows(header, RULES) == is_valid(header, RULES)
    assert not follows(header, RULES)


@pytest.mark.parametrize(
    ("value", "rules"),
    [
        (1, {"maximum": 2}),
        (1, {"type": "number"}),
        (1.0, {"type": "integer"}),
        ({"a": 1}, {"additionalProperties": {"type": "integer"}}),
        (1, {"$ref": "#/elsewhere"}),
    ],
)
def test_what_is_not_known_here_is_left_to_jsonschema(value: Any, rules: dict[str, Any]) -> None:
    """Assert that rules of other words are never said to be followed."""
    assert not follows(value, rules)
