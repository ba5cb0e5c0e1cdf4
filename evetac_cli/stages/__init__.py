"""Stages: one module or folder per command, which defines its outputs and how they are made from its inputs.

A stage has OUTPUT (a kind of file), METHOD (raised when its numbers change) and two functions:
`jobs(files, params, out)` returns which outputs will be made from which inputs, `run(job, params, ...)` makes one.
`record` and `grasp` are stages too; their jobs are trials (evetac_cli/trials/).
"""

from collections.abc import Iterator
from pathlib import Path

from evetac_cli.jobs import Job

BLOCK_ROWS = 1000  # rows in memory at a time, so that memory does not grow with the length of a recording


def per_file(files: list[Path], kind: str, out: Path | None) -> list[Job]:
    """Return a job for every input file, with its output next to it, in the folder `out`, or (one input) at `out`."""
    from evetac_cli.store.files import output_path

    return [Job((file,), output_path(file, kind, out)) for file in files]


def output_in(out: Path | None, folder: Path, name: str, suffix: str = ".h5") -> Path:
    """Return `out` if it is the name of a file, otherwise a file of this name in the folder `out`, or in `folder`."""
    return out if out is not None and out.suffix == suffix else (out or folder) / name


def row_blocks(rows: int, most: int | None = None) -> Iterator[tuple[int, int]]:
    """Yield the ranges [first, stop) of rows to process together; one empty range if there are no rows."""
    most = most or BLOCK_ROWS
    for first in range(0, max(rows, 1), most):
        yield first, min(first + most, rows)
