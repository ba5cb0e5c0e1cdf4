"""The folder NAME.part/ of a recording in progress: which files a recorder writes into it, and removing these alone.

Why so: the name of a folder does not make it ours. What somebody put there, or had there before, is not removed.
"""

import re
from contextlib import suppress
from pathlib import Path

from evetac_cli.errors import InputError

STATIC = "static.h5"
LATE = "late.h5"  # what was known only at the end, of a recording that was left to be joined later
LOCK = "lock"
JOINED = "joined"  # in a folder whose recording is complete, and which was only not removed
SEGMENT = "([0-9]{6,})[.](h5|tmp)"  # its name; .tmp: closed, perhaps, but not yet renamed
OWN = re.compile(rf"{LOCK}|{JOINED}|(static|late)[.](h5|tmp)|{SEGMENT}")
MOST_NAMED = 3


def strange(folder: Path) -> list[str]:
    """Names of what no recorder wrote."""
    return sorted(path.name for path in folder.iterdir() if not OWN.fullmatch(path.name) or not _is_file(path))


def refuse_strange(folder: Path) -> None:
    """InputError where a folder holds anything that no recorder wrote."""
    names = strange(folder)
    if names:
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        message, hint = "this folder is not from a recording", "move it away, or write elsewhere with -o"
        raise InputError(message, where=str(folder), found=", ".join(names[:MOST_NAMED]) + more, hint=hint)


def remove(folder: Path, *, keep: str = "") -> list[str]:
    """Remove what a recorder wrote, and the folder if nothing else is in it; names of what is left.

    keep: a file that stays, and with it the folder.
    """
    with suppress(OSError):  # a folder that cannot be looked into stays
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
