"""HDF5 files, evetac's and others, opened for reading.

An HDF5 file may refer to any other file of the computer, and announce rows that it does not have: HDF5 would read the
one and invent the others. So one walk refuses links, virtual datasets and external storage when a file is opened, and
data beyond what its size can hold. That a dataset's rows were all written is checked before it is first read, because
most callers read a few of dozens. Damage is put into words where it is found.
"""

import importlib
import math
import os
import shlex
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
from h5py import h5a, h5d, h5l, h5o, h5z

from evetac_cli.errors import PASSING, InputError, UnavailableError, cannot_read, missing_extra

MOST_EXPANSION = 1100  # data of a file, in multiples of its size; gzip expands one byte to at most 1,032
PROPHESEE_FILTER = 0x8ECF
DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError)  # what h5py raises on damaged bytes
DIMENSION_ONLY = b"This is a netCDF dimension but not a netCDF variable"


class CheckedHdf5:
    """An HDF5 file, open for reading."""

    def __init__(self, path: Path, expected: str = "an HDF5 file", hint: str = "") -> None:
        """Open a regular file; InputError if it is not one or not HDF5, UnavailableError if it cannot be read now.

        hint: what to do with a file that is not HDF5.
        """
        self.path, self.where = path, str(path)
        if not os.path.isfile(path):  # unlike Path.is_file, also for a name too long; opening a pipe waits for a writer
            if not os.path.exists(path):
                raise InputError("no such file", where=self.where)
            what = "this is a folder" if os.path.isdir(path) else "this is not a regular file"
            raise InputError(what, where=self.where, expected=expected)
        try:
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
            root = self.h5.attrs
            if name not in root or root.get_id(name).shape != () or root.get_id(name).dtype != object:
                return None
            return attribute_text(self.path, h5o.get_info(self.h5["/"].id).addr, name)

    def text(self, name: str, item: h5d.DatasetID) -> str:
        """Return the text of a dataset, given by its id; `name` is used in error messages."""
        with damage_in_words(self.path, name):
            if h5py.check_string_dtype(item.dtype).length is not None:
                return str(h5py.Dataset(item).asstr()[()])
            return dataset_text(self.path, item.get_offset())

    def number_attribute(self, name: str, of: str = "/") -> int | None:
        """Return a whole-number attribute of an object; None if there is none of this name."""
        with damage_in_words(self.path, f"{name} of {of}"):
            attributes = self.h5[of].attrs
            if name not in attributes or attributes.get_id(name).dtype.kind not in "iu":
                return None
            return int(attributes[name])

    def datasets(self, only: Collection[str] | None = None) -> dict[str, h5py.Dataset]:
        """Return every dataset by its path, or those among `only`, after `survey` and `check`."""
        found = {name: item for name, item in self.survey().items() if only is None or name in only}
        for name, item in found.items():
            self.check(name, item)
        return {name: h5py.Dataset(item) for name, item in found.items()}

    def survey(self, is_left: Callable[[str], bool] = lambda path: False) -> dict[str, h5d.DatasetID]:
        """Return every dataset by its path; InputError for links and data in other files, and for too much data.

        Dimensions, which have no numbers, are left out.
        is_left: whether the object at a path is not opened.
        """
        found: dict[str, h5d.DatasetID] = {}
        names: dict[str, bytes] = {}

        def first_link(raw: bytes, link: Any) -> str | None:
            name = raw.decode(errors="backslashreplace")
            names[name] = raw
            return None if link.type == h5l.TYPE_HARD else name

        with damage_in_words(self.path, "its contents"):
            root = self.h5["/"].id
            linked = root.links.visit(first_link, info=True)  # each group once, however many names it has
            if linked is not None:
                raise self._elsewhere(f"`{linked}` is a link")
            announced = 0
            for name in sorted(names):
                item = None if is_left(name) else h5o.open(root, names[name])
                if not isinstance(item, h5d.DatasetID):
                    continue
                if item.get_offset() is None:  # otherwise its bytes are in this file, contiguous
                    recipe = item.get_create_plist()
                    if recipe.get_external_count() or recipe.get_layout() == h5d.VIRTUAL:
                        raise self._elsewhere(f"{name} is stored in another file")
                shape = item.shape
                if len(shape or ()) == 1 and _is_dimension(item):
                    continue
                found[name] = item
                if shape is not None:  # a row without columns counts as one value, since rows cost time
                    announced += math.prod(max(1, size) for size in shape) * item.get_type().get_size()
            size = os.stat(self.path).st_size
            if announced > MOST_EXPANSION * size:
                expected = f"at most {MOST_EXPANSION} times the file's {size} bytes"
                message = "its datasets announce rows that were never written"
                raise InputError(message, where=self.where, expected=expected, found=f"{announced} bytes")
        return found

    def _elsewhere(self, message: str) -> InputError:
        return InputError(message, where=self.where, expected="data in the file itself")

    def check(self, name: str, item: h5d.DatasetID) -> None:
        """Raise InputError for a dataset with rows that were never written, or with a filter that is not installed."""
        with damage_in_words(self.path, name):
            recipe, shape = item.get_create_plist(), item.shape
            filters = [recipe.get_filter(number) for number in range(recipe.get_nfilters())]
            for number, _, _, label in filters:
                _require_filter(self.where, name, number, label.decode(errors="replace").split(";")[0])
            if len({number for number, *_ in filters}) < len(filters):
                raise ValueError("it is compressed twice with the same filter")  # and may expand beyond MOST_EXPANSION
            if shape == () and h5py.check_string_dtype(item.dtype):
                self.text(name, item)
            values = 0 if shape is None else math.prod(shape)
            if values and recipe.get_layout() == h5d.CHUNKED:
                chunk, stored = recipe.get_chunk(), list[int]()
                whole = math.prod(chunk) * item.get_type().get_size()
                item.chunk_iter(lambda one: stored.append(one.size if one.filter_mask or not filters else whole))
                of_axes = zip(shape, chunk, strict=True)
                complete = len(stored) >= math.prod(-(-rows // long) for rows, long in of_axes) and min(stored) >= whole
            else:
                complete = item.get_storage_size() >= values * item.get_type().get_size()
            if not complete:
                raise InputError(f"{name} is incomplete: parts of it were never written", where=self.where)


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
        hint = "the file is damaged; make it again"
        raise InputError(f"{what} cannot be read: {reason}", where=str(path), hint=hint) from None


def _require_filter(where: str, name: str, number: int, label: str) -> None:
    """Raise InputError unless HDF5, with the filters of hdf5plugin, has a filter."""
    if h5z.filter_avail(number):
        return
    message, found = f"{name} is compressed with a filter that is not installed here", f"HDF5 filter {number} ({label})"
    try:
        importlib.import_module("hdf5plugin")  # registers its filters
    except ImportError as error:
        if number != PROPHESEE_FILTER:
            raise missing_extra(message, "convert", where=where, found=found, error=error) from None
    if not h5z.filter_avail(number):
        tool = "Prophesee's tools" if number == PROPHESEE_FILTER else "h5repack -f GZIP=1 IN OUT"
        raise InputError(message, where=where, found=found, hint=f"convert it with {tool}")


def _is_dimension(item: h5d.DatasetID) -> bool:
    """Whether a dataset only defines a dimension, as netCDF writes them: it has a length but no stored number."""
    if item.get_storage_size() or not h5a.exists(item, b"NAME"):
        return False
    name = h5a.open(item, b"NAME")  # h5ds.get_scale_name writes past its buffer for a damaged one
    if name.shape != () or name.dtype.kind != "S":
        return False
    text = np.empty((), name.dtype)
    name.read(text)
    return bytes(text[()]).startswith(DIMENSION_ONLY)


# Texts, of attributes and scalar datasets, are read from their bytes. HDF5 reserves the memory that one announces,
# up to 4 GB, before it looks for it, and loops forever over a damaged heap of texts; one flipped bit is enough for
# either. So these few structures of the HDF5 File Format Specification are read here: object headers (IV.A.1),
# attributes (IV.A.2.m), the global heap (III.E). Other bytes raise ValueError.

ATTRIBUTE, CONTINUATION = 0x0C, 0x10
MOST_TEXT_BYTES = 32 << 20
MOST_HEAP_TEXTS = 1 << 16  # they have 16-bit numbers
MOST_BLOCKS = 1000  # of an object header
MOST_BLOCK_BYTES = 1 << 20
REFERENCE_BYTES = 16


def attribute_text(path: Path, address: int, name: str) -> str:
    """Return the text attribute `name` of the object whose header is at `address`."""
    with open(path, "rb") as file:
        for data in _attributes(file.fileno(), address):
            sizes = [_number(data[at : at + 2]) for at in (2, 4, 6)]  # of name, type, shape
            at = 9 if data[:1] == b"\3" else 8
            if data[at : at + sizes[0]].rstrip(b"\0") == name.encode():
                at += sum(-(-size // 8) * 8 if data[:1] == b"\1" else size for size in sizes)
                return _text(file.fileno(), data[at : at + REFERENCE_BYTES])
    raise ValueError(f"the attribute {name} is stored in an unsupported form")


def dataset_text(path: Path, address: int) -> str:
    """Return the text of a scalar dataset whose bytes are at `address`."""
    with open(path, "rb") as file:
        return _text(file.fileno(), os.pread(file.fileno(), REFERENCE_BYTES, address))


def _text(file: int, reference: bytes) -> str:
    """Return the text for a reference: a length, the address of a heap, and a number in the heap."""
    length, heap, number = _number(reference[:4]), _number(reference[4:12]), _number(reference[12:16])
    if length > MOST_TEXT_BYTES:
        raise ValueError(f"a text of {length} bytes, more than {MOST_TEXT_BYTES}")
    at = heap + 16
    for _ in range(MOST_HEAP_TEXTS if length else 0):
        entry = os.pread(file, 16, at) if at < 2**62 else b""
        index, size = _number(entry[:2]), _number(entry[8:16])
        if index == number and size == length:
            return os.pread(file, length, at + 16).decode()
        if index in (0, number):
            break
        at += 16 + -(-size // 8) * 8
    if length:
        raise ValueError("its text is not at the stated address")
    return ""


def _attributes(file: int, address: int) -> Iterator[bytes]:
    """Yield the attribute messages of an object header."""
    start = os.pread(file, 64, address)
    second = start[:4] == b"OHDR"
    if second:
        at = 6 + 16 * bool(start[5] & 0x20) + 4 * bool(start[5] & 0x10)
        width = 1 << (start[5] & 3)
        blocks, head = [(address + at + width, _number(start[at : at + width]))], 4 + 2 * bool(start[5] & 4)
    else:
        blocks, head = [(address + 16, _number(start[8:12]))], 8
    for where, size in blocks:
        if len(blocks) > MOST_BLOCKS or size > MOST_BLOCK_BYTES or where >= 2**62:
            raise ValueError("its object header is damaged")
        block, at = os.pread(file, size, where), 0
        while at + head <= len(block):
            kind = block[at] if second else _number(block[at : at + 2])
            length = _number(block[at + 1 : at + 3] if second else block[at + 2 : at + 4])
            data = block[at + head : at + head + length]
            at += head + length
            if kind == CONTINUATION:
                more, count = _number(data[:8]), _number(data[8:16])
                blocks.append((more + 4, count - 8) if second else (more, count))  # less signature and checksum
            elif kind == ATTRIBUTE:
                yield data


def _number(content: bytes) -> int:
    return int.from_bytes(content, "little")
