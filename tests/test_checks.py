"""The checks of numbers: which are refused, and in which words."""

import math

import numpy as np
import pytest

from evetac_cli.checks import check_range, check_whole


@pytest.mark.parametrize(
    ("value", "ends", "words"),
    [
        (-0.1, {}, "0 or more, found -0.1"),
        (math.inf, {}, "0 or more, finite, found inf"),
        (math.nan, {}, "0 or more, found nan"),
        (0.0, {"above": True}, "above 0, found 0.0"),
        (101.0, {"high": 100, "unit": "ticks"}, "0 to 100 ticks, found 101.0"),
        (1.0, {"high": 1.0, "below": True}, "0 to below 1, found 1.0"),
        (0.0, {"high": 1.0, "above": True}, "above 0, up to 1, found 0.0"),
        (1.0, {"high": 1.0, "above": True, "below": True}, "above 0, below 1, found 1.0"),
    ],
)
def test_a_number_out_of_range_is_refused(value: float, ends: dict[str, float], words: str) -> None:
    """Assert that ends belong to a range unless said, and that the error names range and number."""
    with pytest.raises(ValueError, match=f"^share: expected {words}$"):
        check_range("share", value, **ends)  # type: ignore[arg-type]


def test_ends_belong_to_a_range() -> None:
    """Assert that both ends are in the range, and infinity where it is named as the end."""
    for value in (0.0, 1.0):
        check_range("share", value, 0.0, 1.0)
    check_range("at_s", math.inf, 0.0, math.inf)


def test_whole_numbers() -> None:
    """Assert that numpy's integers are whole numbers, that a float is none, and that steps are kept."""
    check_whole("count", np.int64(3), 0, 3)
    for value, words in ((3.0, "a whole number, found 3.0"), (4, "0 to 3, found 4")):
        with pytest.raises(ValueError, match=f"count: expected {words}"):
            check_whole("count", value, 0, 3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="0 to 508 in steps of 2, found 3"):
        check_whole("delay_us", 3, 0, 508, step=2)
