"""Test that what is packed here is what HDF5 reads."""

from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.store.hdf5 import chunks
from evetac_cli.store.hdf5.chunks import RowWriter

CHUNK = 1000
TYPES = [np.uint8, np.uint16, np.int32, np.int64, np.float32, np.float64]


@pytest.fixture(autouse=True)
def short_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make chunks short, so that little data has many."""
    monkeypatch.setattr(chunks, "CHUNK_ROWS", CHUNK)


def numbers(type_: Any, rows: int, row_shape: tuple[int, ...], seed: int = 0) -> Any:
    """Numbers of a type, of which the bytes differ."""
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 200, (rows, *row_shape)) if type_ == np.uint8 else rng.normal(0, 1e4, (rows, *row_shape))
    return np.abs(values).astype(type_)


@settings(max_examples=60, deadline=None)
@given(
    type_=st.sampled_from(TYPES),
    row_shape=st.sampled_from([(), (3,), (2, 2)]),
    pieces=st.lists(st.integers(0, 2500), max_size=5),
    known=st.booleans(),
)
def test_rows_come_back(
    type_: Any,
    row_shape: tuple[int, ...],
    pieces: list[int],
    known: bool,
) -> None:
    """Assert that rows in pieces of any size are read by HDF5 as they were."""
    wanted = numbers(type_, sum(pieces), row_shape)
    with h5py.File("none", "w", driver="core", backing_store=False) as h5:
        writer = RowWriter(h5, "a", type_, row_shape, sum(pieces) if known else None)
        for piece in np.split(wanted, np.cumsum(pieces[:-1])) if pieces else []:
            writer.append(piece)
        writer.close()
        np.testing.assert_array_equal(h5["a"][...], wanted)
        assert h5["a"].dtype == type_
