"""Where jobs run: on this computer (`local`, workers.py), or on a Dask cluster (`dask`, `dask:tcp://ADDRESS`).

A task is one job, which reads and writes its files itself: the cluster needs storage that all its computers share, and
only paths and rows travel. A worker goes to the folder in which the command was started, so that paths, rows and
recipes read the same on every engine.

Why a file that lies beside the outputs while a command runs: a worker that sees it shares the storage, and one that no
longer sees it has to stop. Dask itself cannot end a task that has begun.

Why no more tasks than there are workers: if one dies, Dask counts that against every task that was handed to it, also
those that only waited there. And jobs share the working folder of a worker, so that it takes one at a time.
"""

import logging
import os
import pkgutil
import platform
import queue
import signal
import threading
import time
import uuid
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evetac_cli import __version__, console, resources
from evetac_cli.cli import workers
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.jobs import Job, Outcome, Progress

LOCAL, DASK = "local", "dask"
LOOK_S = 1.0  # so often a worker looks whether it has to stop, and the command for workers that joined
GRACE_S = 5.0  # in which the workers of somebody's cluster may stop
DEATHS = 3  # of workers at the same job, then the job is at fault
CONNECT_S = 20.0
_one_job_at_a_time = threading.Lock()  # in a worker, which may have several threads


@dataclass(frozen=True)
class Engine:
    """What `--engine` names: its name, and the address of a Dask scheduler, if there is one already."""

    name: str
    address: str = ""

    @classmethod
    def parse(cls, text: str) -> "Engine":
        """Read `local`, `dask` or `dask:ADDRESS`; InputError for anything else."""
        name, _, address = text.partition(":")
        if name not in (LOCAL, DASK) or (text != name and not (name == DASK and "://" in address)):
            expected = "local, dask, or dask:tcp://ADDRESS:PORT"
            raise InputError("unknown engine", where="--engine", expected=expected, found=text)
        return cls(name, address)


@dataclass(frozen=True)
class Command:
    """What every worker has to know of a command: how its jobs are run, and what shows that it fits."""

    module: str
    chosen: Any
    force: bool
    version: str
    folder: Path  # in which it was started
    sign: Path  # the file that is there while it runs


def largest_first(jobs: list[Job]) -> list[Job]:
    """Jobs by the bytes of their inputs: the last to end are then short ones. Equal ones stay as they are."""

    def size(job: Job) -> int:
        total = 0
        for path in job.inputs:
            with suppress(OSError):
                total += path.stat().st_size
        return total

    return sorted(jobs, key=size, reverse=True)


# --- in a worker ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Refused:
    """Why a worker does not take jobs of a command."""

    reason: str


def check_worker(command: Command) -> str:
    """Why this process cannot work for a command, in words; empty if it can."""
    if command.version != __version__:
        return f"has evetac {__version__}, and this is evetac {command.version}"
    for path in (command.folder, command.sign.parent):
        if not path.is_dir():
            return f"does not see the folder {path}: no shared storage"
    return "" if command.sign.exists() else f"does not see the files in {command.sign.parent}: no shared storage"


def run_task(command: Command, job: Job, seen: tuple[Path, ...]) -> Outcome | EvetacError | Refused | None:
    """What a worker does with one job; None if it was told to stop. seen: inputs that the command itself sees."""
    with _one_job_at_a_time:
        if reason := check_worker(command):
            return Refused(reason)
        resources.find_kernel_cache()
        before = Path.cwd()
        os.chdir(command.folder)
        try:
            for path in seen:
                if not path.exists():
                    return EvetacError(
                        f"a worker on {platform.node()} does not see this file: no shared storage", where=str(path)
                    )
            return workers.run_one(command.module, job, command.chosen, command.force, _stopping(command.sign))
        except KeyboardInterrupt:
            return None
        finally:
            os.chdir(before)


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


# --- in the command ---------------------------------------------------------------------------------------------------


