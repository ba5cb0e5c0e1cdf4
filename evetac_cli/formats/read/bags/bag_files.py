"""Open ROS 1 bags (`.bag`) and ROS 2 bags (a folder, `.db3`, `.mcap`): connections and messages of all their files.

Formats are recognized by the content of the files, not by their names or the folder's metadata. No file is changed. A
bag of several files is read as one if its folder is given; metadata.yaml lists them. A ROS 2 recorder that was killed
writes no metadata.yaml, and leaves messages of SQLite in `NAME.db3-wal`: programs of ROS 2 and SQLite mend both.
"""

import shutil
import weakref
from collections import Counter
from collections.abc import Collection, Iterator
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path, PurePath
from tempfile import gettempdir, mkdtemp
from typing import Any, NamedTuple

from evetac_cli.errors import InputError, missing_extra
from evetac_cli.formats.read.bags.bag_readers import BagFile, Connection, Db3File, McapFile, Rosbag1File
from evetac_cli.formats.read.damage import read_in_words, refuse_too_much, unpacked
from evetac_cli.store.hdf5.disk import temporary_name
from evetac_cli.text_files import open_regular, read_bytes

LIBRARIES = ("rosbags.typesys", "mcap.records", "lz4.frame", "zstandard", "ruamel.yaml")
ZSTD = b"\x28\xb5\x2f\xfd"
METADATA = "metadata.yaml"
MOST_METADATA_BYTES = 1 << 20  # a topic takes a few hundred bytes
BAGS: dict[bytes, type[BagFile]] = {
    b"SQLite format 3\x00": Db3File,
    b"\x89MCAP0\r\n": McapFile,
    b"#ROSBAG V2.0\n": Rosbag1File,
}
BLOCK_BYTES = 1 << 20
ENDINGS = (".db3", ".mcap")  # of the files in a bag's folder; `.zstd` may follow
MOST_NAMED = 8

Message = tuple[Connection, int, bytes]  # and the time of its reception in ns


class Files(NamedTuple):
    """The files of a bag in order, and notes on them."""

    paths: tuple[Path, ...]
    notes: tuple[str, ...] = ()


class Bag:
    """All files of a bag: its connections, its messages, and notes on missing data.

    cut_short: whether messages are known to be missing.
    """

    def __init__(self, path: Path, files: Files) -> None:
        """Read the tables of all files; raise InputError if files are missing or have no readable message."""
        self.path = path
        self.notes, self.cut_short = list(files.notes), False
        self._files = []
        counts: Counter[Connection] = Counter()
        for file in files.paths:
            opened = _opened(file, str(file) if file == path else f"{path}: {file.name}")
            self._files.append(opened)
            of = f"{file.name}: " if path.is_dir() and len(files.paths) > 1 else ""
            self.notes += [of + note for note in opened.notes]
            self.cut_short |= opened.cut_short
            for one in opened.connections:
                counts[_alike(one)] += one.msgcount
        self.connections = [
            one._replace(number=number, msgcount=count) for number, (one, count) in enumerate(counts.items())
        ]

    def messages(self, connections: Collection[Connection]) -> Iterator[Message]:
        """Yield all messages of some connections, file after file, in each file's order; InputError if damaged.

        The order of reception is not used: it hangs on the recorder's clock, which may be set back at any time.
        """
        wanted = {_alike(one): one for one in connections}
        for file in self._files:
            with read_in_words(str(self.path), "a message cannot be read"):
                numbers = {one.number: wanted[_alike(one)] for one in file.connections if _alike(one) in wanted}
                for number, time_ns, packed in file.messages(numbers):
                    message = packed
                    if numbers[number].ros2 and packed.startswith(ZSTD):
                        message = unpacked(zstd_module().ZstdDecompressor, packed, str(self.path))
                    yield numbers[number], time_ns, message


def _alike(connection: Connection) -> Connection:
    """Return a connection reduced to the fields that are the same in all files of a bag."""
    return connection._replace(number=0, msgcount=0)


def open_bag(path: Path) -> Bag:
    """Open a bag and read the tables of its files; raise InputError or MissingLibrary if that is not possible."""
    where = str(path)
    try:
        missing = [name for name in LIBRARIES if find_spec(name) is None]
        zstd_module()
    except ImportError as error:
        missing = [error.name or str(error)]
    if missing:
        raise missing_extra("ROS bags need rosbags and mcap", "convert", where=where, found=f"no {missing[0]}")
    with read_in_words(where, "the bag cannot be read"):
        files = _files_of(path)
        return _bag(path, files, tuple(map(_stamps, files.paths)))


@lru_cache(maxsize=2)
def _bag(path: Path, files: Files, stamps: tuple[Any, ...]) -> Bag:
    """Return a bag, cached as long as its files do not change."""
    del stamps
    return Bag(path, files)


def is_bag_folder(path: Path) -> bool:
    """Whether this folder is a ROS 2 bag; its metadata.yaml, which is written last, may be missing."""
    return (path / METADATA).is_file() or bool(_inside(path))


