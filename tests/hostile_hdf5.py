"""A table of HDF5 files that are made to harm: what is done to `events/x` of a file, and what is said of it.

Each of them changes a file that is right before: a recording, a segment of one, or somebody else's events.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from h5py import h5d, h5p, h5s, h5t

X = "events/x"
Change = Callable[[Path], None]


def put(path: Path, value: Any = None, **options: Any) -> None:
    """Put another dataset in the place of events/x."""
    with h5py.File(path, "r+") as h5:
        del h5[X]
        h5.create_dataset(X, data=value, **options)


def rows_of(path: Path) -> int:
    with h5py.File(path) as h5:
        return len(h5[X])


def link(path: Path, link: Any, name: str = X) -> None:
    """Put a link in the place of a dataset or group."""
    with h5py.File(path, "r+") as h5:
        if name in h5:
            del h5[name]
        h5[name] = link


def other(path: Path) -> Path:
    """A file of somebody else's, with columns as in the first."""
    elsewhere = path.with_name("elsewhere.h5")
    with h5py.File(path) as source, h5py.File(elsewhere, "w") as h5:
        source.copy("events", h5)
    return elsewhere


def soft_link_out(path: Path) -> None:
    link(path, h5py.ExternalLink(str(other(path)), "/"), "door")
    link(path, h5py.SoftLink("/door/events/x"))


def soft_links_in_a_circle(path: Path) -> None:
    link(path, h5py.SoftLink("/a"))
    link(path, h5py.SoftLink("/events/x"), "a")


def external(path: Path, where: str = "/etc/passwd", offset: int = 0) -> None:
    with h5py.File(path) as h5:
        rows = len(h5[X])
    put(path, shape=(rows,), dtype=np.uint16, external=[(where, offset, 2 * rows)])


def virtual(path: Path, source: str) -> None:
    rows = rows_of(path)
    layout = h5py.VirtualLayout((rows,), np.uint16)
    if source:
        layout[:] = h5py.VirtualSource(source, "events/y", (rows,))
    with h5py.File(path, "r+") as h5:
        del h5[X]
        h5.create_virtual_dataset(X, layout, fillvalue=1)


def references(path: Path, kind: Any) -> None:
    with h5py.File(path, "r+") as h5:
        rows = len(h5[X])
        del h5[X]
        one = h5["events/y"].ref if kind is h5py.ref_dtype else h5["events/y"].regionref[:1]
        h5.create_dataset(X, (rows,), kind)[...] = one


def lists(path: Path) -> None:
    with h5py.File(path, "r+") as h5:
        rows = len(h5[X])
        del h5[X]
        column = h5.create_dataset(X, (rows,), h5py.vlen_dtype(np.uint16))
        for row in range(rows):
            column[row] = [row]


def some_chunks(path: Path) -> None:
    put(path, shape=(2**40,), dtype=np.uint16, chunks=(1024,))
    with h5py.File(path, "r+") as h5:
        h5[X][:10] = 1


def scalar_never_written(path: Path) -> None:
    put(path, shape=(), dtype=np.uint16)


def as_dimension(path: Path, name: bytes) -> None:
    """Call 2^40 rows that were never written the mere name of a dimension."""
    put(path, shape=(2**40,), dtype=">f4")
    with h5py.File(path, "r+") as h5:
        h5[X].attrs["CLASS"] = np.bytes_("DIMENSION_SCALE")
        h5[X].attrs["NAME"] = np.bytes_(name)


def filtered(path: Path, *numbers: int, chunk: bytes | None = None, skipped: int = 0, rows: int = 0) -> None:
    """One chunk, through filters that may not even exist."""
    rows = rows or rows_of(path)
    with h5py.File(path, "r+") as h5:
        del h5[X]
        recipe = h5p.create(h5p.DATASET_CREATE)
        recipe.set_chunk((rows,))
        for number in numbers:
            recipe.set_filter(number, h5py.h5z.FLAG_OPTIONAL, (1,) if number == 1 else ())
        space = h5s.create_simple((rows,))
        h5d.create(h5["events"].id, b"x", h5t.NATIVE_UINT16, space, dcpl=recipe)
        h5[X].id.write_direct_chunk((0,), bytes(2 * rows) if chunk is None else chunk, skipped)


