"""Find the files of a bag, and make each readable without changing any of them.

Files next to a bag's file may belong to it. A ROS 2 recorder that was killed leaves messages in `NAME.db3-wal`. SQLite
merges them when it opens the file for writing; so such a file is copied, and they are merged into the copy. A bag of
several files is read as one if its folder is given. If a single file is given, the notes list the files next to it.
"""

import re
import shutil
import sqlite3
import weakref
from contextlib import closing, suppress
from importlib import import_module
from itertools import islice
from pathlib import Path, PurePath
from tempfile import gettempdir, mkdtemp
from typing import Any, NamedTuple

from evetac_cli.errors import InputError
from evetac_cli.formats.read.bags.bag_readers import BagFile, Db3File, McapFile, Rosbag1File
from evetac_cli.formats.read.damage import refuse_too_much
from evetac_cli.store.hdf5.disk import temporary_name
from evetac_cli.text_files import open_regular, read_bytes

ZSTD = b"\x28\xb5\x2f\xfd"
METADATA = "metadata.yaml"
MOST_METADATA_BYTES = 1 << 20  # a topic takes a few hundred bytes
DB3 = b"SQLite format 3\x00"
BAGS: dict[bytes, type[BagFile]] = {DB3: Db3File, b"\x89MCAP0\r\n": McapFile, b"#ROSBAG V2.0\n": Rosbag1File}
BLOCK_BYTES = 1 << 20
WAL, JOURNAL = "-wal", "-journal"
WAL_HEAD_BYTES, FRAME_HEAD_BYTES = 32, 24  # of the `-wal` of SQLite, and of each page in it
OTHER_NAME = bytes.fromhex("d9d505f920a163d7")  # end of a journal that names another file
ENDINGS = (".db3", ".mcap")  # of the files in a bag's folder; `.zstd` may follow
PART = re.compile(r"(.*?)(?:[-_]\d{4}(?:-\d\d){5})?_(\d+)(\.bag(?:\.active)?|\.db3|\.mcap)(\.zstd)?")
MOST_NAMED = 8


class Files(NamedTuple):
    """The files of a bag in order, notes on them, and the number of messages that the folder's metadata state."""

    paths: tuple[Path, ...]
    notes: tuple[str, ...]
    stated: int | None = None


def is_bag_folder(path: Path) -> bool:
    """Whether this folder is a ROS 2 bag; its metadata.yaml, which is written last, may be missing."""
    return (path / METADATA).is_file() or bool(_inside(path))


def files_of(path: Path) -> Files:
    """Return the files of a bag, given its folder or one of its files; raise InputError if some are missing."""
    if not path.is_dir():
        open_regular(path).close()
        others = _parts_beside(path)
        more = f"next to it: {_file_names(others)}, which may be parts of the same recording" if others else ""
        return Files((path,), (more,) if more else ())
    for inside in sorted(path.iterdir()):
        if not inside.is_dir():
            open_regular(inside).close()
    if (path / METADATA).exists():
        listed, trouble = _listed(path)
        if listed is not None:
            return listed
        note = f"{METADATA} cannot be used ({trouble})"
    else:
        note = f"the folder has no {METADATA} (a recorder that was killed does not write it)"
    files = _inside(path)
    if not files:
        raise InputError("the folder has no bag file", where=str(path), expected=" or ".join(ENDINGS), found=note)
    names = [name for file in files if (name := PART.fullmatch(file.name))]
    numbered = {int(name[2]): path / name[0] for name in names}
    if len(files) > 1 and (len(numbered) < len(files) or len({name[1] for name in names}) > 1):
        hint = f"give one of them, for example {path / files[0].name}"
        raise InputError(
            "the folder has several files that are not parts of one bag",
            where=str(path),
            found=_file_names(files),
            hint=hint,
        )
    if len(files) > 1:
        numbers = (number for number in range(min(numbered), max(numbered)) if number not in numbered)
        if lacking := list(islice(numbers, MOST_NAMED)):
            raise _missing(path, [f"number {number}" for number in lacking], files)
        files = [file for _, file in sorted(numbered.items())]
    return Files(tuple(files), (f"{note}; read {_file_names(files)}",))


def stamps(path: Path) -> tuple[Any, ...]:
    """Return what changes when a file of a bag, or what SQLite left next to it, is written to."""
    states = [(one, one.stat()) for one in (path, *_beside(path))]
    return tuple((str(one), state.st_size, state.st_mtime_ns, state.st_ino) for one, state in states)


def opened(path: Path, where: str) -> BagFile:
    """Return a file of a bag; one that is compressed, or has files of SQLite next to it, is read from a copy.

    The copy is removed with the returned object. where: the file's name in messages.
    """
    before = stamps(path)
    with open_regular(path) as file:
        head = file.read(len(DB3))
    beside = _beside(path) if head.startswith(DB3) else []
    if not head.startswith(ZSTD) and not beside:
        return _read(path, where)
    name = temporary_name(Path(gettempdir()) / "evetac-bag").name  # removes what processes that were killed left
    folder = Path(mkdtemp(prefix=name.removesuffix("tmp"), suffix=".tmp"))
    try:
        copy = folder / "copy"
        if not beside:
            _unpack(path, copy, where)
        for one in (path, *beside) if beside else ():
            shutil.copyfile(one, f"{copy}{one.name.removeprefix(path.name)}")
        if stamps(path) != before:
            raise InputError("the bag is still being written", where=where, hint="stop the recorder first")
        note = _joined(copy, beside, where) if beside else ""
        bag = _read(copy, where)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    weakref.finalize(bag, shutil.rmtree, folder, ignore_errors=True)
    bag.notes[:0] = [note] if note else []
    return bag