def _files_of(path: Path) -> Files:
    """Return the files of a bag, given its folder or one of its files; raise InputError if some are missing."""
    if not path.is_dir():
        return Files((path,))
    inside = _inside(path)
    names = _listed(path)
    if not names:
        if len(inside) == 1:
            return Files((path / inside[0],), (f"the folder has no usable {METADATA}; read {inside[0]}",))
        expected, found = f"a {METADATA} that lists its files", _file_names(inside) or "no bag file"
        hint = f"`ros2 bag reindex {path}` writes it; or import each file separately"
        message = "the folder does not say in which order its files belong"
        raise InputError(message, where=str(path), expected=expected, found=found, hint=hint)
    missing = [name for name in names if not (path / name).is_file()]
    if missing:
        expected, found = _file_names(missing), _file_names(inside) or "no bag file"
        hint = "copy it into the folder, or import each file separately"
        raise InputError("a part of the bag is missing", where=str(path), expected=expected, found=found, hint=hint)
    others = [name for name in inside if name not in names]
    note = f"not read: {_file_names(others)}, which {METADATA} does not list; give the file itself to read it"
    return Files(tuple(path / name for name in dict.fromkeys(names)), (note,) if others else ())


def _listed(folder: Path) -> list[str]:
    """Return the files that the folder's metadata list; none if there are no metadata, or unfinished ones."""
    from ruamel.yaml import YAML

    if not (folder / METADATA).exists():
        return []
    text = read_bytes(folder / METADATA, MOST_METADATA_BYTES)
    try:
        about = YAML(typ="safe").load(text)["rosbag2_bagfile_information"]
        names = [PurePath(name).name for name in about["relative_file_paths"]]
        packed = about.get("compression_format") or ""
    except Exception:  # the YAML parser, and access to what it returns, raise all kinds of exceptions
        return []
    if packed not in ("", "none", "zstd"):
        message, found = "the compression of the bag is not supported", str(packed)[:40]
        raise InputError(message, where=str(folder), expected="zstd", found=found)
    return names


def _inside(folder: Path) -> list[str]:
    """Return the names in a folder that can be those of a bag's files."""
    files = [one.name for one in folder.iterdir() if not one.is_dir()]
    names = sorted(name for name in files if name.removesuffix(".zstd").endswith(ENDINGS))
    # A recorder that was killed while it compressed a file leaves both files.
    return [name for name in names if not (name.endswith(".zstd") and name.removesuffix(".zstd") in names)]


def _file_names(names: list[str]) -> str:
    return ", ".join(names[:MOST_NAMED]) + (f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else "")


def _stamps(path: Path) -> tuple[Any, ...]:
    """Return what changes when a file of a bag is written to."""
    state = path.stat()
    return str(path), state.st_size, state.st_mtime_ns, state.st_ino


def _opened(path: Path, where: str) -> BagFile:
    """Return a file of a bag; one that is compressed is read from a copy, which is removed with the returned object.

    where: the file's name in messages.
    """
    wal = path.with_name(f"{path.name}-wal")
    if wal.exists() and wal.stat().st_size:
        hint = f"`sqlite3 {path} 'PRAGMA wal_checkpoint(TRUNCATE)'` merges them into the file"
        raise InputError("messages of the bag wait in another file", where=where, found=wal.name, hint=hint)
    with open_regular(path) as file:
        packed = file.read(len(ZSTD)) == ZSTD
    if not packed:
        return _reader(path, where)
    name = temporary_name(Path(gettempdir()) / "evetac-bag").name  # removes what processes that were killed left
    folder = Path(mkdtemp(prefix=name.removesuffix("tmp"), suffix=".tmp"))
    try:
        _unpack(path, folder / "copy", where)
        bag = _reader(folder / "copy", where)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    weakref.finalize(bag, shutil.rmtree, folder, ignore_errors=True)
    return bag


def _reader(path: Path, where: str) -> BagFile:
    with path.open("rb") as file:
        head = file.read(max(map(len, BAGS)))
    reader = next((reader for begins, reader in BAGS.items() if head.startswith(begins)), None)
    if reader is None:
        expected = "SQLite (.db3), MCAP or a ROS 1 bag"
        raise InputError("not a bag file", where=where, expected=expected, found=f"begins with {head[:13]!r}")
    return reader(path, where)


def _unpack(path: Path, copy: Path, where: str) -> None:
    """Unpack a file that was compressed as a whole, with zstd."""
    size = path.stat().st_size
    with open_regular(path) as packed, zstd_module().open(packed, "rb") as content, copy.open("wb") as target:
        try:
            while block := content.read1(BLOCK_BYTES):
                refuse_too_much(target.tell() + len(block), size, where)
                target.write(block)
        except EOFError:
            raise InputError("the compressed file is cut short", where=where, hint="copy it again") from None


def zstd_module() -> Any:
    """Import the module for zstd: Python's own since 3.14, before that the one that rosbags depends on."""
    try:
        return import_module("compression.zstd")
    except ImportError:
        return import_module("backports.zstd")
