"""Checked access to HDF5 files, evetac's and others: all data are checked here before they are read.

HDF5 files may refer to any other file on the computer (links, external storage, virtual datasets). HDF5 also invents
rows that were never written, and allocates the memory that a file announces, not what it contains. So a file is refused
with an error message if it refers to other files, or announces more data than its bytes can contain. This is checked
for the whole file when it is opened (`survey`). The location and compression of a dataset's bytes are checked before it
is first read (`check`), because most callers read only a few of dozens of datasets.
Files of other programs may have contents that evetac does not read; only the requested datasets are checked.
"""

import math
import os
import shlex
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, Self

import h5py
import numpy as np
from h5py import h5, h5a, h5d, h5g, h5l, h5o, h5t

from evetac_cli.errors import PASSING, InputError, UnavailableError, cannot_read
from evetac_cli.store.hdf5.hdf5_text import TextTooLong, attribute_text, dataset_text
from evetac_cli.store.hdf5.packed_bytes import (
    MOST_CHUNK_BYTES,
    OUR_CHUNK_BYTES,
    OUR_FILTERS,
    Place,
    check_filters,
    check_stored,
)

# Deflate expands one byte to at most 1,032 (zlib's technical notes), and no part of a file is stored twice.
MOST_EXPANSION = 1100
MOST_READ_BYTES = 4 << 30  # of one dataset at a time; longer ones are read in blocks
MOST_TEXT_BYTES = 32 << 20  # of one text; a header with 10,000 ancestors has half of this
MOST_OBJECTS = 10_000  # datasets and groups; evetac's files have some dozens
MOST_GROUPS_DEEP = 16
MOST_ATTRIBUTES = 1000  # of one object
MOST_ATTRIBUTE_BYTES = 1 << 20
ITSELF = "data in the file itself"
DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError)  # what h5py raises on damaged bytes

ANY = np.dtype("V1")  # placeholder for a dtype that is not needed
DIMENSION_ONLY = b"This is a netCDF dimension but not a netCDF variable"


class StoredDataset(NamedTuple):
    """A dataset of a file; its shape is None if it has no value, `itemsize` is the size of a value in bytes."""

    id: h5d.DatasetID
    shape: tuple[int, ...] | None
    itemsize: int
    dtype: np.dtype[Any]
    is_text: bool

    @property
    def announced_bytes(self) -> int:
        """Bytes that the dataset announces; a row without columns counts as one value, since rows cost time."""
        return 0 if self.shape is None else math.prod(max(1, size) for size in self.shape) * self.itemsize


