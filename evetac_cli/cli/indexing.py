"""Reading the files of a data set for its index, in several processes."""

import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

from evetac_cli.cli import workers
from evetac_cli.errors import EvetacError
from evetac_cli.interrupts import ignore_interrupts

if TYPE_CHECKING:  # `evetac --help` loads none of it
    from evetac_cli.store.index import Describe, IndexRow, Seen

MOST_AT_ONCE = 64  # files handed to a process: handing them over takes as long as reading some
FEW = 20  # reading fewer files takes less time than starting a process


def describer(at_once: int) -> "Describe":
    """Return a function that describes files in this process, or in `at_once` processes."""
    from evetac_cli.store.index import one_by_one

    return one_by_one if at_once < 2 else partial(_in_processes, at_once)


def _in_processes(
    at_once: int, folder: Path, files: "Mapping[str, Seen]", progress: Callable[[int, int], None]
) -> "Iterator[IndexRow]":
    from evetac_cli.store.index import describe, one_by_one

    if len(files) < FEW:
        yield from one_by_one(folder, files, progress)
        return
    pool = ProcessPoolExecutor(at_once, get_context("spawn"), _begin)
    try:
        size = min(MOST_AT_ONCE, 1 + len(files) // (4 * at_once))
        rows = pool.map(partial(describe, folder), files, *zip(*files.values(), strict=True), chunksize=size)
        for number, row in enumerate(rows):
            progress(number, len(files))
            yield row
    except BrokenProcessPool as error:
        hint = "without --jobs, the file that crashes it is the last one shown"
        raise EvetacError("a process that reads files died", where=str(folder), found=str(error), hint=hint) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _begin() -> None:
    """Leave Ctrl-C to the parent process, and end with it."""
    ignore_interrupts()
    threading.Thread(target=workers.end_with_parent, daemon=True).start()
