"""Find the files of a bag, and make each readable without changing any of them.

Files next to a bag's file may belong to it. A ROS 2 recorder that was killed leaves messages in `NAME.db3-wal`. SQLite
merges them when it opens the file for writing; so such a file is copied, and they are merged into the copy. A bag of
several files is read as one if its folder is given. If a single file is given, the notes list the files next to it.
"""

import os
import re
import shutil
import weakref
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from itertools import islice
from pathlib import Path, PurePath
from tempfile import gettempdir, mkdtemp
from typing import Any, NamedTuple

from evetac_cli.errors import InputError
from evetac_cli.formats.read.bags import db3_rows, mcap_records, rosbag1_records
from evetac_cli.formats.read.bags.bag_chunks import ChunkedFile
from evetac_cli.formats.read.bags.db3_beside import JOURNAL, WAL, joined
from evetac_cli.formats.read.bags.db3_rows import Db3File
from evetac_cli.formats.read.bags.mcap_records import McapFile
from evetac_cli.formats.read.bags.rosbag1_records import Rosbag1File
from evetac_cli.formats.read.bags.rosbag_unpacking import unpack_file
from evetac_cli.store.hdf5.disk import temporary_name
from evetac_cli.text_files import open_regular, read_bytes

ZSTD = b"\x28\xb5\x2f\xfd"
METADATA = "metadata.yaml"
MOST_METADATA_BYTES = 1 << 20  # a topic takes a few hundred bytes
BAGS: dict[bytes, Callable[[Path, str], ChunkedFile | Db3File]] = {
    db3_rows.MAGIC: Db3File,
    mcap_records.MAGIC: McapFile,
    rosbag1_records.MAGIC: Rosbag1File,
}
ENDINGS = (".db3", ".mcap")  # of the files in a bag's folder; `.zstd` may follow
PART = re.compile(r"(.*?)(?:[-_]\d{4}(?:-\d\d){5})?_(\d+)(\.bag(?:\.active)?|\.db3|\.mcap)(\.zstd)?")
MOST_NAMED = 8


class Files(NamedTuple):
    """The files of a bag in order, notes on them, and the number of messages that the folder's metadata state."""

    paths: list[Path]
    notes: list[str]
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
        return Files([path], [more] if more else [])
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
    return Files(files, [f"{note}; read {_file_names(files)}"])


def opened(path: Path, where: str) -> tuple[ChunkedFile | Db3File, list[str], bool]:
    """Return a file of a bag with its table, notes on how it was made readable, and whether data is missing."""
    stamps = tuple(_stamp(one) for one in (path, *_beside(path)))
    readable = _readable(path, stamps, where)
    return _table(readable.path, stamps, where), readable.notes, readable.cut_short


class _Readable:
    """A file that can be read as it is, or a copy of it that is removed with this object."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        self.cut_short = False

    def copy(self) -> Path:
        """Return the path for the copy in a new temporary folder; remove folders left by processes that have ended."""
        name = temporary_name(Path(gettempdir()) / "evetac-bag").name
        folder = mkdtemp(prefix=name.removesuffix("tmp"), suffix=".tmp")
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self.path = Path(folder) / "copy"
        return self.path


@lru_cache(maxsize=2)
def _readable(path: Path, stamps: tuple[Any, ...], where: str) -> _Readable:
    """Return the file itself, or a copy: unpacked, merged with SQLite's files next to it, or without a half page."""
    readable = _Readable(path)
    size = stamps[0][1]
    with open_regular(path) as file:
        head = file.read(db3_rows.HEAD_BYTES)
        file.seek(0)
        if head.startswith(ZSTD):
            with readable.copy().open("w+b") as target:
                if not unpack_file(file, size, target):
                    readable.notes.append("the compressed file is cut short")
                    readable.cut_short = True
                target.flush()
                size = os.fstat(target.fileno()).st_size
                target.seek(0)
                target.truncate(size - _half_page(target.read(db3_rows.HEAD_BYTES), size))
            return readable
        beside = _beside(path) if head.startswith(db3_rows.MAGIC) else []
        rest = _half_page(head, size)
        if not rest and not beside:
            return readable
        with readable.copy().open("wb") as target:
            shutil.copyfileobj(file, target, 1 << 20)
            target.truncate(size - rest)
    if rest:
        readable.notes.append(f"left out the last {rest:,} bytes, an incomplete page")
        readable.cut_short = True
    for one in beside:
        shutil.copyfile(one, f"{readable.path}{one.name.removeprefix(path.name)}")
    if (path, *beside) != (path, *_beside(path)) or tuple(_stamp(one) for one in (path, *beside)) != stamps:
        raise InputError("the bag is still being written", where=where, hint="stop the recorder first")
    names = " and ".join(f"{one.name} ({one.stat().st_size:,} bytes)" for one in beside)
    if beside and (lost := joined(readable.path, where)):
        readable.notes.append(f"part of {names} is lost: {lost}")
        readable.cut_short = True
    elif beside:
        readable.notes.append(f"read together with {names} next to it, as SQLite does")
    return readable


def _half_page(head: bytes, size: int) -> int:
    """Return the size of an incomplete page at the end of a database; SQLite would read its missing bytes as zeros."""
    return size % db3_rows.page_bytes(head) if head.startswith(db3_rows.MAGIC) else 0


@lru_cache(maxsize=16)
def _table(path: Path, stamps: tuple[Any, ...], where: str) -> ChunkedFile | Db3File:
    """Return the table of a file, cached as long as the file does not change; `where`: the name in messages."""
    del stamps
    with path.open("rb") as file:
        head = file.read(max(map(len, BAGS)))
    reader = next((reader for begins, reader in BAGS.items() if head.startswith(begins)), None)
    if reader is None:
        expected = "SQLite (.db3), MCAP or a ROS 1 bag"
        raise InputError("not a bag file", where=where, expected=expected, found=f"begins with {head[:13]!r}")
    return reader(path, where)


def _stamp(path: Path) -> tuple[str, int, int, int]:
    state = path.stat()
    return str(path), state.st_size, state.st_mtime_ns, state.st_ino


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
    paths = [folder / name for name in dict.fromkeys(names)]
    return Files(paths, [note] if note else [], stated if type(stated) is int else None), ""


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
