"""Damage a file: its bytes, its text, or the contents of an HDF5 file that stays a valid HDF5 file.

`mutate(path, family, rng)` changes the file in place, by one to three operations, and returns their names.
"""

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from scripts.attack.fuzz import tables
from scripts.attack.fuzz.plain_files import Rng, damage_bytes, damage_text

LARGEST_READ = 64 << 20  # bytes
NUMBERS = (
    0,
    1,
    -1,
    7,
    255,
    256,
    65535,
    2**31 - 1,
    -(2**31),
    2**53,
    2**63 - 1,
    -(2**63),
    1e308,
    np.nan,
    np.inf,
    -np.inf,
)
HEADER_VALUES: tuple[Any, ...] = (
    None, True, -1, 2**80, 1e308, "", "recording", "\x1b[31mred", [], {}, [[]], {"a": {"b": {"c": 1}}}, "x" * 10_000,
)  # fmt: skip


def mutate(path: Path, family: str, rng: Rng) -> list[str]:
    """Damage a file, or one of the files of a folder, in one to three ways; return the names of the operations."""
    return [FAMILIES[family](path, rng) for _ in range(int(rng.integers(1, 4)))]


# HDF5 that stays HDF5


def damage_hdf5(path: Path, rng: Rng) -> str:
    """Change values, shapes, types, names, links, attributes or the header of an HDF5 file; sometimes its bytes."""
    if rng.random() < 0.15:
        return damage_bytes(path, rng)
    operation = HDF5_OPERATIONS[rng.integers(len(HDF5_OPERATIONS))]
    try:
        with h5py.File(path, "r+") as file:
            names: list[str] = []
            file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
            name = str(rng.choice(names)) if names else "none"
            return f"{operation.__name__.strip('_')} {name}: {operation(file, name, rng)}"
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError) as error:
        # An earlier operation has left the file, or a dataset, in a state that this operation cannot change.
        return f"{operation.__name__.strip('_')}: not possible ({type(error).__name__})"


def _read(file: h5py.File, name: str) -> Any:
    """Read a dataset; OSError if an earlier mutation announced more rows than fit into the fuzzer's memory."""
    if file[name].size * file[name].dtype.itemsize > LARGEST_READ:
        raise OSError(f"{name} is too large to change")
    return file[name][()]


def _value(file: h5py.File, name: str, rng: Rng) -> str:
    """Replace one number, some, or all by senseless values."""
    data = _read(file, name)
    number = NUMBERS[rng.integers(len(NUMBERS))]
    if isinstance(data, bytes):
        text = str(rng.choice(["", "\x1b]0;title\x07", "no such name", "x" * 5000, "[red]", "../../etc/passwd"]))
        file[name][()] = text
        return repr(text[:20])
    array = np.atleast_1d(data)
    if not array.size:
        return "empty"
    with np.errstate(all="ignore"):
        value = np.array(number).astype(array.dtype) if np.isfinite(number) or array.dtype.kind == "f" else number % 2
    how = rng.integers(3)
    flat = array.reshape(-1)
    if how == 0:
        flat[rng.integers(flat.size)] = value
    elif how == 1:
        first, last = sorted(rng.integers(0, flat.size + 1, 2))
        flat[first:last] = value
    else:
        flat[:] = value
    file[name][...] = flat.reshape(np.shape(data))
    return f"{value} ({('one', 'a run', 'all')[how]})"


def _order(file: h5py.File, name: str, rng: Rng) -> str:
    """Reverse or shuffle the rows."""
    data = _read(file, name)
    if np.ndim(data) == 0:
        return "scalar"
    if rng.random() < 0.5:
        file[name][...] = data[::-1]
        return "reversed"
    file[name][...] = rng.permutation(data)
    return "shuffled"