class CheckedHdf5:
    """An HDF5 file, open for reading, which returns only checked data."""

    def __init__(self, path: Path, expected: str = "an HDF5 file", hint: str = "") -> None:
        """Open a regular file; InputError if it is not one or not HDF5, UnavailableError if it cannot be read now.

        hint: what to do with a file that is not HDF5.
        """
        self.path, self.where = path, str(path)
        self.dimensions: dict[str, int] = {}  # length of each by its path, once the datasets have been requested
        self._checked: set[str] = set()
        self._left: dict[bytes, str] = {}  # objects that were not checked
        self._announced = self._stored = 0  # bytes of the checked datasets
        _refuse_irregular(path, expected)
        try:
            self.size = os.stat(path).st_size
            self.h5 = h5py.File(path, "r")
        except OSError as error:
            if error.errno in PASSING:
                raise cannot_read(error, path) from None
            if "already open for write" in str(error):
                # A mark in the file, not a lock: the program that set it may have been killed.
                hint = f"close it there; if no program is writing it: h5clear -s {shlex.quote(self.where)}"
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
        """Close the file, and with it all datasets that were returned."""
        self.h5.close()

    def text_attribute(self, name: str) -> str | None:
        """Return a text attribute of the root; None if there is none of this name."""
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
        """Return the text of a dataset; `name` is used in error messages."""
        with damage_in_words(self.path, name):
            if h5py.check_string_dtype(dataset.dtype).length is not None:
                return str(dataset.asstr()[()])
            address = dataset.id.get_offset()
            return self._text(name, lambda most: dataset_text(self.path, address, most))

    def _text(self, name: str, read: Callable[[int], str]) -> str:
        """Read a text, which cannot be longer than its file."""
        most = min(MOST_TEXT_BYTES, self.size)
        try:
            return read(most)
        except TextTooLong as error:
            raise InputError(
                f"{name} announces an impossibly long text",
                where=self.where,
                expected=f"at most {most} bytes",
                found=str(error),
                hint="the file is damaged; make it again",
            ) from None

    def number_attribute(self, name: str, of: str = "/") -> int | None:
        """Return a whole-number attribute of an object; None if there is none of this name."""
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
        """Return every dataset by its path, checked, or `only` those of these paths; InputError for invalid contents.

        No part of the file may refer to other files. With `only`, a path may be missing or be a group.
        """
        if only is None:
            found = self.survey()
        else:
            ids = self._found(only)
            found = {
                name: StoredDataset(item, item.shape, item.get_type().get_size(), ANY, False)
                for name, item in ids.items()
            }
        for name, one in found.items():
            self.check(name, one, filters, any_kind=only is not None)
        return {name: h5py.Dataset(one.id) for name, one in found.items()}

    def survey(self, is_left: Callable[[str], bool] = lambda path: False) -> dict[str, StoredDataset]:
        """Return every dataset by its path, whose bytes `check` has yet to check; InputError for invalid contents.

        Nothing may refer to other files. Each dataset has plain numbers or one text, and together they announce no more
        than the file can contain. Dimensions, which have no numbers, are left out; their lengths are in `dimensions`.
        is_left: whether the object at a path is checked only by `check_left`, because it is never read.
        """
        found: dict[str, StoredDataset] = {}
        with damage_in_words(self.path, "its contents"):
            for name, item in self._found(None, is_left).items():
                kind, shape = item.get_type(), item.shape
                self._check_kind(name, item, kind, shape)
                is_text = shape is not None and kind.get_class() == h5t.STRING
                found[name] = StoredDataset(item, shape, kind.get_size(), kind.dtype, is_text)
            announced = sum(one.announced_bytes for one in found.values())
            if announced > MOST_EXPANSION * self.size:
                for name, one in found.items():  # to raise a more precise error if possible
                    self.check(name, one)
                self._refuse("its datasets announce more than the file can contain", f"{announced} bytes")
        return found

    def check(
        self, name: str, one: StoredDataset, filters: Collection[int] = OUR_FILTERS, *, any_kind: bool = False
    ) -> None:
        """Refuse a dataset whose bytes are not all in this file, or whose compression is not supported.

        Together, the checked datasets must not have more data than the file can contain.
        """
        if name in self._checked:
            return
        with damage_in_words(self.path, name):
            if not any_kind:
                self._check_attributes(name, one.id)
            recipe = one.id.get_create_plist()
            applied = check_filters(self.where, name, recipe, filters)
            if one.is_text:
                self.text(name, h5py.Dataset(one.id))
            most = MOST_CHUNK_BYTES if any_kind else OUR_CHUNK_BYTES
            at = Place(self.where, self.size, name, most)
            stored = self._stored + check_stored(at, one.id, one.shape, one.itemsize, recipe, applied)
            announced = self._announced + one.announced_bytes
            if announced > MOST_EXPANSION * self.size or stored > self.size:
                self._refuse(f"{name} announces more than the file can contain", f"{announced} bytes")
        self._announced, self._stored = announced, stored
        self._checked.add(name)

    def check_left(self) -> list[str]:
        """Check the objects that `survey` left; return the paths of those that are datasets and not dimensions."""
        left, self._left = self._left, {}
        with damage_in_words(self.path, "its contents"):
            return [name for name, item in self._opened(left) if self._is_dataset(name, item)]

    def _found(
        self, only: Collection[str] | None, is_left: Callable[[str], bool] = lambda path: False
    ) -> dict[str, h5d.DatasetID]:
        """Return the requested datasets, in the order of their paths; InputError if anything refers to other files."""
        found: dict[str, h5d.DatasetID] = {}
        with damage_in_words(self.path, "its contents"):
            for name, item in self._objects(is_left):
                if only is None and isinstance(item, h5g.GroupID):
                    self._check_attributes(name, item)
                elif self._is_dataset(name, item) and (only is None or name in only):
                    found[name] = item
        return dict(sorted(found.items()))

    def _is_dataset(self, name: str, item: Any) -> bool:
        """Whether an object is a dataset; dimensions are recorded. InputError if it refers to another file."""
        if isinstance(item, h5g.GroupID):
            return False
        if item.get_offset() is None:  # otherwise its bytes are in this file, contiguous
            self._refuse_elsewhere(name, item.get_create_plist())
        if _is_dimension_only(item):
            self.dimensions[name] = item.shape[0]
            return False
        return True

    def lengths(self) -> dict[str, int]:
        """Return the number of rows of every dataset by its path, 1 for a single value, without reading any."""
        with damage_in_words(self.path, "its contents"):
            shapes = {name: item.shape for name, item in self._objects() if not isinstance(item, h5g.GroupID)}
        return {name: int(shape[0]) if shape else 1 for name, shape in shapes.items()}

    def _objects(self, is_left: Callable[[str], bool] = lambda path: False) -> Iterator[tuple[str, Any]]:
        """Yield path and id of every object; InputError for a link, or for a second name of an object.

        is_left: whether the object at a path is not opened.
        """
        root = self.h5["/"].id
        yield "/", root
        seen = {h5o.get_info(root).addr}
        names: dict[bytes, str] = {}

        def fault(raw: bytes, link: Any) -> InputError | None:
            name = raw.decode(errors="backslashreplace")
            if len(seen) >= MOST_OBJECTS:
                return self._fault("has too many datasets and groups", f"more than {MOST_OBJECTS}")
            if link.type != h5l.TYPE_HARD:
                return InputError(f"`{name}` is a link", where=self.where, expected=ITSELF)
            if link.u in seen or raw in names:  # also a name that contains a slash
                message = f"`{name}` is a hard link to another object in the file"
                return self._fault(message, "one object with two names")
            if name.count("/") > MOST_GROUPS_DEEP:
                return self._fault("its groups are nested too deeply", f"more than {MOST_GROUPS_DEEP} levels")
            seen.add(link.u)
            names[raw] = name
            return None

        found = root.links.visit(fault, info=True, order=h5.ITER_NATIVE)  # it would lose a raised exception
        if found is not None:
            raise found
        self._left = {raw: name for raw, name in names.items() if is_left(name)}
        yield from self._opened({raw: name for raw, name in names.items() if raw not in self._left})

    def _opened(self, names: Mapping[bytes, str]) -> Iterator[tuple[str, Any]]:
        root = self.h5["/"].id
        for raw, name in names.items():
            item = h5o.open(root, raw)
            if not isinstance(item, (h5g.GroupID, h5d.DatasetID)):
                self._refuse(f"`{name}` is neither a dataset nor a group", "a named type")
            yield name, item

    def _check_attributes(self, name: str, item: Any) -> None:
        """Refuse too many or too large attributes."""
        count = h5a.get_num_attrs(item)
        if count > MOST_ATTRIBUTES:
            self._refuse(f"{name} has too many attributes", f"{count}, more than {MOST_ATTRIBUTES}")
        sizes: list[int] = []
        h5a.iterate(item, lambda _, about: sizes.append(about.data_size), info=True)
        if max(sizes, default=0) > MOST_ATTRIBUTE_BYTES:
            found = f"{max(sizes)} bytes, more than {MOST_ATTRIBUTE_BYTES}"
            self._refuse(f"an attribute of {name} is too large", found)

    def _refuse_elsewhere(self, name: str, recipe: Any) -> None:
        if recipe.get_external_count() or recipe.get_layout() == h5d.VIRTUAL:
            raise InputError(f"{name} is stored in another file", where=self.where, expected=ITSELF)

    def _check_kind(self, name: str, item: Any, kind: Any, shape: tuple[int, ...] | None) -> None:
        """Raise InputError unless a dataset has plain numbers, one text, or no value."""
        if shape is None:
            return
        text = kind.get_class() == h5t.STRING
        if not text and kind.get_class() not in (h5t.INTEGER, h5t.FLOAT):
            dtype = h5py.Dataset(item).dtype
            raise InputError(
                f"{name} has an unsupported type",
                where=self.where,
                expected="plain numbers, or one text",
                found=str(dtype)[:200],
            )
        if text and kind.is_variable_str() and (shape != () or item.get_offset() is None):
            self._refuse(f"{name} has an unsupported type", "a list of texts")

    def _refuse(self, message: str, what: str) -> NoReturn:
        raise self._fault(message, what)

    def _fault(self, message: str, what: str) -> InputError:
        return InputError(message, where=self.where, found=what)


