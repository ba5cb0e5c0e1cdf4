"""Whether the bytes of a dataset all lie in its file, and unpack to no more than they have to.

Why so: HDF5 makes rows of nothing where none were written, loads what a file names as a filter, and unpacks a chunk
whole, whatever it was made to unpack to.
"""

import importlib
import math
import zlib
from collections.abc import Collection
from contextlib import suppress
from typing import Any, NoReturn

from h5py import h5d, h5z

from evetac_cli.errors import InputError, missing_extra

# A chunk is unpacked whole, and one made to harm unpacks to 1,100 times its size, of which HDF5 says nothing.
# Of our own that is 1 GB at most; larger chunks, of other programs, are unpacked here first, as far as they may go.
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


def check_filters(where: str, name: str, recipe: Any, allowed: Collection[int]) -> None:
    """Only filters that are known, each once, and whose plugin is there; HDF5 would look for others on its own."""
    used = [recipe.get_filter(i) for i in range(recipe.get_nfilters())]
    for number, _, _, label in used:
        spoken = f"HDF5 filter {number} ({label.decode(errors='replace').split(';')[0] or 'unknown'})"
        if number not in allowed:
            hint = "pack it anew with gzip: h5repack -f GZIP=1 IN OUT"
            raise InputError(
                f"{name} is compressed with a filter that is not read", where=where, found=spoken, hint=hint
            )
        if not h5z.filter_avail(number):
            with suppress(ImportError):
                importlib.import_module("hdf5plugin")  # registers its filters
        message = f"{name} is compressed with a filter that is not installed here"
        if not h5z.filter_avail(number) and number == PROPHESEE_FILTER:
            raise InputError(message, where=where, found=spoken, hint="convert it with Prophesee's tools")
        if not h5z.filter_avail(number):
            raise missing_extra(message, "convert", where=where, found=spoken)
    if len({number for number, *_ in used}) < len(used):
        _refuse(where, f"{name} is compressed twice with the same filter", "a filter that is named twice")


def check_stored(where: str, size: int, name: str, item: Any, most_chunk_bytes: int) -> int:
    """Bytes that are stored; InputError unless every announced row was written, within a file of this size."""
    shape = item.shape
    if shape is None or math.prod(shape) == 0:
        return 0
    recipe = item.get_create_plist()
    if recipe.get_layout() == h5d.CHUNKED:
        return _check_chunks(where, size, name, item, recipe, most_chunk_bytes)
    wanted = math.prod(shape) * item.get_type().get_size()
    stored = int(item.get_storage_size())
    contiguous = recipe.get_layout() == h5d.CONTIGUOUS
    if stored < wanted or (contiguous and (item.get_offset() or size) + wanted > size):
        _refuse_incomplete(where, name, shape)
    return stored


def _check_chunks(where: str, size: int, name: str, item: Any, recipe: Any, most_bytes: int) -> int:
    chunk, shape = recipe.get_chunk(), item.shape
    whole = math.prod(chunk) * item.get_type().get_size()
    if whole > most_bytes:
        _refuse(where, f"the chunks of {name} are too large", f"{whole} bytes, more than {most_bytes}")
    applied = [recipe.get_filter(i)[0] for i in range(recipe.get_nfilters())]
    packing = sum(
        1 << i for i, number in enumerate(applied) if number not in (h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32)
    )
    most = whole + whole // 64 + 1024  # what cannot be packed grows a little
    undone = [i for i in reversed(range(len(applied))) if applied[i] != h5z.FILTER_FLETCHER32]
    gzip = 1 << undone[0] if undone and applied[undone[0]] == h5z.FILTER_DEFLATE else 0
    large: list[tuple[int, ...]] = []
    count, stored, wrong = 0, 0, ""

    def check_place(place: Any) -> None:
        nonlocal count, stored, wrong
        count += 1
        stored += place.size
        packed = packing & ~place.filter_mask
        if place.byte_offset + place.size > size or place.size > most or (not packed and place.size < whole):
            wrong = f"a chunk of {place.size} bytes at byte {place.byte_offset}"
        if gzip & ~place.filter_mask and place.size > OUR_CHUNK_BYTES + OUR_CHUNK_BYTES // 64 + 1024:
            large.append(place.chunk_offset)

    item.chunk_iter(check_place)
    if wrong:
        _refuse(where, f"{name} is damaged", wrong)
    if count < math.prod(-(-rows // long) for rows, long in zip(shape, chunk, strict=True)):
        _refuse_incomplete(where, name, shape)
    for place in large:
        _refuse_overfull(where, name, item.read_direct_chunk(place)[1], whole)
    return stored


def _refuse_overfull(where: str, name: str, packed: bytes, whole: int) -> None:
    """Refuse a gzip chunk that unpacks to more than it has to hold; no more than that is unpacked to see it."""
    try:
        size = len(zlib.decompressobj().decompress(packed, whole + 1))
    except zlib.error as error:
        _refuse(where, f"{name} is damaged", str(error))
    if size > whole:
        _refuse(where, f"{name} is damaged", f"a chunk of {len(packed)} bytes that unpacks to more than {whole}")


def _refuse_incomplete(where: str, name: str, shape: tuple[int, ...]) -> None:
    raise InputError(
        f"{name} is incomplete",
        where=where,
        expected=" x ".join(map(str, shape)) + " values" if len(shape) > 1 else f"{shape[0] if shape else 1} rows",
        found="parts that were never written",
        hint="the program that wrote the file may have been stopped",
    )


def _refuse(where: str, message: str, what: str) -> NoReturn:
    raise InputError(message, where=where, found=what)
