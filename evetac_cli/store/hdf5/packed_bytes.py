"""Checks that the bytes of a dataset are all in its file, and do not unpack to more than they should.

HDF5 invents rows that were never written, loads any filter that a file names, and unpacks a chunk completely, without a
limit.
"""

import importlib
import math
import zlib
from collections.abc import Collection
from contextlib import suppress
from typing import Any, NamedTuple, NoReturn

from h5py import h5d, h5z

from evetac_cli.errors import InputError, missing_extra

# A chunk is unpacked as a whole, and a malicious one unpacks to 1,100 times its size, without a warning by HDF5. For
# chunks by evetac this is at most 1 GB. Larger chunks by other programs are first unpacked here, up to their size.
OUR_CHUNK_BYTES = 1 << 20
MOST_CHUNK_BYTES = 128 << 20

# Numbers of the filters, as registered with the HDF Group.
OUR_FILTERS = frozenset({h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32})
PROPHESEE_FILTER = 0x8ECF
EVENT_FILE_FILTERS = OUR_FILTERS | {
    32000,  # LZF, which h5py brings along
    32001,  # Blosc, of the DSEC data set
    32004,  # LZ4
    32008,  # Bitshuffle
    32015,  # Zstandard
    32026,  # Blosc2
    PROPHESEE_FILTER,
}


class Place(NamedTuple):
    """A dataset of a file: the file, its size, the dataset's name, and the largest size of its chunks."""

    where: str
    size: int
    name: str
    most_chunk_bytes: int


def check_filters(where: str, name: str, recipe: Any, allowed: Collection[int]) -> list[int]:
    """Return the numbers of the filters; InputError unless they are known, different and installed.

    HDF5 would search for other filters on its own.
    """
    used = [recipe.get_filter(i) for i in range(recipe.get_nfilters())]
    for number, _, _, label in used:
        spoken = f"HDF5 filter {number} ({label.decode(errors='replace').split(';')[0] or 'unknown'})"
        if number not in allowed:
            hint = "compress it again with gzip: h5repack -f GZIP=1 IN OUT"
            raise InputError(f"{name} is compressed with an unsupported filter", where=where, found=spoken, hint=hint)
        if not h5z.filter_avail(number):
            with suppress(ImportError):
                importlib.import_module("hdf5plugin")  # registers its filters
        message = f"{name} is compressed with a filter that is not installed here"
        if not h5z.filter_avail(number) and number == PROPHESEE_FILTER:
            raise InputError(message, where=where, found=spoken, hint="convert it with Prophesee's tools")
        if not h5z.filter_avail(number):
            raise missing_extra(message, "convert", where=where, found=spoken)
    if len({number for number, *_ in used}) < len(used):
        _refuse(where, f"{name} is compressed twice with the same filter", "a repeated filter")
    return [number for number, *_ in used]


def check_stored(
    place: Place, item: Any, shape: tuple[int, ...] | None, itemsize: int, recipe: Any, applied: list[int]
) -> int:
    """Return the number of stored bytes; InputError unless every announced row was written, within the file.

    item, recipe: ids of the dataset and of its creation properties. applied: numbers of its filters.
    """
    if shape is None or math.prod(shape) == 0:
        return 0
    if recipe.get_layout() == h5d.CHUNKED:
        return _check_chunks(place, item, shape, itemsize, recipe, applied)
    wanted = math.prod(shape) * itemsize
    stored = int(item.get_storage_size())
    contiguous = recipe.get_layout() == h5d.CONTIGUOUS
    if stored < wanted or (contiguous and (item.get_offset() or place.size) + wanted > place.size):
        _refuse_incomplete(place, shape)
    return stored


def _check_chunks(
    place: Place, item: Any, shape: tuple[int, ...], itemsize: int, recipe: Any, applied: list[int]
) -> int:
    where, size, name, most_bytes = place
    chunk = recipe.get_chunk()
    whole = math.prod(chunk) * itemsize
    if whole > most_bytes:
        _refuse(where, f"the chunks of {name} are too large", f"{whole} bytes, more than {most_bytes}")
    packing = sum(
        1 << i for i, number in enumerate(applied) if number not in (h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32)
    )
    most = whole + whole // 64 + 1024  # incompressible data grow a little
    undone = [i for i in reversed(range(len(applied))) if applied[i] != h5z.FILTER_FLETCHER32]
    gzip = 1 << undone[0] if undone and applied[undone[0]] == h5z.FILTER_DEFLATE else 0
    large: list[tuple[int, ...]] = []
    count, stored, wrong = 0, 0, ""

    def check_one(one: Any) -> None:
        nonlocal count, stored, wrong
        count += 1
        stored += one.size
        packed = packing & ~one.filter_mask
        if one.byte_offset + one.size > size or one.size > most or (not packed and one.size < whole):
            wrong = f"a chunk of {one.size} bytes at byte {one.byte_offset}"
        if gzip & ~one.filter_mask and one.size > OUR_CHUNK_BYTES + OUR_CHUNK_BYTES // 64 + 1024:
            large.append(one.chunk_offset)

    item.chunk_iter(check_one)
    if wrong:
        _refuse(where, f"{name} is damaged", wrong)
    if count < math.prod(-(-rows // long) for rows, long in zip(shape, chunk, strict=True)):
        _refuse_incomplete(place, shape)
    for offset in large:
        _refuse_overfull(where, name, item.read_direct_chunk(offset)[1], whole)
    return stored


def _refuse_overfull(where: str, name: str, packed: bytes, whole: int) -> None:
    """Refuse a gzip chunk that unpacks to more than its size; only one byte more is unpacked to detect this."""
    try:
        size = len(zlib.decompressobj().decompress(packed, whole + 1))
    except zlib.error as error:
        _refuse(where, f"{name} is damaged", str(error))
    if size > whole:
        _refuse(where, f"{name} is damaged", f"a chunk of {len(packed)} bytes that unpacks to more than {whole}")


def _refuse_incomplete(place: Place, shape: tuple[int, ...]) -> None:
    raise InputError(
        f"{place.name} is incomplete",
        where=place.where,
        expected=" x ".join(map(str, shape)) + " values" if len(shape) > 1 else f"{shape[0] if shape else 1} rows",
        found="parts that were never written",
        hint="the program that wrote the file may have been stopped",
    )


def _refuse(where: str, message: str, what: str) -> NoReturn:
    raise InputError(message, where=where, found=what)
