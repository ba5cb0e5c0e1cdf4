"""Sensors and grippers drawn from ranges, for those who need many: the row `randomized` of sensors.toml.

An entry of that row is a plain value, which all have in common, or a distribution: `{uniform = [low, high]}`,
`{log_uniform = [low, high]}` (uniform in the logarithm), `{whole = [low, high]}` (a whole number, both ends included).

Why so: each entry draws from a stream of its own, named by its key, so that a range added to the table, or moved in it,
leaves all other values as they were.
"""

import math
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from evetac_cli.errors import InputError

FOR_EACH_TRIAL = "randomized"
DISTRIBUTIONS = ("uniform", "log_uniform", "whole")


def draw(ranges: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """A row as of a named sensor, from the row of ranges; InputError on a range that is none.

    `dot_shift_x_px` and `dot_shift_y_px` move the columns and rows of dots and do not appear in the result.
    """
    row = _draw_table(ranges, int(rng.integers(2**63)), "")
    for axis, lines in (("x", "dot_columns_px"), ("y", "dot_rows_px")):
        shift_px = row.pop(f"dot_shift_{axis}_px", 0.0)
        row[lines] = [line + shift_px for line in row[lines]]
    return row


def _draw_table(ranges: Mapping[str, Any], seed: int, above: str) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for key, entry in ranges.items():
        place = f"{above}{key}"
        if not isinstance(entry, Mapping):
            row[key] = entry
        elif len(entry) == 1 and next(iter(entry)) in DISTRIBUTIONS:
            rng = np.random.default_rng([seed, zlib.crc32(place.encode())])
            ((distribution, ends),) = entry.items()
            row[key] = _draw_value(distribution, ends, rng, place)
        else:
            row[key] = _draw_table(entry, seed, f"{place}.")
    return row


def _draw_value(distribution: str, ends: Any, rng: np.random.Generator, place: str) -> float | int:
    low, high = ends if isinstance(ends, list) and len(ends) == 2 else (math.nan, math.nan)
    lowest = 0.0 if distribution == "log_uniform" else -math.inf
    if not lowest < low <= high < math.inf:
        expected = "[low, high]" + (", both above 0" if distribution == "log_uniform" else "")
        raise InputError(f"{place}: not a range", where="sensors.toml", expected=expected, found=str(ends))
    if distribution == "whole":
        return int(rng.integers(int(low), int(high) + 1))
    if distribution == "log_uniform":
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))
    return float(rng.uniform(low, high))
