"""Open ROS 1 bags (`.bag`) and ROS 2 bags (a folder, `.db3`, `.mcap`): connections and messages of all their files.

Formats are recognized by the content of the files, not by their names or the folder's metadata. No file is changed. A
ROS 2 recorder that was killed leaves messages in `NAME.db3-wal`. SQLite merges them when it opens the file for writing;
so such a file is copied, and they are merged into the copy. A bag of several files is read as one if its folder is
given.
"""

import re
import shutil
import sqlite3
import weakref
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing
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
DB3 = b"SQLite format 3\x00"
BAGS: dict[bytes, type[BagFile]] = {DB3: Db3File, b"\x89MCAP0\r\n": McapFile, b"#ROSBAG V2.0\n": Rosbag1File}
BLOCK_BYTES = 1 << 20
WAL = "-wal"
ENDINGS = (".db3", ".mcap")  # of the files in a bag's folder; `.zstd` may follow
PART = re.compile(r"(.*?)(?:[-_]\d{4}(?:-\d\d){5})?_(\d+)(\.db3|\.mcap)(\.zstd)?")
MOST_NAMED = 8

Message = tuple[Connection, int, bytes]  # and the time of its reception in ns


class Files(NamedTuple):
    """The files of a bag in order, notes on them, and the number of messages that the folder's metadata state."""

    paths: tuple[Path, ...]
    notes: tuple[str, ...] = ()
    stated: int | None = None


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
        count = counts.total()
        if files.stated not in (None, count):
            self.notes.append(f"{METADATA} states {files.stated:,} messages, but the bag has {count:,}")
            self.cut_short |= (files.stated or 0) > count

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
        return _bag(path, files, tuple(stamp for file in files.paths for stamp in _stamps(file)))


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
    names, stated, trouble = _listed(path)
    if trouble:
        return _without_metadata(path, inside, trouble)
    missing = [name for name in names if not (path / name).is_file()]
    if missing:
        expected, found = _file_names(missing), _file_names(inside) or "no bag file"
        hint = "copy it into the folder, or import each file separately"
        raise InputError("a part of the bag is missing", where=str(path), expected=expected, found=found, hint=hint)
    others = [name for name in inside if name not in names]
    note = f"not read: {_file_names(others)}, which {METADATA} does not list; give the file itself to read it"
    return Files(tuple(path / name for name in dict.fromkeys(names)), (note,) if others else (), stated)


def _without_metadata(path: Path, inside: list[str], trouble: str) -> Files:
    """Return the files of a folder in the order of their numbers."""
    parts = {int(part[2]): part for name in inside if (part := PART.fullmatch(name))}
    gaps = len(parts) and max(parts) - min(parts) + 1 - len(parts)
    if len(inside) > 1 and (len(parts) < len(inside) or len({part[1] for part in parts.values()}) > 1 or gaps):
        found, hint = _file_names(inside), f"give one of them, for example {path / inside[0]}"
        raise InputError("the folder's files are not all parts of one bag", where=str(path), found=found, hint=hint)
    if not inside:
        raise InputError("the folder has no bag file", where=str(path), expected=" or ".join(ENDINGS), found=trouble)
    ordered = [part[0] for _, part in sorted(parts.items())] if len(inside) > 1 else inside
    return Files(tuple(path / name for name in ordered), (f"{trouble}; read {_file_names(ordered)}",))


def _listed(folder: Path) -> tuple[list[str], int | None, str]:
    """Return the files and the number of messages that the folder's metadata state, or why they cannot be used."""
    from ruamel.yaml import YAML

    if not (folder / METADATA).exists():
        return [], None, f"the folder has no {METADATA} (a recorder that was killed does not write it)"
    text = read_bytes(folder / METADATA, MOST_METADATA_BYTES)
    try:
        about = YAML(typ="safe").load(text)["rosbag2_bagfile_information"]
        names = [PurePath(name).name for name in about["relative_file_paths"]]
        packed, stated = about.get("compression_format") or "", about.get("message_count")
        if not names:
            raise ValueError("it lists no files")
    except Exception as error:  # the YAML parser, and access to what it returns, raise all kinds of exceptions
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:100]
        return [], None, f"{METADATA} cannot be used ({reason})"
    if packed not in ("", "none", "zstd"):
        message, found = "the compression of the bag is not supported", str(packed)[:40]
        raise InputError(message, where=str(folder), expected="zstd", found=found)
    return names, stated if type(stated) is int else None, ""


def _inside(folder: Path) -> list[str]:
    """Return the names in a folder that can be those of a bag's files."""
    files = [one.name for one in folder.iterdir() if not one.is_dir()]
    names = sorted(name for name in files if name.removesuffix(".zstd").endswith(ENDINGS))
    # A recorder that was killed while it compressed a file leaves both files.
    return [name for name in names if not (name.endswith(".zstd") and name.removesuffix(".zstd") in names)]


def _file_names(names: list[str]) -> str:
    return ", ".join(names[:MOST_NAMED]) + (f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else "")


def _stamps(path: Path) -> tuple[Any, ...]:
    """Return what changes when a file of a bag, or the `-wal` next to it, is written to."""
    states = [(one, one.stat()) for one in (path, *_waiting(path))]
    return tuple((str(one), state.st_size, state.st_mtime_ns, state.st_ino) for one, state in states)


def _waiting(path: Path) -> list[Path]:
    """Return the `-wal` next to a file, if it is not empty."""
    wal = path.with_name(path.name + WAL)
    if not wal.exists():
        return []
    open_regular(wal).close()
    return [wal] if wal.stat().st_size else []


def _opened(path: Path, where: str) -> BagFile:
    """Return a file of a bag; one that is compressed, or has a `-wal` of SQLite next to it, is read from a copy.

    The copy is removed with the returned object. where: the file's name in messages.
    """
    before = _stamps(path)
    with open_regular(path) as file:
        head = file.read(len(DB3))
    waiting = _waiting(path) if head.startswith(DB3) else []
    if not head.startswith(ZSTD) and not waiting:
        return _reader(path, where)
    name = temporary_name(Path(gettempdir()) / "evetac-bag").name  # removes what processes that were killed left
    folder = Path(mkdtemp(prefix=name.removesuffix("tmp"), suffix=".tmp"))
    try:
        copy = folder / "copy"
        if waiting:
            for one in (path, *waiting):
                shutil.copyfile(one, f"{copy}{one.name.removeprefix(path.name)}")
        else:
            _unpack(path, copy, where)
        if _stamps(path) != before:
            raise InputError("the bag is still being written", where=where, hint="stop the recorder first")
        if waiting:
            with closing(sqlite3.connect(copy)) as database:  # merges what waits into the copy
                database.execute("PRAGMA journal_mode = DELETE").fetchone()
        bag = _reader(copy, where)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    weakref.finalize(bag, shutil.rmtree, folder, ignore_errors=True)
    bag.notes[:0] = [f"read together with {one.name} ({one.stat().st_size:,} bytes) next to it" for one in waiting]
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
