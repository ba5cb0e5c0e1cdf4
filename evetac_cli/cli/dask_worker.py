"""What a worker of a Dask cluster does with some jobs of a command (dask_engine.py hands them out)."""

import os
import platform
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evetac_cli import __version__, kernel_cache, plugins
from evetac_cli.cli import workers
from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Job, Outcome, Progress

LOOK_S = 1.0  # so often a worker looks whether it has to stop, and the command for workers that joined
_one_job_at_a_time = threading.Lock()  # in a worker, which may have several threads


@dataclass(frozen=True)
class ClusterCommand:
    """What every worker has to know of a command: how its jobs are run, and what shows that it fits."""

    module: str
    chosen: Any
    force: bool
    version: str
    folder: Path  # in which it was started
    sign: Path  # the file that is there while it runs
    parts: tuple[plugins.Part, ...] = ()  # plug-ins that it uses


@dataclass(frozen=True)
class WorkerRefused:
    """Why a worker does not take jobs of a command."""

    reason: str


def check_worker(command: ClusterCommand) -> str:
    """Why this process cannot work for a command, in words; empty if it can."""
    if command.version != __version__:
        return f"has evetac {__version__}, and this is evetac {command.version}"
    if reason := plugins.lacking(command.parts):
        return reason
    for path in (command.folder, command.sign.parent):
        if not path.is_dir():
            return f"does not see the folder {path}: no shared storage"
    return "" if command.sign.exists() else f"does not see the files in {command.sign.parent}: no shared storage"


def run_task(
    command: ClusterCommand, jobs: list[Job], seen: list[tuple[Path, ...]]
) -> list[Outcome | EvetacError] | WorkerRefused:
    """What a worker does with some jobs, one after the other; fewer results if it was told to stop.

    seen: inputs of every job that the command itself sees.
    """
    with _one_job_at_a_time:
        if reason := check_worker(command):
            return WorkerRefused(reason)
        plugins.take_part(command.parts)
        kernel_cache.settle_for_this_process()
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
    stopping(0, 1)  # also between jobs that tell no progress
    return workers.run_one(command.module, job, command.chosen, command.force, stopping)


def _stopping(sign: Path) -> Progress:
    """Progress at which a job ends once the sign of its command is gone."""
    looked_s = time.monotonic()

    def report(done: float, total: float, doing: str = "") -> None:
        nonlocal looked_s
        if time.monotonic() - looked_s >= LOOK_S:
            looked_s = time.monotonic()
            if not sign.exists():
                raise KeyboardInterrupt

    return report