def byte_patch(path: Path, where: int, content: bytes) -> None:
    data = bytearray(path.read_bytes())
    data[where : where + len(content)] = content
    path.write_bytes(bytes(data))


def beyond_the_end(path: Path) -> None:
    """A contiguous dataset whose place in the file is moved behind the file's end."""
    rows = rows_of(path)
    put(path, np.full(rows, 0x1234, np.uint16))
    with h5py.File(path) as h5:
        place = h5[X].id.get_offset().to_bytes(8, "little") + (2 * rows).to_bytes(8, "little")
    where = path.read_bytes().find(place)
    assert where > 0
    byte_patch(path, where, (path.stat().st_size - 2).to_bytes(8, "little"))


def text_without_end(path: Path) -> None:
    with h5py.File(path, "r+") as h5:
        name = "sensor/name" if "sensor/name" in h5 else "name_of_mine"
        if name not in h5:
            h5[name] = "some text"
        where = h5[name].id.get_offset()
    byte_patch(path, where, (2**32 - 1).to_bytes(4, "little"))


def texts(path: Path) -> None:
    put(path, ["a"] * rows_of(path), dtype=h5py.string_dtype())


def header_text(path: Path, text: str) -> None:
    with h5py.File(path, "r+") as h5:
        h5.attrs["header"] = text


def header_with(path: Path, **changes: str) -> None:
    """Put JSON, as text, in the place of values of the header."""
    with h5py.File(path, "r+") as h5:
        header = {**json.loads(h5.attrs["header"]), **{key: f"@{key}" for key in changes}}
        text = json.dumps(header)
        for key, value in changes.items():
            text = text.replace(f'"@{key}"', value)
        h5.attrs["header"] = text


def header_without_end(path: Path) -> None:
    """The length of the header's text, as its attribute announces it, raised to 4 GB."""
    with h5py.File(path) as h5:
        length = len(h5.attrs["header"].encode())
    data = path.read_bytes()
    name = data.find(b"header\0\0")
    byte_patch(path, data.find(length.to_bytes(4, "little"), name), (2**32 - 16).to_bytes(4, "little"))


def header_of_bytes(path: Path) -> None:
    with h5py.File(path, "r+") as h5:
        text = h5.attrs["header"]
        del h5.attrs["header"]
        h5.attrs.create("header", b"\xff" + text.encode(), dtype=h5py.string_dtype())


def header_of_many(path: Path) -> None:
    with h5py.File(path, "r+") as h5:
        h5.attrs["header"] = [h5.attrs["header"]] * 3


OTHER_SHAPE = "events/x: expected"  # what is said first of a recording, whose columns are as long as each other

