"""How a worker of a Dask cluster runs jobs of a command, which dask_engine.py submits."""

import os
import platform
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evetac_cli import plugins
from evetac_cli.cli import workers
from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Job, Outcome, Progress
from evetac_cli.names import __version__

LOOK_S = 1.0  # interval at which a worker checks whether it must stop, and the command checks for new workers
_one_job_at_a_time = threading.Lock()  # a worker may have several threads


@dataclass(frozen=True)
class ClusterCommand:
    """Information on a command for every worker: how to run its jobs, and how to check that the worker is suitable."""

    module: str
    chosen: Any
    force: bool
    version: str
    folder: Path  # working folder of the command
    sign: Path  # file that exists while the command runs
    parts: tuple[plugins.Part, ...] = ()  # plug-ins that the command uses


@dataclass(frozen=True)
class WorkerRefused:
    """The reason why a worker refuses the jobs of a command."""

    reason: str


def check_worker(command: ClusterCommand) -> str:
    """Return the reason why this process cannot work for a command, as a text; empty if it can."""
    if command.version != __version__:
        return f"has evetac {__version__}, but the command has evetac {command.version}"
    if reason := plugins.lacking(command.parts):
        return reason
    for path in (command.folder, command.sign.parent):
        if not path.is_dir():
            return f"does not see the folder {path}: no shared storage"
    return "" if command.sign.exists() else f"does not see the files in {command.sign.parent}: no shared storage"


def run_task(
    command: ClusterCommand, jobs: list[Job], seen: list[tuple[Path, ...]]
) -> list[Outcome | EvetacError] | WorkerRefused:
    """Run some jobs one after the other and return their results; fewer results if the worker had to stop.

    seen: for each job, the inputs that exist on the computer of the command.
    """
    with _one_job_at_a_time:
        if reason := check_worker(command):
            return WorkerRefused(reason)
        plugins.take_part(command.parts)
        before = Path.cwd()
        os.chdir(command.folder)
        results: list[Outcome | EvetacError] = []
        try:
            stopping = _stopping(command.sign)
            for job, paths in zip(jobs, seen, strict=True):
                results.append(_run_job(command, job, paths, stopping))
        except KeyboardInterrupt:
            pass
        except Exception as error:
            plugins.note_culprits(error)
            raise
        finally:
            os.chdir(before)
        return results


def _run_job(command: ClusterCommand, job: Job, seen: tuple[Path, ...], stopping: Progress) -> Outcome | EvetacError:
    for path in seen:
        if not path.exists():
            return EvetacError(
                f"a worker on {platform.node()} does not see this file: no shared storage", where=str(path)
            )
    stopping(0, 1)  # checked between jobs too, for jobs that report no progress
    return workers.run_one(command.module, job, command.chosen, command.force, stopping)


def _stopping(sign: Path) -> Progress:
    """Return a progress callback that raises KeyboardInterrupt once the sign file of its command is gone."""
    looked_s = time.monotonic()

    def report(done: float, total: float, doing: str = "") -> None:
        nonlocal looked_s
        if time.monotonic() - looked_s >= LOOK_S:
            looked_s = time.monotonic()
            if not sign.exists():
                raise KeyboardInterrupt

    return report