def run_on_dask(
    engine: Engine,
    module: str,
    jobs: list[Job],
    chosen: Any,
    force: bool,
    at_once: int,
    progress: Progress,
    results: dict[Path, Outcome | EvetacError],
) -> None:
    """Run jobs as tasks of a Dask cluster; what came of each goes into `results`, by its output, also on Ctrl-C.

    Without an address a cluster of `at_once` processes is started on this computer, and ended. A job whose worker dies
    runs again elsewhere.
    """
    from multiprocessing import resource_tracker

    for name in workers.ONE_THREAD:
        os.environ.setdefault(name, "1")
    resource_tracker.ensure_running()  # or starting a worker does so, and lets interrupts through again
    # Ctrl-C of a terminal reaches all processes: workers that the cluster starts inherit this and stay deaf to it.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        progress(0, 0, "waiting for the cluster")
        with _sign(jobs[0].output.parent) as sign, _client(engine, at_once) as client:
            command = Command(module, chosen, force, __version__, Path.cwd(), sign)
            _Run(client, command, jobs, progress, results, engine).run()
    finally:
        workers.remove_unfinished([job.output for job in jobs if not isinstance(results.get(job.output), Outcome)])
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _sign(folder: Path) -> Iterator[Path]:
    """The file that says that a command runs, in a folder that is made for it; absolute, as workers need it."""
    from evetac_cli.store import disk

    folder = folder.absolute()
    disk.existing_folder(folder)
    made = disk.missing_folders(folder)
    folder.mkdir(parents=True, exist_ok=True)
    sign = disk.temporary_name(folder / "evetac-runs")
    try:
        sign.touch()
        yield sign
    finally:
        sign.unlink(missing_ok=True)
        disk.remove_empty(made)


