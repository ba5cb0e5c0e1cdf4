"""The one door to HDF5 files, ours and other people's: whatever is read has been checked here first.

Why so: HDF5 may lead into any other file of the machine (links, external storage, virtual datasets), makes rows of
nothing where none were written, and takes the memory that a file announces, not what it holds. So a file is refused
when it is opened, in words, if it holds anything that leads elsewhere, or announces more than its own bytes can fill.
Other people's files may hold what we do not read; of their datasets only those that are asked for are checked.
"""

import importlib
import math
import os
import shlex
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn, Self

import h5py
import numpy as np
from h5py import h5a, h5d, h5g, h5l, h5o, h5s, h5t, h5z

from evetac_cli.errors import PASSING, InputError, UnavailableError, cannot_read, missing_extra
from evetac_cli.store.hdf5.hdf5_text import TextTooLong, attribute_text, dataset_text

# Deflate makes at most 1,032 bytes of one (zlib's technical notes), and no part of a file is stored twice.
MOST_EXPANSION = 1100
# A chunk is unpacked whole, and one made to harm unpacks to MOST_EXPANSION times its size, of which HDF5 says nothing.
# Of our own that is 1 GB at most; larger chunks, of other programs, are unpacked here first, as far as they may go.
OUR_CHUNK_BYTES = 1 << 20
MOST_CHUNK_BYTES = 128 << 20
MOST_READ_BYTES = 4 << 30  # of one dataset at a time; what is longer is read in blocks
MOST_TEXT_BYTES = 32 << 20  # of one text: a header that tells of 10,000 ancestors has half of it
MOST_OBJECTS = 10_000  # datasets and groups; our own files have some dozens
MOST_GROUPS_DEEP = 16
MOST_ATTRIBUTES = 1000  # of one object
MOST_ATTRIBUTE_BYTES = 1 << 20
ITSELF = "data in the file itself"
DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError)  # what h5py raises on damaged bytes

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
DIMENSION_ONLY = b"This is a netCDF dimension but not a netCDF variable"


