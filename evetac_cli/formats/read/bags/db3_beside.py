"""Merge the files that SQLite leaves next to an unclosed database into a copy of it, and report losses.

    NAME-wal       pages that were written but not yet copied into the file: a head of 32 bytes, then frames, each of 24
                   bytes and a page; https://www.sqlite.org/walformat.html
    NAME-journal   pages as they were before an unfinished transaction, to be restored

SQLite merges both when it opens a database for writing, so this is done with a copy. SQLite uses the complete pages and
does not report the rest.
"""

import sqlite3
import struct
from contextlib import closing
from pathlib import Path

from evetac_cli.errors import InputError

WAL, JOURNAL = "-wal", "-journal"
FRAMES_AT = 32
PAGE_BYTES_AT, SALTS_AT = 8, 16  # in the head of -wal
FRAME = struct.Struct(">IIQ")  # page, pages of the file if a transaction ends here, the salts of the head
FRAME_HEAD_BYTES = 24
OTHER_NAME = bytes.fromhex("d9d505f920a163d7")  # end of a journal that names another file


def joined(copy: Path, where: str) -> str:
    """Merge the files next to the copy of a database into it; return a text on what is lost.

    Raises InputError for a journal that names another file, because SQLite would delete that file. Journals of
    transactions over several databases do so; a bag's journal does not.
    """
    journal, wal = (Path(f"{copy}{ending}") for ending in (JOURNAL, WAL))
    has_journal, has_wal = journal.exists(), wal.exists()
    if has_journal and _names_another(journal):
        raise InputError("the journal next to the bag names another file", where=where, found=f"NAME{JOURNAL}")
    try:
        with closing(sqlite3.connect(copy)) as database:
            database.execute("SELECT count(*) FROM sqlite_master").fetchone()
            _, frames, done = database.execute("PRAGMA wal_checkpoint").fetchone()
            lost = _lost_frames(wal, max(0, frames)) if has_wal else ""
            (mode,) = database.execute("PRAGMA journal_mode = DELETE").fetchone()
            if has_journal:
                (check,) = database.execute("PRAGMA quick_check(1)").fetchone()
                lost = lost or ("" if check == "ok" else str(check).splitlines()[0][:100])
    except sqlite3.DatabaseError as error:
        return str(error)
    return lost or ("" if mode == "delete" and frames == done else "SQLite could not merge all of it")


def _names_another(journal: Path) -> bool:
    if journal.stat().st_size < len(OTHER_NAME):
        return False
    with journal.open("rb") as file:
        file.seek(-len(OTHER_NAME), 2)
        return file.read() == OTHER_NAME


def _lost_frames(wal: Path, taken: int) -> str:
    """Return a text on finished transactions of a `-wal` that SQLite did not use.

    Frames of an earlier use of the file, which have other salts, and of an unfinished transaction are not counted.
    """
    size = wal.stat().st_size
    with wal.open("rb") as file:
        head = file.read(FRAMES_AT)
        if len(head) < FRAMES_AT:
            return "its header is cut short"
        page_bytes = int.from_bytes(head[PAGE_BYTES_AT : PAGE_BYTES_AT + 4])
        salts = int.from_bytes(head[SALTS_AT : SALTS_AT + 8])
        step = FRAME_HEAD_BYTES + max(1, page_bytes)
        finished = 0
        for at in range(FRAMES_AT + taken * step, size - step + 1, step):
            file.seek(at)
            page, pages, of = FRAME.unpack(file.read(FRAME.size))
            finished += (pages > 0 and of == salts) or not page
    if not taken and size > FRAMES_AT:
        return "SQLite finds no complete transaction in it"
    if finished:
        return f"SQLite stops at damaged bytes, with {finished:,} transactions or empty pages after them"
    rest = (size - FRAMES_AT) % step
    return f"its last {rest:,} bytes are an incomplete page" if rest else ""