def _read(path: Path, where: str) -> BagFile:
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


def _joined(copy: Path, beside: list[Path], where: str) -> str:
    """Let SQLite move what waits next to the copy of a database into it; return a note.

    Raises InputError for a journal that names another file, because SQLite would delete that file. Journals of
    transactions over several databases do so; a bag's journal does not.
    """
    if any(one.name.endswith(JOURNAL) and _names_another(one) for one in beside):
        raise InputError("the journal next to the bag names another file", where=where, found=f"NAME{JOURNAL}")
    names = " and ".join(f"{one.name} ({one.stat().st_size:,} bytes)" for one in beside)
    wal = Path(f"{copy}{WAL}")
    try:
        with closing(sqlite3.connect(copy)) as database:
            database.execute("SELECT count(*) FROM sqlite_master").fetchone()
            (page_bytes,) = database.execute("PRAGMA page_size").fetchone()
            waiting = max(0, wal.stat().st_size - WAL_HEAD_BYTES) if wal.exists() else 0
            _, pages, _ = database.execute("PRAGMA wal_checkpoint").fetchone()
            unused = waiting - max(0, pages) * (page_bytes + FRAME_HEAD_BYTES)
            database.execute("PRAGMA journal_mode = DELETE").fetchone()
    except sqlite3.DatabaseError as error:
        raise InputError("what is next to the bag cannot be used", where=where, found=f"{names}: {error}") from None
    rest = f"; SQLite does not use its last {unused:,} bytes: damaged, or left from an earlier use" if unused else ""
    return f"read together with {names} next to it, as SQLite does{rest}"


def _names_another(journal: Path) -> bool:
    with journal.open("rb") as file:
        file.seek(max(0, file.seek(0, 2) - len(OTHER_NAME)))
        return file.read() == OTHER_NAME


def zstd_module() -> Any:
    """Import the module for zstd: Python's own since 3.14, before that the one that rosbags depends on."""
    try:
        return import_module("compression.zstd")
    except ImportError:
        return import_module("backports.zstd")


def _beside(path: Path) -> list[Path]:
    """Return the files that SQLite left next to a file, if they are not empty."""
    beside = [path.with_name(path.name + ending) for ending in (WAL, JOURNAL)]
    left = [one for one in beside if one.exists()]
    for one in left:
        open_regular(one).close()
    return [one for one in left if one.stat().st_size]


def _inside(folder: Path) -> list[Path]:
    """Return the files of a folder whose names can be those of a bag's files."""
    names = sorted(one for one in folder.iterdir() if one.name.removesuffix(".zstd").endswith(ENDINGS))
    # A recorder that was killed while it compressed a file leaves both files.
    return [one for one in names if not one.is_dir() and not (one.suffix == ".zstd" and one.with_suffix("") in names)]


def _parts_beside(path: Path) -> list[Path]:
    """Return files next to one that have its name with another number, or that the folder's metadata list too."""
    part = PART.fullmatch(path.name)
    others: set[Path] = set()
    if part:
        for one in path.parent.iterdir():
            other = PART.fullmatch(one.name)
            if other and other[1] == part[1] and other[3][:4] == part[3][:4]:
                others.add(one)
    with suppress(InputError):  # the metadata next to it may be those of another bag
        listed = _listed(path.parent)[0] if (path.parent / METADATA).exists() else None
        others |= set(listed.paths) if listed is not None and path in listed.paths else set()
    return sorted(others - {path})


def _listed(folder: Path) -> tuple[Files | None, str]:
    """Return the files that the folder's metadata list; None and the reason if the metadata cannot be used."""
    from ruamel.yaml import YAML

    text = read_bytes(folder / METADATA, MOST_METADATA_BYTES)
    try:
        about = YAML(typ="safe").load(text)["rosbag2_bagfile_information"]
        names = [PurePath(name).name for name in about["relative_file_paths"]]
        packed = about.get("compression_format") or ""
        stated = about.get("message_count")
    except RecursionError:
        return None, "nested too deeply"
    except Exception as error:  # the YAML parser, and access to what it returns, raise all kinds of exceptions
        return None, (str(error).strip().splitlines() or [type(error).__name__])[0][:100]
    if not names:
        return None, "it lists no files"
    if packed not in ("", "none", "zstd"):
        raise InputError(
            "the compression of the bag is not supported",
            where=str(folder),
            expected="zstd",
            found=str(packed)[:40],
        )
    inside = _inside(folder)
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise _missing(folder, missing, inside)
    more = [one for one in inside if one.name not in names]
    note = (
        f"not read: {_file_names(more)}, which {METADATA} does not list; give the file itself to read it"
        if more
        else ""
    )
    paths = tuple(folder / name for name in dict.fromkeys(names))
    return Files(paths, (note,) if note else (), stated if type(stated) is int else None), ""


def _missing(folder: Path, missing: list[str], inside: list[Path]) -> InputError:
    return InputError(
        "a part of the bag is missing",
        where=str(folder),
        expected=", ".join(missing[:MOST_NAMED]),
        found=_file_names(inside) or "no bag file",
        hint=f"copy it into the folder, or import each part separately, for example {inside[0]}" if inside else "",
    )


def _file_names(files: list[Path]) -> str:
    names = [file.name for file in files]
    return ", ".join(names[:MOST_NAMED]) + (f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else "")