@contextmanager
def _client(engine: Engine, at_once: int) -> Iterator[Any]:
    """A client of the cluster that is named, or of one that is started here; InputError if none answers."""
    import dask
    from distributed import Client, LocalCluster

    for name in list(logging.root.manager.loggerDict):
        if name.startswith("distributed"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # what matters is said in words, by us
    if engine.address:
        try:
            client = Client(engine.address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                "no Dask scheduler answers",
                where="--engine",
                found=f"{engine.address}: {error}",
                hint="start one: dask scheduler; then workers: dask worker ADDRESS --nthreads 1",
            ) from None
        with client:
            yield client
        return
    settings = {
        "distributed.scheduler.allowed-failures": DEATHS - 1,
        "distributed.worker.profile.enabled": False,
        "distributed.comm.timeouts.connect": f"{CONNECT_S} s",
    }
    with (
        dask.config.set(settings),
        LocalCluster(
            n_workers=at_once,
            threads_per_worker=1,
            processes=True,
            memory_limit=0,  # as for the engine local
            dashboard_address=None,
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


class _Run:
    """The jobs of a command on their way through a cluster."""

    def __init__(
        self,
        client: Any,
        command: Command,
        jobs: list[Job],
        progress: Progress,
        results: dict[Path, Outcome | EvetacError],
        engine: Engine,
    ) -> None:
        self.client, self.command, self.engine = client, command, engine
        self.waiting = deque(jobs)
        self.count, self.done = len(jobs), 0
        self.progress, self.results = progress, results
        self.running: dict[Any, Job] = {}  # by their futures
        self.ended: queue.SimpleQueue[Any] = queue.SimpleQueue()  # futures
        self.name = f"evetac-{uuid.uuid4().hex}"
        self.workers: set[str] = set()  # all that there ever were
        self.fit: list[str] | None = None  # those that may be used; None: all, also those that join
        self.said: set[str] = set()
        self.stopping = False

    def run(self) -> None:
        """Hand out jobs and take results until all are there; KeyboardInterrupt if some were broken off."""
        self.progress(0, self.count, "files")
        self._look_at_workers()
        try:
            while self.waiting or self.running:
                self._hand_out()
                self._take(self._wait())
        except KeyboardInterrupt:
            self._stop()
            raise
        finally:
            self._tidy()

    def _hand_out(self) -> None:
        """As many jobs as there are workers, so that one that joins gets its share."""
        joined = set(self.client.nthreads())
        if self.fit is not None and joined - self.workers:  # who joined may be fit
            self._look_at_workers()
        self.workers |= joined
        usable = len(joined if self.fit is None else joined & set(self.fit))
        while self.waiting and len(self.running) < usable:
            job = self.waiting.popleft()
            seen = tuple(path for path in job.inputs if path.exists())
            key = f"{self.name}-{self.count - len(self.waiting)}"
            # Others may take what was meant for a worker that is gone: they refuse it, and it is handed out again.
            future = self.client.submit(
                run_task,
                self.command,
                job,
                seen,
                key=key,
                pure=False,
                workers=self.fit,
                allow_other_workers=self.fit is not None,
            )
            self.running[future] = job
            future.add_done_callback(self.ended.put)

    def _wait(self, timeout_s: float = LOOK_S) -> Any:
        """The next future that ended, or None; here Ctrl-C comes up."""
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        try:
            return self.ended.get(timeout=timeout_s)
        except queue.Empty:
            return None
        finally:
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})

    def _take(self, future: Any) -> None:
        """Note what came of a job; one that was refused waits again."""
        if future is None:
            return
        job = self.running.pop(future)
        result = self._result(future, job)
        if isinstance(result, Outcome | EvetacError):
            self.results[job.output] = result
            self.done += 1
            self.progress(self.done, self.count, "files")
        elif not self.stopping:  # refused, or the file that says that the command runs was removed
            self.waiting.appendleft(job)
            self._look_at_workers()

    def _result(self, future: Any, job: Job) -> Outcome | EvetacError | Refused | None:
        from concurrent.futures import CancelledError

        from distributed import KilledWorker

        try:
            result: Outcome | EvetacError | Refused | None = future.result()
        except KilledWorker as error:
            return EvetacError(
                f"{error.allowed_failures + 1} workers died while they worked on it",
                where=str(job.output),
                found=f"the last was {error.last_worker.address}",
                hint="out of memory? use workers with more of it, or fewer on a computer",
            )
        except (CancelledError, OSError):
            if future.status == "error":  # raised by the job itself
                raise
            raise EvetacError(
                "the connection to the Dask scheduler broke off",
                where="--engine",
                hint="run the command again: finished files are kept",
            ) from None
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] != "evetac_cli":
                raise
            return Refused("has no evetac")  # it could not even read the task
        return result

    def _look_at_workers(self) -> None:
        """Leave out workers that do not fit, and say so; InputError if none ever did."""
        versions = self.client.run(pkgutil.resolve_name, "evetac_cli:__version__", on_error="return")
        reasons = {
            address: "has no evetac that can be loaded"
            for address, version in versions.items()
            if isinstance(version, BaseException)
        }
        others = [address for address in versions if address not in reasons]
        if others:
            answers = self.client.run(check_worker, self.command, workers=others, on_error="return")
            reasons |= {
                address: f"fails: {reason}" if isinstance(reason, BaseException) else reason
                for address, reason in answers.items()
                if reason
            }
        if not versions:
            console.say("the cluster has no worker yet: waiting")
        if not reasons:
            self.fit = None
            return
        words = [f"the worker {address} {reason}" for address, reason in reasons.items()]
        if len(reasons) == len(versions) and not self.workers - set(reasons):
            raise InputError(
                "no worker of the cluster can be used",
                where="--engine",
                found="; ".join(words),
                hint="the same evetac on all computers, and files on storage that they share",
            )
        for line in words:
            if line not in self.said:
                console.say(f"left out: {line}")
        self.said |= set(words)
        self.fit = sorted(set(versions) - set(reasons))

    def _stop(self) -> None:
        """Tell workers to stop, and take what they finish in time; those of our own cluster are killed then."""
        self.stopping = True
        self.command.sign.unlink(missing_ok=True)
        end_s = time.monotonic() + (GRACE_S if self.engine.address else workers.GRACE_S)
        while self.running and (left_s := end_s - time.monotonic()) > 0:
            with suppress(queue.Empty):
                self._take(self.ended.get(timeout=left_s))
        self.client.cancel(list(self.running), force=True)

    def _tidy(self) -> None:
        """Remove what workers that are gone left half written, by workers that are still on their computers."""
        if not self.engine.address:
            return
        with suppress(Exception):  # a cluster that is gone cannot be asked
            if self.workers - set(self.client.nthreads()):
                outputs = [job.output for job in self.running.values()] + list(self.results)
                files = [self.command.folder / output for output in outputs]
                self.client.run(workers.remove_unfinished, files, on_error="ignore")
