"""Jobs on a running Dask cluster.

A job reads and writes its files itself. The cluster therefore needs storage that all its computers share; only paths
and rows are sent. A worker changes to the folder in which the command was started, so that paths, rows and recipes are
the same with every engine. A task is one job; submitting it costs some 10 ms.

While a command runs, it keeps a sign file next to the outputs. A worker that sees the file shares the storage. A
worker that no longer sees it has to stop, because Dask itself cannot end a running task.

There are never more tasks than workers, because Dask counts the death of a worker against every task assigned to it,
even tasks that only waited there. A worker runs one job at a time, since the working folder belongs to the whole
process.
"""

import itertools
import logging
import os
import platform
import queue
import threading
import time
import uuid
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evetac_cli import console, plugins
from evetac_cli.cli import workers
from evetac_cli.errors import EvetacError, InputError, shortened
from evetac_cli.interrupts import CTRL_C, SignalsLetThrough, signals_blocked
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
    parts: tuple[plugins.Plugin, ...] = ()  # plug-ins that the command uses


def check_worker(command: ClusterCommand) -> str:
    """Return the reason why this process cannot work for a command, after the words `the worker`; empty if it can."""
    if command.version != __version__:
        return f"has evetac {__version__}, but the command has evetac {command.version}"
    if reason := plugins.lacking(command.parts):
        return reason
    for path in (command.folder, command.sign.parent):
        if not path.is_dir():
            return f"does not see the folder {path}: no shared storage"
    return "" if command.sign.exists() else f"does not see the files in {command.sign.parent}: no shared storage"


def run_task(command: ClusterCommand, job: Job, seen: tuple[Path, ...]) -> Outcome | EvetacError | str | None:
    """Run a job and return its result; the reason if this process cannot, None if the worker had to stop.

    seen: the inputs of the job that exist on the computer of the command.
    """
    with _one_job_at_a_time:
        if reason := check_worker(command):
            return f"the worker on {platform.node()} {reason}"
        plugins.take_part(command.parts)
        before = Path.cwd()
        os.chdir(command.folder)
        try:
            for path in seen:
                if not path.exists():
                    message = f"a worker on {platform.node()} does not see this file: no shared storage"
                    return EvetacError(message, where=str(path))
            return workers.run_one(command.module, job, command.chosen, command.force, _stopping(command.sign))
        except KeyboardInterrupt:
            return None
        finally:
            os.chdir(before)


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


GRACE_S = 5.0  # time for workers to stop
CONNECT_S = 20.0


def run_on_dask(
    address: str,
    module: str,
    jobs: list[Job],
    params: Any,
    force: bool,
    progress: Progress,
    results: dict[Path, Outcome | EvetacError],
) -> None:
    """Run jobs as tasks of a Dask cluster, and store each result in `results` under its output, also on Ctrl-C.

    A job whose worker dies is run again by another worker.
    """
    with signals_blocked(CTRL_C):
        try:
            progress(0, 0, "waiting for the cluster")
            with _sign(jobs[0].output.parent) as sign, _client(address) as client:
                command = ClusterCommand(module, params, force, __version__, Path.cwd(), sign, plugins.parts())
                _Run(client, command, jobs, progress, results).run()
        finally:
            workers.remove_unfinished([job.output for job in jobs if not isinstance(results.get(job.output), Outcome)])


@contextmanager
def _sign(folder: Path) -> Iterator[Path]:
    """Yield the file that marks a running command, as an absolute path for workers; its folder is created if needed."""
    from evetac_cli.store.hdf5 import disk

    folder = folder.absolute()
    disk.existing_folder(folder)
    new_folders = disk.missing_folders(folder)
    folder.mkdir(parents=True, exist_ok=True)
    sign = disk.temporary_name(folder / "evetac-runs")
    try:
        sign.touch(exist_ok=False)
        yield sign
    finally:
        sign.unlink(missing_ok=True)
        disk.remove_empty(new_folders)


