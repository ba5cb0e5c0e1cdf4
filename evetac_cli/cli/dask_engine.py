"""Jobs on a Dask cluster: one that is there, or one that is started on this computer for as long as the jobs run.

A job reads and writes its files itself: the cluster needs storage that all its computers share, and only paths and rows
travel. A worker goes to the folder in which the command was started, so that paths, rows and recipes read the same on
every engine. A task is one job, or as many short ones as take TASK_S: handing out a task costs some 10 ms.

Why a file that lies beside the outputs while a command runs: a worker that sees it shares the storage, and one that no
longer sees it has to stop. Dask itself cannot end a task that has begun.

Why no more tasks than there are workers, and why a cluster of our own gives up a task with its worker: if a worker
dies, Dask counts that against every task that was handed to it, also those that only waited there, or that it moved
there from another that had died. So we hand out again ourselves. And jobs share the working folder of a worker, so that
it takes one at a time.
"""

import itertools
import logging
import pkgutil
import queue
import tempfile
import time
import uuid
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from evetac_cli import __version__, console, plugins
from evetac_cli.cli import workers
from evetac_cli.cli.dask_worker import LOOK_S, ClusterCommand, WorkerRefused, check_worker, run_task
from evetac_cli.cli.engines import Engine
from evetac_cli.errors import EvetacError, InputError, missing_extra, shortened
from evetac_cli.interrupts import CTRL_C, SignalsLetThrough, signals_blocked
from evetac_cli.jobs import Job, Outcome, Progress

GRACE_S = 5.0  # in which the workers of somebody's cluster may stop
DEATHS = 3  # of workers at the same job, then the job is at fault
TASK_S = 1.0  # shorter jobs are handed out together
CONNECT_S = 20.0
LOOPBACK = "127.0.0.1"


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

    workers.compute_on_one_thread()
    resource_tracker.ensure_running()  # or starting a worker does so, and lets interrupts through again
    # Ctrl-C of a terminal reaches all processes: workers that the cluster starts inherit this and stay deaf to it.
    with signals_blocked(CTRL_C):
        try:
            progress(0, 0, "waiting for the cluster")
            with _sign(jobs[0].output.parent) as sign, _client(engine, at_once) as client:
                command = ClusterCommand(module, chosen, force, __version__, Path.cwd(), sign, plugins.parts())
                _Run(client, command, jobs, progress, results, engine).run()
        finally:
            workers.remove_unfinished([job.output for job in jobs if not isinstance(results.get(job.output), Outcome)])


@contextmanager
def _sign(folder: Path) -> Iterator[Path]:
    """The file that says that a command runs, in a folder that is made for it; absolute, as workers need it."""
    from evetac_cli.store.hdf5 import disk

    folder = folder.absolute()
    disk.existing_folder(folder)
    made = disk.missing_folders(folder)
    folder.mkdir(parents=True, exist_ok=True)
    sign = disk.temporary_name(folder / "evetac-runs")
    try:
        sign.touch(exist_ok=False)
        yield sign
    finally:
        sign.unlink(missing_ok=True)
        disk.remove_empty(made)