def row_blocks(dataset: h5py.Dataset, most_bytes: int = 4 << 20) -> Iterator[Any]:
    """Yield the rows of a dataset in blocks of about this size, so that memory does not grow with its length."""
    row_bytes = max(1, math.prod(dataset.shape[1:]) * dataset.dtype.itemsize)
    step = max(1, most_bytes // row_bytes)
    for start in range(0, max(1, len(dataset)), step):  # one empty block if there are no rows
        yield dataset[start : start + step]


@contextmanager
def damage_in_words(path: Path, what: str) -> Iterator[None]:
    """Turn exceptions that h5py raises on damaged bytes into an InputError with the file and the unreadable part."""
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
    """Whether a dataset only defines a dimension, as netCDF writes them: it has a length but no stored number."""
    if item.get_storage_size() or not h5a.exists(item, b"CLASS") or len(item.shape or ()) != 1:
        return False
    return _short_text(item, b"CLASS") == b"DIMENSION_SCALE" and _short_text(item, b"NAME").startswith(DIMENSION_ONLY)


def _short_text(item: Any, name: bytes) -> bytes:
    """Return an attribute that is a text of fixed length; empty for anything else."""
    if not h5a.exists(item, name):
        return b""
    attribute = h5a.open(item, name)
    kind = attribute.get_type()
    if kind.get_class() != h5t.STRING or kind.is_variable_str() or attribute.shape != () or kind.get_size() > 256:
        return b""
    value = np.empty((), f"S{kind.get_size()}")
    attribute.read(value)
    return bytes(value[()])
