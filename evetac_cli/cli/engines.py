"""Where jobs run: on this computer (`local`, workers.py), or on a Dask cluster (`dask`, dask_engine.py)."""

from contextlib import suppress
from dataclasses import dataclass

from evetac_cli.errors import InputError
from evetac_cli.jobs import Job

LOCAL, DASK = "local", "dask"
SCHEMES = ("tls://", "tcp://")


@dataclass(frozen=True)
class Engine:
    """The value of `--engine`: its name, and the address of an existing Dask scheduler, if given."""

    name: str
    address: str = ""

    @classmethod
    def parse(cls, text: str) -> "Engine":
        """Read `local`, `dask` or `dask:ADDRESS`; InputError for anything else."""
        name, _, address = text.partition(":")
        if name not in (LOCAL, DASK) or (text != name and not (name == DASK and address.startswith(SCHEMES))):
            expected = "local, dask, dask:tls://ADDRESS:PORT or dask:tcp://ADDRESS:PORT"
            raise InputError("unknown engine", where="--engine", expected=expected, found=text)
        return cls(name, address)


def largest_first(jobs: list[Job]) -> list[Job]:
    """Return the jobs sorted by the bytes of their inputs, largest first, so that short jobs end last; stable."""

    def size(job: Job) -> int:
        total = 0
        for path in job.inputs:
            with suppress(OSError):
                total += path.stat().st_size
        return total

    return sorted(jobs, key=size, reverse=True)
