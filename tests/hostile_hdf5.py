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


def some_chunks(path: Path) -> None:
    put(path, shape=(2**40,), dtype=np.uint16, chunks=(1024,))
    with h5py.File(path, "r+") as h5:
        h5[X][:10] = 1


def scalar_never_written(path: Path) -> None:
    put(path, shape=(), dtype=np.uint16)


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


def text_without_end(path: Path) -> None:
    with h5py.File(path, "r+") as h5:
        name = "sensor/name" if "sensor/name" in h5 else "name_of_mine"
        if name not in h5:
            h5[name] = "some text"
        where = h5[name].id.get_offset()
    byte_patch(path, where, (2**32 - 1).to_bytes(4, "little"))


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


OTHER_SHAPE = "events/x: expected"  # what is said first of a recording, whose columns are as long as each other

ANYWHERE: dict[str, tuple[Change, str]] = {
    # leads elsewhere
    "external link": (lambda path: link(path, h5py.ExternalLink(str(other(path)), X)), "is a link"),
    "soft link": (lambda path: link(path, h5py.SoftLink("/events/y")), "is a link"),
    "external storage": (external, "stored in another file"),
    "virtual": (lambda path: virtual(path, str(other(path))), "stored in another file"),
    # is not there
    "2^33 rows": (lambda path: put(path, shape=(2**33,), dtype=np.uint16), "never written"),
    "some of 2^40 rows": (some_chunks, "never written"),
    "scalar": (scalar_never_written, f"never written|{OTHER_SHAPE}"),
    # is packed to harm
    "chunk of 256 MB": (lambda path: filtered(path, 1, rows=2**27, chunk=b"x" * 900), "never written"),
    "packed twice": (lambda path: filtered(path, 1, 1), "compressed twice"),
    "unknown filter": (lambda path: filtered(path, 511), "HDF5 filter 511"),
    # is of another kind
    "compound": (
        lambda path: put(path, np.zeros(rows_of(path), [("a", "u1"), ("b", "u1")])),
        "expected dtype|not a column|no event columns",
    ),
}

IN_OUR_OWN: dict[str, tuple[Change, str]] = {
    "text without end": (text_without_end, "a text of 42949672"),
}

IN_HEADERS: dict[str, tuple[Change, str]] = {
    "nested 100,000 times": (lambda path: header_with(path, parameters='{"a":' * 100_000), "its header is not valid"),
    "seed of 100,000 digits": (lambda path: header_with(path, seed="9" * 100_000), "its header is not valid"),
    "length without end": (header_without_end, "a text of 42949672"),
    "bytes that are no text": (header_of_bytes, "its header"),
}
