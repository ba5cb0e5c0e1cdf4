"""Columns by their buffers: what pyarrow itself makes of the same values, and back, for every type and gap."""

from typing import Any

import numpy as np
import pytest

from evetac_cli.formats.arrow_columns import is_known, repeated, to_arrow, to_numpy

pyarrow = pytest.importorskip("pyarrow")

TYPES = ("bool", "uint8", "int16", "uint16", "int32", "uint32", "int64", "float32", "float64")


def values_of(type_: str, rows: int) -> Any:
    """Rows of many values of a type, every third a NaN where it has one."""
    values = np.arange(-5, rows - 5).astype(type_)
    if values.dtype.kind == "f":
        values[::3] = np.nan
    return values


@pytest.mark.parametrize("rows", [0, 1, 7, 8, 9, 1000])
@pytest.mark.parametrize("type_", TYPES)
def test_columns_are_those_of_pyarrow(type_: str, rows: int) -> None:
    """Assert that a column, of a table too, holds the same values and the same gaps; NaN is no gap."""
    table = np.stack([values_of(type_, rows), values_of(type_, rows)[::-1]], axis=1)
    gaps = np.arange(rows) % 5 == 2
    for missing in (None, np.zeros(rows, bool), gaps, np.ones(rows, bool)):
        made, expected = to_arrow(pyarrow, table[:, 1], missing), pyarrow.array(table[:, 1], mask=missing)
        made.validate(full=True)
        assert (made.type, made.null_count) == (expected.type, expected.null_count)
        assert str(made.to_pylist()) == str(expected.to_pylist())  # NaN is not equal to itself


@pytest.mark.parametrize("type_", TYPES)
def test_values_come_back(type_: str) -> None:
    """Assert that values of a column, and of any part of it, are those that pyarrow gives; gaps are NaN."""
    values = values_of(type_, 100)
    for missing in (None, np.arange(100) % 7 == 3):
        whole = pyarrow.array(values, mask=missing)
        for part in (whole, whole[3:50], whole[9:9], whole[99:]):
            expected = part if part.null_count == 0 else part.cast("float64")
            np.testing.assert_array_equal(to_numpy(part), expected.to_numpy(zero_copy_only=False))
            assert is_known(part).tolist() == part.is_valid().to_pylist()
            assert part.null_count or to_numpy(part).dtype == values.dtype or not len(part)


def test_a_column_without_a_type_is_all_gaps() -> None:
    """Assert that nothing is known of a column of nulls."""
    nothing = pyarrow.nulls(3)
    assert np.isnan(to_numpy(nothing)).all() and not is_known(nothing).any()
    assert len(to_numpy(pyarrow.nulls(0))) == 0


@pytest.mark.parametrize(
    ("value", "type_"),
    [("slip, ÄÖ", "string"), ("", "string"), (7, "string"), (-3, "int64"), (2**62, "int64"), (True, "bool")]
    + [(None, name) for name in ("string", "int64", "bool")],
)
def test_one_value_in_every_row(value: Any, type_: str) -> None:
    """Assert that a repeated value is what pyarrow repeats, text where the column is of text."""
    kind = pyarrow.type_for_alias(type_)
    made = repeated(pyarrow, value, kind, 5)
    made.validate(full=True)
    wanted = str(value) if type_ == "string" and value is not None else value
    assert made.type == kind and made.to_pylist() == [wanted] * 5
