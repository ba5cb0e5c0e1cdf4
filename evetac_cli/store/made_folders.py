"""Atomic writing of folders with many files. A folder that has something in it is never replaced.

Others add to such folders what evetac cannot make again: a repository, notes, a card with a paragraph of their own.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from evetac_cli.errors import InputError
from evetac_cli.store.hdf5.disk import (
    existing_folder,
    locked,
    missing_folders,
    remove_empty,
    remove_with_contents,
    temporary_name,
)


def require_free(folder: Path) -> None:
    """Raise InputError if `folder` exists, unless it is empty, or if it cannot be created."""
    if not os.path.lexists(folder):
        existing_folder(folder.parent)
    elif folder.is_symlink() or not folder.is_dir():
        raise InputError("the output is not a folder", where=str(folder))
    elif any(folder.iterdir()):
        hint = "remove it first if you no longer need it, or write to another folder with -o NAME"
        raise InputError("the output exists, and a folder is never replaced", where=str(folder), hint=hint)


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yield a new folder, which becomes `folder` if the block succeeds, and is removed if it fails.

    InputError as for `require_free`, before the block and again after it, and if writing fails.
    """
    require_free(folder)
    new_parents = missing_folders(folder.parent)
    temporary = temporary_name(folder)
    try:
        temporary.mkdir(parents=True)
        yield temporary
        with locked(folder):
            require_free(folder)
            temporary.replace(folder)
    except BaseException as error:
        remove_with_contents(temporary)
        remove_empty(new_parents)
        if isinstance(error, OSError):
            raise InputError(f"cannot be written: {error.strerror or error}", where=str(folder)) from error
        raise