class CheckedHdf5:
    """An HDF5 file, open for reading, of which only what was checked is handed out."""

    def __init__(self, path: Path, expected: str = "an HDF5 file", hint: str = "") -> None:
        """Open a regular file; InputError if it is none, or no HDF5, UnavailableError if it cannot be looked at now.

        hint: what to do with a file that is no HDF5.
        """
        self.path, self.where = path, str(path)
        self.dimensions: dict[str, int] = {}  # length of each by its path, once `datasets` has been asked
        _refuse_irregular(path, expected)
        try:
            self.size = os.stat(path).st_size
            self.h5 = h5py.File(path, "r")
        except OSError as error:
            if error.errno in PASSING:
                raise cannot_read(error, path) from None
            if "already open for write" in str(error):
                # A mark in the file, not a lock: the program that set it may have been killed.
                hint = f"close it there; if no program writes it: h5clear -s {shlex.quote(self.where)}"
                message = "marked as open for writing by another program"
                raise UnavailableError(message, where=self.where, hint=hint) from None
            reason = "it is truncated" if "truncated" in str(error) else "it is not an HDF5 file"
            raise InputError(f"cannot be opened: {reason}", where=self.where, expected=expected, hint=hint) from None
        except DAMAGE as error:
            raise InputError(f"cannot be opened: {error}", where=self.where, expected=expected, hint=hint) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file, and with it all datasets that were handed out."""
        self.h5.close()

    def text_attribute(self, name: str) -> str | None:
        """A text among the attributes of the root; None if there is no such text."""
        with damage_in_words(self.path, f"its {name}"):
            if not h5a.exists(self.h5.id, name.encode()):
                return None
            attribute = h5a.open(self.h5.id, name.encode())
            kind = attribute.get_type()
            if kind.get_class() != h5t.STRING or attribute.shape != () or not kind.is_variable_str():
                return None
            address = h5o.get_info(self.h5["/"].id).addr
            return self._text(f"its {name}", lambda most: attribute_text(self.path, address, name, most))

    def text(self, name: str, dataset: h5py.Dataset) -> str:
        """The one text that a dataset holds; `name` is what an error calls it."""
        with damage_in_words(self.path, name):
            if h5py.check_string_dtype(dataset.dtype).length is not None:
                return str(dataset.asstr()[()])
            address = dataset.id.get_offset()
            return self._text(name, lambda most: dataset_text(self.path, address, most))

    def _text(self, name: str, read: Callable[[int], str]) -> str:
        """Read a text, which cannot be longer than the file that holds it."""
        most = min(MOST_TEXT_BYTES, self.size)
        try:
            return read(most)
        except TextTooLong as error:
            raise InputError(
                f"{name} announces a text longer than it can be",
                where=self.where,
                expected=f"at most {most} bytes",
                found=str(error),
                hint="the file is damaged; make it again",
            ) from None

    def number_attribute(self, name: str, of: str = "/") -> int | None:
        """A whole number among the attributes of an object; None if there is no such number."""
        with damage_in_words(self.path, f"{name} of {of}"):
            item = self.h5[of].id
            if not h5a.exists(item, name.encode()):
                return None
            attribute = h5a.open(item, name.encode())
            if attribute.get_type().get_class() != h5t.INTEGER or attribute.shape != ():
                return None
            return int(self.h5[of].attrs[name])

    def datasets(
        self, only: Collection[str] | None = None, filters: Collection[int] = OUR_FILTERS
    ) -> dict[str, h5py.Dataset]:
        """Every dataset by its path, checked, or `only` those of these paths; InputError names what may not be.

        Nothing may lead elsewhere, in any part of the file. Dimensions, which hold no numbers, are left out; their
        lengths are in `dimensions`.
        With `only`, a path may be missing, or be a group.
        """
        checked: dict[str, h5py.Dataset] = {}
        announced = stored = 0
        with damage_in_words(self.path, "its contents"):
            for name, item in self._objects():
                if only is None:
                    self._check_attributes(name, item)
                if isinstance(item, h5g.GroupID):
                    continue
                recipe = item.get_create_plist()
                self._refuse_elsewhere(name, recipe)
                if _is_dimension_only(item):
                    self.dimensions[name] = item.shape[0]
                    continue
                if only is not None and name not in only:
                    continue
                self._check_filters(name, recipe, filters)
                here = self._check_kind(name, item, any_kind=only is not None)
                announced += here
                stored += self._check_stored(name, item, recipe, OUR_CHUNK_BYTES if only is None else MOST_CHUNK_BYTES)
                if announced > MOST_EXPANSION * self.size or stored > self.size:
                    self._refuse(f"{name} announces more than the file can hold", f"{announced} bytes")
                checked[name] = h5py.Dataset(item)
        return dict(sorted(checked.items()))

    def lengths(self) -> dict[str, int]:
        """The rows of every dataset by its path; 1 for a single value. Nothing in them is looked at."""
        with damage_in_words(self.path, "its contents"):
            shapes = {name: item.shape for name, item in self._objects() if not isinstance(item, h5g.GroupID)}
        return {name: int(shape[0]) if shape else 1 for name, shape in shapes.items()}

    def _objects(self) -> Iterator[tuple[str, Any]]:
        """Path and id of every object; InputError where a name leads anywhere but to an object of its own."""
        root = self.h5["/"].id
        yield "/", root
        seen = {h5o.get_info(root).addr}
        groups = [("", root)]
        while groups:
            prefix, group = groups.pop()
            if len(seen) + group.get_num_objs() > MOST_OBJECTS:
                self._refuse("holds too many datasets and groups", f"more than {MOST_OBJECTS}")
            for raw in list(group):
                name = prefix + raw.decode(errors="backslashreplace")
                if group.links.get_info(raw).type != h5l.TYPE_HARD:
                    raise InputError(f"`{name}` is a link", where=self.where, expected=ITSELF)
                item = h5o.open(group, raw)
                address = h5o.get_info(item).addr
                if address in seen:
                    self._refuse(f"`{name}` is a second name of something else in the file", "one object, two names")
                seen.add(address)
                if isinstance(item, h5g.GroupID):
                    if name.count("/") >= MOST_GROUPS_DEEP:
                        self._refuse("its groups lie too deep in one another", f"more than {MOST_GROUPS_DEEP} levels")
                    groups.append((f"{name}/", item))
                elif not isinstance(item, h5d.DatasetID):
                    self._refuse(f"`{name}` is neither a dataset nor a group", "a named type")
                yield name, item

    def _check_attributes(self, name: str, item: Any) -> None:
        """Refuse more attributes than anybody would read."""
        count = h5a.get_num_attrs(item)
        if count > MOST_ATTRIBUTES:
            self._refuse(f"{name} has too many attributes", f"{count}, more than {MOST_ATTRIBUTES}")
        for index in range(count):
            size = h5a.open(item, index=index).get_storage_size()
            if size > MOST_ATTRIBUTE_BYTES:
                self._refuse(f"an attribute of {name} is too large", f"{size} bytes, more than {MOST_ATTRIBUTE_BYTES}")

    def _refuse_elsewhere(self, name: str, recipe: Any) -> None:
        if recipe.get_external_count() or recipe.get_layout() == h5d.VIRTUAL:
            raise InputError(f"{name} lies in another file", where=self.where, expected=ITSELF)

    def _check_filters(self, name: str, recipe: Any, allowed: Collection[int]) -> None:
        """Only filters that are known, each once, and whose plugin is there; HDF5 would look for others on its own."""
        used = [recipe.get_filter(i) for i in range(recipe.get_nfilters())]
        for number, _, _, label in used:
            spoken = f"HDF5 filter {number} ({label.decode(errors='replace').split(';')[0] or 'unknown'})"
            if number not in allowed:
                hint = "pack it anew with gzip: h5repack -f GZIP=1 IN OUT"
                raise InputError(
                    f"{name} is compressed with a filter that is not read", where=self.where, found=spoken, hint=hint
                )
            if not h5z.filter_avail(number):
                with suppress(ImportError):
                    importlib.import_module("hdf5plugin")  # registers its filters
            message = f"{name} is compressed with a filter that is not installed here"
            if not h5z.filter_avail(number) and number == PROPHESEE_FILTER:
                raise InputError(message, where=self.where, found=spoken, hint="convert it with Prophesee's tools")
            if not h5z.filter_avail(number):
                raise missing_extra(message, "convert", where=self.where, found=spoken)
        if len({number for number, *_ in used}) < len(used):
            self._refuse(f"{name} is compressed twice with the same filter", "a filter that is named twice")

    def _check_kind(self, name: str, item: Any, *, any_kind: bool) -> int:
        """Bytes that a dataset announces; InputError unless it holds plain numbers or one text, or `any_kind`."""
        kind, shape = item.get_type(), item.shape
        if item.get_space().get_simple_extent_type() == h5s.NULL:
            return 0
        if not any_kind:
            text = kind.get_class() == h5t.STRING
            if not text and kind.get_class() not in (h5t.INTEGER, h5t.FLOAT):
                held = h5py.Dataset(item).dtype
                raise InputError(
                    f"{name} is of a kind that is not read",
                    where=self.where,
                    expected="plain numbers, or one text",
                    found=str(held)[:200],
                )
            if text and kind.is_variable_str():
                if shape != () or item.get_offset() is None:
                    self._refuse(f"{name} is of a kind that is not read", "a list of texts")
                self.text(name, h5py.Dataset(item))
        # A row without columns takes no byte, but is a row to go through: it counts as if it had one.
        return int(math.prod(max(1, size) for size in shape) * kind.get_size())

    def _check_stored(self, name: str, item: Any, recipe: Any, most_chunk_bytes: int) -> int:
        """Bytes that are stored; InputError unless every announced row was written, within this file."""
        if item.get_space().get_simple_extent_type() == h5s.NULL or math.prod(item.shape) == 0:
            return 0
        wanted = math.prod(item.shape) * item.get_type().get_size()
        if recipe.get_layout() == h5d.CHUNKED:
            return self._check_chunks(name, item, recipe, most_chunk_bytes)
        stored = int(item.get_storage_size())
        contiguous = recipe.get_layout() == h5d.CONTIGUOUS
        if stored < wanted or (contiguous and (item.get_offset() or self.size) + wanted > self.size):
            self._refuse_incomplete(name, item.shape)
        return stored

    def _check_chunks(self, name: str, item: Any, recipe: Any, most_bytes: int) -> int:
        chunk = recipe.get_chunk()
        whole = math.prod(chunk) * item.get_type().get_size()
        if whole > most_bytes:
            self._refuse(f"the chunks of {name} are too large", f"{whole} bytes, more than {most_bytes}")
        if item.get_num_chunks() < math.prod(-(-rows // size) for rows, size in zip(item.shape, chunk, strict=True)):
            self._refuse_incomplete(name, item.shape)
        applied = [recipe.get_filter(i)[0] for i in range(recipe.get_nfilters())]
        packing = sum(
            1 << i for i, number in enumerate(applied) if number not in (h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32)
        )
        most = whole + whole // 64 + 1024  # what cannot be packed grows a little
        undone = [i for i in reversed(range(len(applied))) if applied[i] != h5z.FILTER_FLETCHER32]
        gzip = 1 << undone[0] if undone and applied[undone[0]] == h5z.FILTER_DEFLATE else 0
        large: list[tuple[int, ...]] = []
        stored, wrong = 0, ""

        def check_place(place: Any) -> None:
            nonlocal stored, wrong
            stored += place.size
            packed = packing & ~place.filter_mask
            if place.byte_offset + place.size > self.size or place.size > most or (not packed and place.size < whole):
                wrong = f"a chunk of {place.size} bytes at byte {place.byte_offset}"
            if gzip & ~place.filter_mask and place.size > OUR_CHUNK_BYTES + OUR_CHUNK_BYTES // 64 + 1024:
                large.append(place.chunk_offset)

        item.chunk_iter(check_place)
        if wrong:
            self._refuse(f"{name} is damaged", wrong)
        for place in large:
            self._refuse_overfull(name, item.read_direct_chunk(place)[1], whole)
        return stored

    def _refuse_overfull(self, name: str, packed: bytes, whole: int) -> None:
        """Refuse a gzip chunk that unpacks to more than it has to hold; no more than that is unpacked to see it."""
        try:
            size = len(zlib.decompressobj().decompress(packed, whole + 1))
        except zlib.error as error:
            self._refuse(f"{name} is damaged", str(error))
        if size > whole:
            self._refuse(f"{name} is damaged", f"a chunk of {len(packed)} bytes that unpacks to more than {whole}")

    def _refuse_incomplete(self, name: str, shape: tuple[int, ...]) -> None:
        raise InputError(
            f"{name} is incomplete",
            where=self.where,
            expected=" x ".join(map(str, shape)) + " values" if len(shape) > 1 else f"{shape[0] if shape else 1} rows",
            found="parts that were never written",
            hint="the program that wrote the file may have been stopped",
        )

    def _refuse(self, message: str, what: str) -> NoReturn:
        raise InputError(message, where=self.where, found=what)


def row_blocks(dataset: h5py.Dataset, most_bytes: int = 4 << 20) -> Iterator[Any]:
    """The rows of a dataset, in blocks of about so many bytes, so that its length costs no memory."""
    row_bytes = max(1, math.prod(dataset.shape[1:]) * dataset.dtype.itemsize)
    step = max(1, most_bytes // row_bytes)
    for start in range(0, max(1, len(dataset)), step):  # one empty block, where there are no rows
        yield dataset[start : start + step]


@contextmanager
def damage_in_words(path: Path, what: str) -> Iterator[None]:
    """Damaged bytes in a file make h5py raise nearly anything; say which file and what could not be read."""
    try:
        yield
    except DAMAGE as error:
        if isinstance(error, OSError) and error.errno in PASSING:
            raise cannot_read(error, path) from None
        reason = (str(error).strip("'\"").splitlines() or [type(error).__name__])[0][:200]
        raise InputError(
            f"{what} cannot be read: {reason}", where=str(path), hint="the file is damaged; make it again"
        ) from None


def _refuse_irregular(path: Path, expected: str) -> None:
    checks: tuple[tuple[Callable[[Path], bool], str], ...] = (
        (os.path.isdir, "this is a folder"),
        (lambda path: not os.path.exists(path), "no such file"),  # unlike Path.exists, also for a name too long
        (lambda path: not os.path.isfile(path), "this is not a regular file"),  # opening a pipe waits for a writer
    )
    for is_so, words in checks:
        if is_so(path):
            raise InputError(words, where=str(path), expected="" if words == "no such file" else expected)


def _is_dimension_only(item: Any) -> bool:
    """Whether a dataset only names a dimension, as netCDF writes them: a length, and no number was ever stored."""
    if len(item.shape or ()) != 1 or item.get_storage_size():
        return False
    return _short_text(item, b"CLASS") == b"DIMENSION_SCALE" and _short_text(item, b"NAME").startswith(DIMENSION_ONLY)


def _short_text(item: Any, name: bytes) -> bytes:
    """An attribute that is a text of fixed length; nothing if it is anything else."""
    if not h5a.exists(item, name):
        return b""
    attribute = h5a.open(item, name)
    kind = attribute.get_type()
    if kind.get_class() != h5t.STRING or kind.is_variable_str() or attribute.shape != () or kind.get_size() > 256:
        return b""
    value = np.empty((), f"S{kind.get_size()}")
    attribute.read(value)
    return bytes(value[()])
