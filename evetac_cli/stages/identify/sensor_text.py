"""The text of a sensor's TOML file: the estimated keys, each with its interval and source, and notes on the others."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.kernels.estimates import Estimate
from evetac_cli.store.layout.provenance import Recipe

DIGITS = 6  # of an estimate: no recording is more precise
LINE = 110
NOT_ESTIMATED = "bandwidth and leak are not estimated"


class EstimateRow(NamedTuple):
    """A row of the table: a parameter, its estimate and source, or the recording needed to estimate it."""

    parameter: str
    unit: str
    estimate: Estimate | None
    source: str


class Entry(NamedTuple):
    """The value of a key, its interval if it has one, and its source; the value may be a table of entries."""

    value: Any
    estimate: Estimate | None
    source: str


def sensor_text(name: str, like: str, values: Mapping[str, Entry], recipe: Recipe, files: Sequence[str]) -> str:
    """Return the file's text; `values` by key, where the value of a table is its columns."""
    lines = [
        "# A sensor estimated from these recordings, with 95 % intervals.",
        f"# recipe {recipe.id}",
        f"# from {_in_a_comment(', '.join(files))}{' (simulated)' if recipe.simulated else ''}",
        f'name = "{name}"',
        f'like = "{like}"  # source of all keys that are not below; {NOT_ESTIMATED}',
        'summary = "estimated from recordings by evetac identify"',
        "",
    ]
    plain = {key: one for key, one in values.items() if not isinstance(one.value, Mapping)}
    for key, one in plain.items():
        lines += _commented(key, one)
    if not values:
        lines.append(f"# Nothing could be estimated from these recordings: all values are those of {like}.")
    for key, one in values.items():
        if isinstance(one.value, Mapping):
            lines += ["", f"[{key}]", f"# {_in_a_comment(one.source)}"]
            for column, value in one.value.items():
                lines += (
                    _commented(column, value) if isinstance(value, Entry) else [f"{column} = {_value(value, column)}"]
                )
    return "\n".join(lines) + "\n"


def _commented(key: str, one: Entry) -> list[str]:
    """Return the lines of a key, with its interval and source above it."""
    interval = "" if one.estimate is None else f"{_number(one.estimate.low)} to {_number(one.estimate.high)}; "
    return [f"# {interval}{_in_a_comment(one.source)}", f"{key} = {_value(one.value)}"]


def _in_a_comment(text: str) -> str:
    """Return a text for a comment: it must be one line, and TOML allows no control characters in it."""
    return "".join(sign if sign.isprintable() else "?" for sign in text)


def _value(value: Any, column: str = "") -> str:
    if isinstance(value, np.ndarray) and value.ndim > 1:
        return "[\n" + "".join(f"    {_row(row)},\n" for row in value) + "]"
    if isinstance(value, np.ndarray):
        # a share of changes must not be rounded above what the share of ON allows
        round_down = column == "polarity_change_share"
        items = ", ".join(_number(item, round_down=round_down) for item in value.tolist())
        indent: dict[str, Any] = {"initial_indent": "    ", "subsequent_indent": "    ", "break_on_hyphens": False}
        return f"[\n{textwrap.fill(f'{items},', LINE, **indent)}\n]"
    return _number(value)


def _row(row: Any) -> str:
    return "[" + ", ".join(_row(item) if np.ndim(item) else _number(float(item)) for item in row) + "]"


def _number(value: float | int, *, round_down: bool = False) -> str:
    if isinstance(value, (int, np.integer)):
        return str(int(value))
    if round_down:
        return f"{math.floor(value * 1e4) / 1e4:.4f}"
    rounded = float(f"{value:.{DIGITS}g}")
    return repr(rounded)
