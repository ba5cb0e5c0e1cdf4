"""JSON of limited size and depth: what is read can be walked and written again, and the rest is a ValueError."""

import json

import pytest

from evetac_cli.store.limited_json import LARGEST, MOST_DEEP, read_json


def nested(levels: int) -> str:
    return "[" * levels + "]" * levels


@pytest.mark.parametrize("value", [{"a": [1, 2.5, None, True, "x"]}, LARGEST, -LARGEST, "", [], 1e300])
def test_json_is_read(value: object) -> None:
    """Assert that ordinary values come back, whole numbers of a seed's length among them."""
    assert read_json(json.dumps(value)) == value


@pytest.mark.parametrize("levels", [MOST_DEEP + 1, 500, 100_000])
def test_deep_json_is_refused(levels: int) -> None:
    """Assert that the depth is limited alike for what Python's stack takes and what it does not."""
    assert read_json(nested(MOST_DEEP)) is not None
    with pytest.raises(ValueError, match="nested in more than"):
        read_json(nested(levels))
    with pytest.raises(ValueError, match="nested in more than"):
        read_json('{"a":' * levels + "1" + "}" * levels)


@pytest.mark.parametrize(
    "text", ["", "{", "NaN", "[Infinity]", str(LARGEST + 1), "9" * 5000, "[1" + "0" * 100_000 + "]"]
)
def test_what_is_no_json_of_ours_is_refused(text: str) -> None:
    """Assert that broken text, numbers that JSON does not have, and those of thousands of digits are refused."""
    with pytest.raises(ValueError):
        read_json(text)
