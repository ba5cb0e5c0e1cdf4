"""Test that what is packed here is what HDF5 reads, and the other way round, and that damage is an error in words."""

import zlib
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.store.hdf5 import chunks
from evetac_cli.store.hdf5.chunks import RowReader, RowWriter, put

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
    reads=st.lists(st.tuples(st.integers(0, 9000), st.integers(0, 9000)), min_size=1, max_size=6),
)
def test_rows_come_back(
    type_: Any,
    row_shape: tuple[int, ...],
    pieces: list[int],
    known: bool,
    reads: list[tuple[int, int]],
) -> None:
    """Assert that rows in pieces of any size are read back as they were, here and by HDF5 itself, from any row on."""
    wanted = numbers(type_, sum(pieces), row_shape)
    with h5py.File("none", "w", driver="core", backing_store=False) as h5:
        writer = RowWriter(h5, "a", type_, row_shape, sum(pieces) if known else None)
        for piece in np.split(wanted, np.cumsum(pieces[:-1])) if pieces else []:
            writer.append(piece)
        writer.close()
        np.testing.assert_array_equal(h5["a"][...], wanted)
        assert h5["a"].dtype == type_
        reader = RowReader(h5["a"].id, h5["a"].dtype)
        for ends in reads:
            start, stop = sorted(min(end, len(wanted)) for end in ends)
            np.testing.assert_array_equal(reader.read(start, stop), wanted[start:stop])


@pytest.mark.parametrize(
    "packed_as",
    [
        {"compression": "gzip", "shuffle": True, "chunks": (100, 4)},
        {"compression": "gzip", "shuffle": True, "chunks": (100, 2)},
        {"compression": "gzip", "chunks": (100, 4)},
        {"compression": "gzip", "shuffle": True, "fletcher32": True, "chunks": (100, 4)},
        {},
    ],
)
def test_other_ways_to_pack_are_left_to_hdf5(packed_as: dict[str, Any]) -> None:
    """Assert that rows are right however another program has packed them, and in the other order of bytes."""
    for type_ in (np.dtype("<f4"), np.dtype(">f4")):
        wanted = numbers(np.float32, 730, (4,)).astype(type_)
        with h5py.File("none", "w", driver="core", backing_store=False) as h5:
            h5.create_dataset("a", data=wanted, **packed_as)
            reader = RowReader(h5["a"].id, h5["a"].dtype)
            for start, stop in ((0, 730), (99, 101), (650, 730), (3, 3)):
                np.testing.assert_array_equal(reader.read(start, stop), wanted[start:stop])


def test_a_chunk_without_its_filter() -> None:
    """Assert that a chunk which a program stored as it was is read so."""
    with h5py.File("none", "w", driver="core", backing_store=False) as h5:
        put(h5, "a", np.arange(CHUNK, dtype=np.int32))
        h5["a"].id.write_direct_chunk((0,), np.arange(CHUNK, dtype=np.int32)[::-1].tobytes(), 0b11)
        np.testing.assert_array_equal(RowReader(h5["a"].id, h5["a"].dtype).read(0, CHUNK), np.arange(CHUNK)[::-1])


@pytest.mark.parametrize("harm", ["cut", "garbage", "checksum", "too much", "too little"])
def test_damage_is_an_error(harm: str) -> None:
    """Assert that a chunk that cannot be unpacked to its size is an OSError, and never other numbers."""
    with h5py.File("none", "w", driver="core", backing_store=False) as h5:
        put(h5, "a", numbers(np.int32, CHUNK, ()))
        packed = h5["a"].id.read_direct_chunk((0,))[1]
        damaged = {
            "cut": packed[: len(packed) // 2],
            "garbage": bytes(100),
            "checksum": packed[:-1] + bytes([packed[-1] ^ 1]),
            "too much": zlib.compress(bytes(1 << 24)),
            "too little": zlib.compress(bytes(100)),
        }[harm]
        h5["a"].id.write_direct_chunk((0,), damaged)
        with pytest.raises(OSError, match="chunk"):
            RowReader(h5["a"].id, h5["a"].dtype).read(0, 10)