def _shape(file: h5py.File, name: str, rng: Rng) -> str:
    """Change the number of rows or axes."""
    data = np.asarray(_read(file, name))
    choices = [data[:0], data[: len(data) // 2], data[:-1], np.concatenate([data, data])] if data.ndim else []
    choices += [data.reshape(-1), data[None], data.reshape(-1)[:1].reshape(())] if data.size else [np.zeros(3)]
    return _replace(file, name, choices[rng.integers(len(choices))])


def _type(file: h5py.File, name: str, rng: Rng) -> str:
    """Change the dtype, also to compound types and text."""
    data = np.asarray(_read(file, name))
    if data.dtype.kind == "O":
        return _replace(file, name, np.zeros(2))
    kind = str(rng.choice(["f8", "f2", "i1", "u8", "S4", "c16", "bool", "compound", "enum", "empty"]))
    if kind == "compound":
        return _replace(file, name, np.zeros(data.shape, [("a", "i4"), ("b", "f8")]))
    if kind == "enum":
        del file[name]
        file.create_dataset(name, data.shape, h5py.enum_dtype({"a": 1, "b": 2}))
        return "enum"
    if kind == "empty":
        del file[name]
        file[name] = h5py.Empty("f8")
        return "null dataspace"
    with np.errstate(all="ignore"):
        return _replace(file, name, data.astype(kind))


def _announce(file: h5py.File, name: str, rng: Rng) -> str:
    """Announce rows that were never written, up to 2^33 of them."""
    rows = 2 ** int(rng.integers(10, 34))
    old = file[name]
    tail, dtype = old.shape[1:], old.dtype
    del file[name]
    # while it writes, HDF5 keeps an entry of every announced chunk in memory: 24 GB for 8 million chunks
    rows_of_chunk = max(int(rng.choice([1, 1024, 65536, 2**22])), rows >> 16)
    chunks = (rows_of_chunk, *tail) if rng.random() < 0.7 else None
    file.create_dataset(name, (rows, *tail), dtype, chunks=chunks, compression="gzip" if chunks else None)
    return f"{rows} rows"


def _remove(file: h5py.File, name: str, rng: Rng) -> str:
    """Remove a dataset, or its whole group."""
    target = name.split("/")[0] if rng.random() < 0.3 else name
    del file[target]
    return target


def _add(file: h5py.File, name: str, rng: Rng) -> str:
    """Add an unknown item: a dataset, a group, or a name of control characters."""
    stranger = str(rng.choice(["stranger", "events/stranger", "sensor/extra", "\x1b[31mred", "a" * 300, "ünïcode/x"]))
    file[stranger] = np.arange(3)
    return repr(stranger[:20])


def _link(file: h5py.File, name: str, rng: Rng) -> str:
    """Replace a dataset by a link or by external storage."""
    kind = str(rng.choice(["external", "soft", "cycle", "dangling", "virtual", "storage", "hard"]))
    shape, dtype = file[name].shape, file[name].dtype
    if kind == "hard":
        others = [other for other in ("events/x", "events/y", "header", name) if other in file]
        file["again"] = file[others[0]]
        return kind
    del file[name]
    if kind == "external":
        file[name] = h5py.ExternalLink("/etc/passwd", "/")
    elif kind == "soft":
        file[name] = h5py.SoftLink("/")
    elif kind == "cycle":
        file[name] = h5py.SoftLink(f"/{name}")
    elif kind == "dangling":
        file[name] = h5py.SoftLink("/nowhere")
    elif kind == "virtual":
        layout = h5py.VirtualLayout(shape or (1,), dtype)
        layout[:] = h5py.VirtualSource("/etc/passwd", "x", shape or (1,), dtype)
        file.create_virtual_dataset(name, layout)
    else:
        file.create_dataset(name, shape or (1,), dtype, external=[("/etc/passwd", 0, 100)])
    return kind


def _attribute(file: h5py.File, name: str, rng: Rng) -> str:
    """Change or add an attribute of a dataset or of the file."""
    target: Any = file if rng.random() < 0.5 else file[name]
    known = [key for key in target.attrs if key != "header"]
    key = str(rng.choice([*known, "units", "long_name", "crc32", "first_slice", "_FillValue", "scale_factor"]))
    values: list[Any] = [0, -1, 2**62, np.nan, "", "\x1b[31m", "x" * 20_000, np.zeros(1000), h5py.Empty("f8")]
    with suppress(KeyError):
        del target.attrs[key]
    choice = int(rng.integers(len(values)))
    target.attrs[key] = values[choice]
    return f"{key} = value {choice}"


def _header(file: h5py.File, name: str, rng: Rng) -> str:
    """Change one value anywhere in the header's JSON, or its whole text."""
    if "header" not in file.attrs:
        return "no header"
    if rng.random() < 0.2:
        texts = ["", "{", "null", "[]", "3", '{"kind": 3}', "[" * 50_000, '{"a":' * 20_000, "9" * 100_000, "\x00"]
        choice = int(rng.integers(len(texts)))
        file.attrs["header"] = texts[choice]
        return f"text {choice}"
    header = json.loads(file.attrs["header"])
    place: Any = header
    path = []
    while isinstance(place, (dict, list)) and place:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = keys[rng.integers(len(keys))]
        path.append(str(key)[:12])
        if not isinstance(place[key], (dict, list)) or not place[key] or rng.random() < 0.3:
            if rng.random() < 0.2 and isinstance(place, dict):
                del place[key]
            else:
                place[key] = HEADER_VALUES[rng.integers(len(HEADER_VALUES))]
            break
        place = place[key]
    text = json.dumps(header)
    if rng.random() < 0.7:  # an attacker would make the recipe id match
        with suppress(Exception):
            from evetac_cli.store.layout.provenance import recompute_id

            header["id"] = recompute_id(header)
            text = json.dumps(header)
    file.attrs["header"] = text
    return ".".join(path)


def _replace(file: h5py.File, name: str, data: Any) -> str:
    array = np.asarray(data)
    del file[name]
    file[name] = array
    return f"{array.dtype} {array.shape}"


HDF5_OPERATIONS: tuple[Callable[[h5py.File, str, Rng], str], ...] = (
    _value, _value, _value, _value, _value, _order, _shape, _type, _announce, _remove, _add, _link, _attribute,
    _header, _header,
)  # fmt: skip


def damage_segments(path: Path, rng: Rng) -> str:
    """Damage the folder of an aborted recording: one of its files, or the set of files."""
    files = sorted(file for file in path.iterdir() if file.suffix == ".h5" and file.is_file())
    operation = str(rng.choice(["hdf5", "hdf5", "hdf5", "bytes", "remove", "empty", "rename", "number", "copy"]))
    if not files:
        return "nothing left"
    file = files[rng.integers(len(files))]
    if operation == "hdf5":
        return f"{file.name}: {damage_hdf5(file, rng)}"
    if operation == "bytes":
        return f"{file.name}: {damage_bytes(file, rng)}"
    if operation == "remove":
        file.unlink()
    elif operation == "empty":
        file.write_bytes(b"")
    elif operation == "rename":
        file.rename(path / files[rng.integers(len(files))].name)
    elif operation == "number":
        (path / str(rng.choice(["99999999999.h5", "000099.h5", "0.h5", "1e9.h5", "-1.h5", "joined"]))).touch()
    else:
        (path / f"{int(rng.integers(100)):06d}.h5").write_bytes(file.read_bytes())
    return f"{operation} {file.name}"


def damage_files(path: Path, rng: Rng) -> str:
    """Damage a folder: one of its files, or the set of files."""
    files = sorted(file for file in path.iterdir() if file.is_file())
    operation = str(rng.choice(["damage", "damage", "damage", "damage", "remove", "empty", "exchange", "copy"]))
    if not files:
        return "nothing left"
    file = files[rng.integers(len(files))]
    if operation == "damage":
        return f"{file.name}: {(damage_text if file.suffix == '.yaml' else damage_bytes)(file, rng)}"
    if operation == "remove":
        file.unlink()
    elif operation == "empty":
        file.write_bytes(b"")
    elif operation == "exchange":
        file.rename(path / files[rng.integers(len(files))].name)
    else:
        file.with_stem(file.stem + str(rng.choice(["_1", "_0", " copy", "-wal"]))).write_bytes(file.read_bytes())
    return f"{operation} {file.name}"


FAMILIES: dict[str, Callable[[Path, Rng], str]] = {
    "bytes": damage_bytes,
    "text": damage_text,
    "hdf5": damage_hdf5,
    "segments": damage_segments,
    "files": damage_files,
    **tables.FAMILIES,
}
