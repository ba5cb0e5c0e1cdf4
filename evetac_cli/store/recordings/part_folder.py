"""The folder NAME.part/ of a recording in progress: the files that a recorder writes, and removing only these.

The name of a folder does not prove that evetac made it, so files of the user in it are not removed.
"""

import re
from contextlib import suppress
from pathlib import Path

from evetac_cli.errors import InputError

STATIC = "static.h5"
LATE = "late.h5"  # datasets known only at the end, of a recording that is to be joined later
LOCK = "lock"
JOINED = "joined"  # marks a folder whose recording is complete but which was not removed
SEGMENT = "([0-9]{6,})[.](h5|tmp)"  # name of a segment; .tmp: possibly closed, but not yet renamed
OWN = re.compile(rf"{LOCK}|{JOINED}|(static|late)[.](h5|tmp)|{SEGMENT}")
MOST_NAMED = 3


def strange(folder: Path) -> list[str]:
    """Return the names of entries that were not written by a recorder."""
    return sorted(path.name for path in folder.iterdir() if not OWN.fullmatch(path.name) or not _is_file(path))


def refuse_strange(folder: Path) -> None:
    """Raise InputError if a folder has anything that was not written by a recorder."""
    names = strange(folder)
    if names:
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        message, hint = "this folder is not from a recording", "move it away, or use another name with -o"
        raise InputError(message, where=str(folder), found=", ".join(names[:MOST_NAMED]) + more, hint=hint)


def remove(folder: Path, *, keep: str = "") -> list[str]:
    """Remove a recorder's files, and the folder if it is then empty; return the names of remaining entries.

    keep: a file that stays, and with it the folder.
    """
    with suppress(OSError):  # an unreadable folder stays
        for path in folder.iterdir():
            if path.name != keep and OWN.fullmatch(path.name) and _is_file(path):
                with suppress(OSError):
                    path.unlink()
        left = [name for name in strange(folder) if name != keep]
        if not keep:
            folder.rmdir()
        return left
    return strange(folder) if folder.is_dir() else []


def _is_file(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()
