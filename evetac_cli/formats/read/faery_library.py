"""The library faery, the extra `convert`: loading it, files for it, and telling its refusals from other errors."""

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from evetac_cli.errors import InputError, install_hint


def load_faery(what: str, where: str) -> Any:
    """The module faery; InputError that says for `what` it is needed where it is not installed or does not load."""
    try:
        import faery
    except ImportError as error:
        hint = install_hint("convert")
        raise InputError(f"{what} faery", where=where, found=str(error), hint=hint) from None
    return faery


@contextmanager
def scratch_file(ending: str = "") -> Iterator[tuple[Path, IO[bytes]]]:
    """An empty file while the block lasts, by path and open, because faery reads only what has a path.

    On Linux it has no name but the process's own for it: nothing is left of it, whatever ends the process.
    """
    if sys.platform == "linux":
        with tempfile.TemporaryFile() as file:
            yield Path(f"/proc/self/fd/{file.fileno()}"), file
    else:
        with tempfile.NamedTemporaryFile(suffix=ending) as named:
            yield Path(named.name), named.file


def refusal_text(error: BaseException) -> str:
    """The first line of what faery says; raises again what faery did not mean to say, such as KeyboardInterrupt.

    A panic of faery's Rust is a BaseException of a type that cannot be imported.
    """
    if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
        raise error
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
