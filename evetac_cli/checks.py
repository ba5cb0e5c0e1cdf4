"""Range checks for numbers, which raise ValueError with a uniform message.

NAME: expected LOW to HIGH UNIT, found VALUE
"""

import math
import sys
from numbers import Integral

MOST = sys.float_info.max  # the largest finite number


def check_range(
    name: str,
    value: float,
    low: float = 0.0,
    high: float = MOST,
    unit: str = "",
    *,
    above: bool = False,
    below: bool = False,
) -> None:
    """Raise ValueError for NaN and for a number outside a range.

    The range includes both ends; `above` excludes low, `below` excludes high. Without `high`, every finite number
    starting at low is accepted.
    """
    if low < value < high or (value == low and not above) or (value == high and not below):
        return
    after = f" {unit}" if unit else ""
    if high >= MOST:
        expected = f"above {low:g}{after}" if above else f"{low:g}{after} or more"
    elif above:
        expected = f"above {low:g}, {'below' if below else 'up to'} {high:g}{after}"
    else:
        expected = f"{low:g} to {'below ' if below else ''}{high:g}{after}"
    if high == MOST and math.isinf(value):
        expected += ", finite"
    raise ValueError(f"{name}: expected {expected}, found {value}")


def check_whole(name: str, value: int, low: int, high: int, *, step: int = 1) -> None:
    """Raise ValueError unless `value` is a whole number from low to high (both included) and a multiple of `step`."""
    if not isinstance(value, Integral):
        raise ValueError(f"{name}: expected a whole number, found {value!r}")
    check_range(name, value, low, high)
    if value % step:
        raise ValueError(f"{name}: expected {low} to {high} in steps of {step}, found {value}")