@contextmanager
def _client(engine: Engine, at_once: int) -> Iterator[Any]:
    """A client of the cluster that is named, or of one that is started here; InputError if none answers."""
    from distributed import Client

    for name in list(logging.root.manager.loggerDict):
        if name.startswith("distributed"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # what matters is said in words, by us
    if engine.address:
        _require_scheduler(engine.address)
        with Client(engine.address, timeout=CONNECT_S, set_as_default=False) as client:
            yield client
        return
    with _own_cluster(at_once) as cluster, Client(cluster, set_as_default=False) as client:
        yield client


def _require_scheduler(address: str) -> None:
    """InputError unless a Dask scheduler answers there, to which we show the certificate that Dask's settings name.

    Why so: Dask's client leaves tracebacks, or waits for ever, where it meets something else.
    """
    import asyncio

    from distributed import Security
    from distributed.core import rpc

    async def role() -> Any:
        shown = Security().get_connection_args("client")
        if address.startswith("tls://") and shown["ssl_context"] is None:
            raise InputError(
                "this cluster asks for a certificate, and Dask's settings name none",
                where="--engine",
                found=address,
                hint="name the cluster's certificate in Dask's settings: docs/cluster.md, By hand",
            )
        async with rpc(address, connection_args=shown, timeout=CONNECT_S) as remote:
            return (await asyncio.wait_for(remote.identity(), CONNECT_S))["type"]

    try:
        answered = f"a {asyncio.run(role())} of Dask at {address}"
    except InputError:
        raise
    except Exception as error:  # of whatever may be there instead
        answered = f"{address}: {shortened(str(error) or type(error).__name__)}"
    else:
        if "Scheduler" in answered:
            return
    raise InputError(
        "no Dask scheduler answers",
        where="--engine",
        found=answered,
        hint="start one: docs/cluster.md, By hand; one with certificates is addressed by tls://",
    )


@contextmanager
def _own_cluster(at_once: int) -> Iterator[Any]:
    """A cluster of so many processes on this computer, which nobody else can give work to; EvetacError if it cannot be.

    Whoever can connect to a scheduler or a worker can run programs as its owner. So all of them, and the client, ask
    each other for a certificate that is made here and lies in their memory alone; none of them serves anything by
    HTTP; and their working folders lie in one that is this user's, and not below a name in /tmp that others can make.
    """
    import dask
    from distributed import LocalCluster, Security

    try:
        credentials = Security.temporary()
    except ImportError as error:
        what = "the library cryptography is needed for the cluster's certificates"
        where, otherwise = "--engine dask", "--engine local"
        raise missing_extra(what, "cluster", where=where, error=error, otherwise=otherwise) from None
    no_routes: dict[str, list[str]] = {f"distributed.{role}.http.routes": [] for role in ("scheduler", "worker")}
    settings = {
        "distributed.scheduler.allowed-failures": 0,
        "distributed.worker.profile.enabled": False,
        "distributed.admin.tick.interval": "1 s",  # each tick takes the interpreter from the job
        # Its default gives freed memory back at once, and the next array takes it anew, page by page.
        "distributed.nanny.pre-spawn-environ": dict.fromkeys(workers.ONE_THREAD, "1"),
        "distributed.comm.timeouts.connect": f"{CONNECT_S} s",
        **no_routes,
    }
    above = dask.config.get("temporary-directory", None)
    with (
        tempfile.TemporaryDirectory(prefix="evetac-dask-", dir=above, ignore_cleanup_errors=True) as folder,
        dask.config.set(settings | {"temporary-directory": folder}),
        LocalCluster(
            n_workers=at_once,
            threads_per_worker=1,
            processes=True,
            memory_limit=0,  # as for the engine local
            security=credentials,
            preload=[__name__],
            scheduler_kwargs={"dashboard": False, "dashboard_address": f"{LOOPBACK}:0", "preload": [__name__]},
            silence_logs=logging.CRITICAL,
        ) as cluster,
    ):
        yield cluster


def dask_setup(server: Any) -> None:
    """Close the HTTP server of a scheduler or worker of a cluster of our own; Dask calls this where it starts one."""
    for service in server.services.values():
        service.stop()


class _Run:
    """The jobs of a command on their way through a cluster."""

    def __init__(
        self,
        client: Any,
        command: ClusterCommand,
        jobs: list[Job],
        progress: Progress,
        results: dict[Path, Outcome | EvetacError],
        engine: Engine,
    ) -> None:
        self.client, self.command, self.engine = client, command, engine
        self.waiting = deque(jobs)
        self.count, self.done = len(jobs), 0
        self.progress, self.results = progress, results
        self.running: dict[Any, list[Job]] = {}  # by their futures
        self.alone = False  # every job a task of its own
        self.deaths: dict[Path, int] = {}  # of workers at a job, by its output
        self.took_s, self.took_jobs = 0.0, 0  # of workers, for all jobs that ended
        self.handed_out_s: dict[Any, float] = {}  # when, by futures
        self.ended: queue.SimpleQueue[Any] = queue.SimpleQueue()  # futures
        self.name, self.numbers = f"evetac-{uuid.uuid4().hex}", itertools.count()
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
            jobs = [self.waiting.popleft() for _ in range(self._task_size(usable))]
            seen = [tuple(path for path in job.inputs if path.exists()) for job in jobs]
            # Others may take what was meant for a worker that is gone: they refuse it, and it is handed out again.
            future = self.client.submit(
                run_task,
                self.command,
                jobs,
                seen,
                key=f"{self.name}-{next(self.numbers)}",  # never the same: Dask would give the result of the other
                pure=False,
                workers=self.fit,
                allow_other_workers=self.fit is not None,
            )
            self.running[future] = jobs
            self.handed_out_s[future] = time.monotonic()
            future.add_done_callback(self.ended.put)

    def _task_size(self, usable: int) -> int:
        """How many jobs make the next task: TASK_S of work, but so few that all workers end at about the same time."""
        if self.alone or not self.took_jobs:
            return 1
        last = -(-len(self.waiting) // (2 * usable))
        return max(1, min(last, int(TASK_S * self.took_jobs / max(self.took_s, 1e-6))))

    def _wait(self) -> Any:
        """The next future that ended, or None; here Ctrl-C comes up."""
        with SignalsLetThrough(CTRL_C), suppress(queue.Empty):
            return self.ended.get(timeout=LOOK_S)
        return None

    def _take(self, future: Any) -> None:
        """Note what came of jobs; those that were refused wait again."""
        if future is None:
            return
        jobs = self.running.pop(future)
        began_s = self.handed_out_s.pop(future)
        results = self._results(future, jobs)
        if isinstance(results, WorkerRefused):
            results = []
        if results:
            self.took_s += time.monotonic() - began_s
            self.took_jobs += len(results)
            self.results |= {job.output: result for job, result in zip(jobs, results, strict=False)}
            self.done += len(results)
            self.progress(self.done, self.count, "files")
        rest = jobs[len(results) :]
        if rest and not self.stopping:  # refused, or the file that says that the command runs was removed
            self.waiting.extendleft(reversed(rest))
            self._look_at_workers()

    def _results(self, future: Any, jobs: list[Job]) -> list[Outcome | EvetacError] | WorkerRefused:
        from concurrent.futures import CancelledError

        from distributed import KilledWorker

        try:
            results: list[Outcome | EvetacError] | WorkerRefused = future.result()
        except KilledWorker as error:
            if len(jobs) > 1:  # which of them it was shows when each is a task of its own
                self.alone = True
                return []
            output = jobs[0].output
            self.deaths[output] = deaths = self.deaths.get(output, 0) + error.allowed_failures + 1
            if deaths < DEATHS:
                return []
            return [
                EvetacError(
                    f"{deaths} workers died while they worked on it",
                    where=str(output),
                    found=f"the last was {error.last_worker.address}",
                    hint="out of memory? use workers with more of it, or fewer on a computer",
                )
            ]
        except (CancelledError, OSError):
            if future.status == "error":  # raised by the job itself
                raise
            raise EvetacError(
                "the connection to the Dask scheduler broke off",
                where="--engine",
                hint="run the command again: finished files are kept",
            ) from None
        except ModuleNotFoundError as error:
            lacks = (error.name or "").partition(".")[0]  # it could not even read the task
            if lacks == "evetac_cli":
                return WorkerRefused("has no evetac")
            for part in plugins.parts():
                if part.module.partition(".")[0] == lacks:
                    return WorkerRefused(f"has no {part.package}")
            raise
        except RuntimeError as error:
            if not plugins.parts() or "deserialization of the task graph" not in str(error):
                raise
            raise _unread_by_scheduler(error) from None
        return results

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
            command = replace(self.command, chosen=None)  # which may hold what a worker cannot read
            answers = self.client.run(check_worker, command, workers=others, on_error="return")
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
                hint="the same evetac and plug-ins on all computers, and files on storage that they share",
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
                outputs = [job.output for jobs in self.running.values() for job in jobs] + list(self.results)
                files = [self.command.folder / output for output in outputs]
                self.client.run(workers.remove_unfinished, files, on_error="ignore")


def _unread_by_scheduler(error: RuntimeError) -> EvetacError:
    """That the scheduler, which reads every task, cannot load the package of a plug-in."""
    packages = ", ".join(plugins.used())
    return EvetacError(
        f"the Dask scheduler cannot read the jobs, which need {packages}",
        where="--engine",
        found=str(error.__cause__ or "an error of Dask's"),
        hint=f"install {packages} where the scheduler runs, too",
    )