@contextmanager
def _client(address: str) -> Iterator[Any]:
    """Yield a client of the scheduler at an address; InputError if none answers."""
    from distributed import Client

    for name in list(logging.root.manager.loggerDict):
        if name.startswith("distributed"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # evetac reports what matters
    _require_scheduler(address)
    with Client(address, timeout=CONNECT_S, set_as_default=False) as client:
        yield client


def _require_scheduler(address: str) -> None:
    """Raise InputError unless a Dask scheduler answers, which is shown the certificate from Dask's settings.

    Without this check, Dask's client prints tracebacks or waits forever if something else answers.
    """
    import asyncio

    from distributed import Security
    from distributed.core import rpc

    async def role() -> Any:
        shown = Security().get_connection_args("client")
        async with rpc(address, connection_args=shown, timeout=CONNECT_S) as remote:
            return (await asyncio.wait_for(remote.identity(), CONNECT_S))["type"]

    try:
        answered = f"a {asyncio.run(role())} of Dask at {address}"
    except Exception as error:  # from any other program at this address
        answered = f"{address}: {shortened(str(error) or type(error).__name__)}"
    else:
        if "Scheduler" in answered:
            return
    raise InputError(
        "no Dask scheduler answers",
        where="--engine",
        found=answered,
        hint="start one: docs/cluster.md, By hand; with tls://, name its certificate in Dask's settings",
    )


class _Run:
    """The jobs of a command while they run on a cluster."""

    def __init__(
        self,
        client: Any,
        command: ClusterCommand,
        jobs: list[Job],
        progress: Progress,
        results: dict[Path, Outcome | EvetacError],
    ) -> None:
        self.client, self.command = client, command
        self.waiting = deque(jobs)
        self.count, self.done = len(jobs), 0
        self.progress, self.results = progress, results
        self.running: dict[Any, Job] = {}  # by their futures
        self.ended: queue.SimpleQueue[Any] = queue.SimpleQueue()  # futures
        self.name, self.numbers = f"evetac-{uuid.uuid4().hex}", itertools.count()
        self.workers: set[str] = set()  # all workers seen so far
        self.stopping = False

    def run(self) -> None:
        """Submit jobs and take results until all are done; KeyboardInterrupt if some were aborted."""
        self.progress(0, self.count, "files")
        if not self.client.nthreads():
            console.say("the cluster has no worker yet: waiting")
        try:
            while self.waiting or self.running:
                self._hand_out()
                self._take(self._wait())
        except (KeyboardInterrupt, InputError):
            self._stop()
            raise
        finally:
            self._tidy()

    def _hand_out(self) -> None:
        """Submit as many tasks as there are workers, so that a worker that joins later gets its share."""
        joined = set(self.client.nthreads())
        self.workers |= joined
        while self.waiting and len(self.running) < len(joined):
            job = self.waiting.popleft()
            seen = tuple(path for path in job.inputs if path.exists())
            future = self.client.submit(
                run_task,
                self.command,
                job,
                seen,
                key=f"{self.name}-{next(self.numbers)}",  # always new: Dask would reuse the result of an equal key
                pure=False,
            )
            self.running[future] = job
            future.add_done_callback(self.ended.put)

    def _wait(self) -> Any:
        """Return the next future that ended, or None; Ctrl-C is raised here."""
        with SignalsLetThrough(CTRL_C), suppress(queue.Empty):
            return self.ended.get(timeout=LOOK_S)
        return None

    def _take(self, future: Any) -> None:
        """Store the result of a task; InputError if its worker cannot be used."""
        if future is None:
            return
        job = self.running.pop(future)
        result = self._result(future, job)
        if isinstance(result, (Outcome, EvetacError)):
            self.results[job.output] = result
            self.done += 1
            self.progress(self.done, self.count, "files")
        elif result is not None and not self.stopping:
            hint = "install the same evetac and plug-ins on all computers, and keep the files on shared storage"
            raise InputError("a worker of the cluster cannot be used", where="--engine", found=result, hint=hint)

    def _result(self, future: Any, job: Job) -> Outcome | EvetacError | str | None:
        from concurrent.futures import CancelledError

        from distributed import KilledWorker

        try:
            result: Outcome | EvetacError | str | None = future.result()
        except KilledWorker as error:
            return EvetacError(
                f"{error.allowed_failures + 1} workers died during this job",
                where=str(job.output),
                found=f"the last was {error.last_worker.address}",
                hint="out of memory? use workers with more memory, or fewer workers per computer",
            )
        except (CancelledError, OSError):
            if future.status == "error":  # raised by the job itself
                raise
            raise EvetacError(
                "lost the connection to the Dask scheduler",
                where="--engine",
                hint="run the command again: finished files are kept",
            ) from None
        except ModuleNotFoundError as error:
            lacks = (error.name or "").partition(".")[0]  # the worker could not read the task
            if lacks in ("evetac_cli", *(part.module.partition(".")[0] for part in plugins.parts())):
                return f"a worker has no {lacks}"
            raise
        except RuntimeError as error:
            if "deserialization of the task graph" not in str(error):
                raise
            message, found = "the Dask scheduler cannot read the jobs", str(error.__cause__ or error)
            hint = "install evetac and its plug-ins also on the scheduler's computer"
            raise EvetacError(message, where="--engine", found=found, hint=hint) from None
        return result

    def _stop(self) -> None:
        """Signal workers to stop, and take results finished in time."""
        self.stopping = True
        self.command.sign.unlink(missing_ok=True)
        end_s = time.monotonic() + GRACE_S
        while self.running and (left_s := end_s - time.monotonic()) > 0:
            with suppress(queue.Empty):
                self._take(self.ended.get(timeout=left_s))
        self.client.cancel(list(self.running), force=True)

    def _tidy(self) -> None:
        """Let remaining workers remove the half-written files of workers that are gone from the same computers."""
        with suppress(Exception):  # a cluster that is gone cannot be asked
            if self.workers - set(self.client.nthreads()):
                outputs = [job.output for job in self.running.values()] + list(self.results)
                files = [self.command.folder / output for output in outputs]
                self.client.run(workers.remove_unfinished, files, on_error="ignore")