ANYWHERE: dict[str, tuple[Change, str]] = {
    # leads elsewhere
    "external link": (lambda path: link(path, h5py.ExternalLink(str(other(path)), X)), "is a link"),
    "external link to a device": (lambda path: link(path, h5py.ExternalLink("/dev/zero", X)), "is a link"),
    "external link for a group": (
        lambda path: link(path, h5py.ExternalLink(str(other(path)), "events"), "events"),
        "is a link",
    ),
    "external link beside": (lambda path: link(path, h5py.ExternalLink("/etc/x.h5", "/"), "more"), "is a link"),
    "soft link": (lambda path: link(path, h5py.SoftLink("/events/y")), "is a link"),
    "soft link out": (soft_link_out, "is a link"),
    "soft links in a circle": (soft_links_in_a_circle, "is a link"),
    "external storage": (external, "stored in another file"),
    "external storage beside": (lambda path: external(path, str(other(path)), 512), "stored in another file"),
    "virtual": (lambda path: virtual(path, str(other(path))), "stored in another file"),
    "virtual from a missing file": (lambda path: virtual(path, "/nowhere.h5"), "stored in another file"),
    # is not there
    "2^33 rows": (lambda path: put(path, shape=(2**33,), dtype=np.uint16), "never written"),
    "2^33 rows in chunks": (lambda path: put(path, shape=(2**33,), dtype="u2", chunks=(4096,)), "never written"),
    "2^33 packed rows": (lambda path: put(path, shape=(2**33,), dtype="u2", compression="gzip"), "never written"),
    "2^60 rows, growing": (lambda path: put(path, shape=(2**60,), maxshape=(None,), dtype="u2"), "never written"),
    "some of 2^40 rows": (some_chunks, "never written"),
    "table of 2^40 cells": (lambda path: put(path, shape=(2**20, 2**20), dtype="u2", chunks=(64, 64)), "never written"),
    "2^40 rows without a column": (lambda path: put(path, shape=(2**40, 0), dtype=np.uint16), "never written"),
    "scalar": (scalar_never_written, f"never written|{OTHER_SHAPE}"),
    "false dimension": (lambda path: as_dimension(path, b"x"), "never written"),
    "dimension without a column": (
        lambda path: as_dimension(path, b"This is a netCDF dimension but not a netCDF variable         9"),
        "events/x is missing|no event columns",
    ),
    "beyond the end": (beyond_the_end, "never written|invalid dataset size"),
    # is packed to harm
    "chunk of 256 MB": (lambda path: filtered(path, 1, rows=2**27, chunk=b"x" * 900), "never written"),
    "chunk longer than it may be": (lambda path: filtered(path, 1, chunk=bytes(100_000)), "cannot be read"),
    "chunk shorter than it is": (lambda path: filtered(path, chunk=b"ab"), "never written"),
    "unpacked chunk that is short": (lambda path: filtered(path, 1, chunk=b"ab", skipped=1), "never written"),
    "packed twice": (lambda path: filtered(path, 1, 1), "compressed twice"),
    "unknown filter": (lambda path: filtered(path, 511), "HDF5 filter 511"),
    "filter of one's own": (lambda path: filtered(path, 65535), "HDF5 filter 65535"),
    # is of another kind
    "references": (lambda path: references(path, h5py.ref_dtype), "expected dtype|not a column"),
    "references to parts": (lambda path: references(path, h5py.regionref_dtype), "expected dtype|not a column"),
    "compound": (
        lambda path: put(path, np.zeros(rows_of(path), [("a", "u1"), ("b", "u1")])),
        "expected dtype|not a column",
    ),
    "lists": (lists, "expected dtype|not a column"),
    "texts": (texts, "expected dtype|not a column"),
    "opaque": (lambda path: put(path, np.zeros(rows_of(path), "V2")), "expected dtype|not a column"),
    "arrays": (
        lambda path: put(path, shape=(3,), dtype=np.dtype(("u2", (4,)))),
        "expected dtype|not a column|never written",
    ),
    "complex": (lambda path: put(path, np.zeros(rows_of(path), complex)), "expected dtype|not a column"),
    "nothing": (lambda path: put(path, h5py.Empty("u2")), "events/x"),
}

IN_OUR_OWN: dict[str, tuple[Change, str]] = {
    "truth values": (lambda path: put(path, np.zeros(rows_of(path), bool)), "expected dtype"),
    "text without end": (text_without_end, "a text of 42949672"),
}

IN_HEADERS: dict[str, tuple[Change, str]] = {
    "no object": (lambda path: header_text(path, "[" * 100_000), "its header is not valid"),
    "nested 100,000 times": (lambda path: header_with(path, parameters='{"a":' * 100_000), "its header is not valid"),
    "seed of 100,000 digits": (lambda path: header_with(path, seed="9" * 100_000), "its header is not valid"),
    "seed of 4,000 digits": (lambda path: header_with(path, seed="9" * 4_000), "its header is not valid"),
    "seed without end": (lambda path: header_with(path, seed="Infinity"), "its header is not valid"),
    "length without end": (header_without_end, "a text of 42949672"),
    "bytes that are no text": (header_of_bytes, "its header"),
    "three headers": (header_of_many, "was not made by evetac"),
}
