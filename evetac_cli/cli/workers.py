"""Run jobs one after the other, or several at a time in separate processes, so that Ctrl-C always ends them.

Interrupts are also remembered (interrupts.py) and checked after every job. SIGTERM is treated as Ctrl-C.

The standard library's pools are not used: there, a killed worker takes the jobs of all others with it, and a worker
that is asked to end finishes its job first. Here each worker has its own pipe, which closes when either end dies.

Compiled code is kept (kernel_cache.py), so only the first command after an installation or an update waits for numba;
it reports that it compiles. `evetac doctor compile`, which `make setup` runs, compiles the code of all commands.
"""

import gc
import importlib
import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evetac_cli import console, plugins
from evetac_cli.errors import EvetacError, attach_outcome, attached_outcome, exit_code_words
from evetac_cli.interrupts import SignalsLetThrough, catch_interrupts, interrupt_received, signals_blocked
from evetac_cli.jobs import Job, Outcome, Progress, silent
from evetac_cli.kernels import kernel_cache

PATIENCE_S = 2.0  # shorter compilation is not reported
AGAIN_S = 5.0  # time between two reports


class Announcer:
    """Counts the functions that numba compiles. Nested: a function waits while those that it calls are compiled."""

    def __init__(self, quiet: bool, interrupted: Callable[[], bool], say: Callable[[str], None]) -> None:
        self.quiet, self.interrupted, self.say = quiet, interrupted, say
        self.waiting = self.done = 0
        self.spent_s = self.started_s = 0.0
        self.next_s = PATIENCE_S
        self.collects = False

    def on_start(self, happens: Any) -> None:
        """Note that the compilation of a function starts."""
        if self.waiting == 0:
            self.started_s = time.monotonic()
            self.collects = gc.isenabled()
            gc.disable()
        self.waiting += 1

    def on_end(self, happens: Any) -> None:
        """Note that the compilation of a function ended, with or without success, and report progress."""
        self.waiting -= 1
        self.done += 1
        spent_s = self.spent_s + time.monotonic() - self.started_s
        if self.waiting == 0:
            self.spent_s = spent_s
            if self.collects:
                gc.enable()
        if spent_s >= self.next_s and not self.quiet:
            self.next_s = spent_s + AGAIN_S
            self.say(f"compiling, once after installing: {self.done} functions so far, {spent_s:.0f} s")
        if self.interrupted() and sys.exc_info()[1] is None:  # otherwise it is already on its way
            raise KeyboardInterrupt


@contextmanager
def announced(
    *, quiet: bool, interrupted: Callable[[], bool] = lambda: False, say: Callable[[str], None] = console.say
) -> Iterator[None]:
    """Report every few seconds, within this context, how many functions have been compiled.

    interrupted: returns whether Ctrl-C was pressed. A callback of the compiler may swallow the exception that Ctrl-C
    raises. It is then raised again after the current function, and not only after all functions.

    Python's garbage collector is paused while a function is compiled: it would scan the compiler's data again and
    again, and the pause saves a seventh of the time. A command that calls no kernel does not load numba for this.
    """
    with ExitStack() as listening:

        def listen() -> None:
            from numba.core import event

            class Listener(Announcer, event.Listener):  # type: ignore[misc]
                """The Announcer as a listener of numba."""

            listening.enter_context(event.install_listener("numba:compile", Listener(quiet, interrupted, say)))

        kernel_cache.before_the_first_kernel(listen)
        listening.callback(kernel_cache.forget, listen)
        yield


if TYPE_CHECKING:  # `evetac --help` loads none of it
    from multiprocessing.connection import Connection
    from multiprocessing.context import SpawnContext

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # thread limits of numerical libraries
SAY_S = 0.2  # interval at which a worker reports its progress
GRACE_S = 0.5  # time for workers to clean up after they were asked to stop; then they are killed


def compute_on_one_thread() -> None:
    """Limit numerical libraries to one thread, in this process and its children, unless the user set another limit.

    The libraries start threads when they are loaded, needed or not, which takes as long as loading numpy itself.
    Threads of several workers would compete for the cores, and results depend on the number of threads.
    """
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")


def run_one(module: str, job: Job, params: Any, force: bool, progress: Progress = silent) -> Outcome | EvetacError:
    """Run one job of a stage and return its outcome, or the EvetacError that it raised."""
    try:
        stage = importlib.import_module(f"evetac_cli.{module}")
        if interrupt_received():  # swallowed while modules were loaded
            raise KeyboardInterrupt
        noticed = progress if job.exclusive else _noticing_interrupts(progress)  # devices shut down in their own order
        result: Outcome = stage.run(job, params, force=force, progress=noticed)
    except EvetacError as error:
        return error
    except Exception:
        if interrupt_received():
            raise KeyboardInterrupt from None
        raise
    if interrupt_received():
        raise attach_outcome(KeyboardInterrupt(), result)
    return result


def _noticing_interrupts(progress: Progress) -> Progress:
    """Return the same progress callback, but raising KeyboardInterrupt for an interrupt that was swallowed."""

    def report(done: float, total: float, doing: str = "") -> None:
        if interrupt_received():
            raise KeyboardInterrupt
        progress(done, total, doing)

    return report


def _in_worker(
    module: str, job: Job, params: Any, force: bool, progress: Progress = silent
) -> Outcome | EvetacError | None:
    """Run a job as run_one does, but end it quietly on Ctrl-C, which the parent reports; no job starts after that."""
    if interrupt_received():
        return None
    catch_interrupts(every=False)  # Ctrl-C comes from the terminal, and from the parent too
    try:
        with SignalsLetThrough():  # an interrupt that arrived while the process started is raised here
            return run_one(module, job, params, force, progress)
    except KeyboardInterrupt as error:
        finished: Outcome | None = attached_outcome(error)
        return finished


def _work(
    pipe: "Connection", module: str, params: Any, force: bool, quiet: bool, parts: tuple[plugins.Plugin, ...]
) -> None:
    """Run jobs from the pipe, one after the other, until it closes; end at once if the parent dies.

    For each job, the worker sends its progress and its outcome through the pipe, and messages for the user in between.
    parts: plug-ins that headers must name.
    """
    plugins.take_part(parts)
    threading.Thread(target=end_with_parent, daemon=True).start()

    if not getattr(importlib.import_module(f"evetac_cli.{module}"), "COMPILES", True):  # and needs no numba for that
        _work_off(pipe, module, params, force)
        return
    with announced(quiet=quiet, interrupted=interrupt_received, say=lambda text: _send_whole(pipe, text)):
        _work_off(pipe, module, params, force)


def _send_whole(pipe: "Connection", what: str | float) -> None:
    """Send a message during a job, with interrupts blocked: a truncated message would spoil all that follow."""
    with signals_blocked():
        pipe.send(what)


def _sending(pipe: "Connection") -> Progress:
    """Return a progress callback that sends the completed share of a job to the parent, every SAY_S."""
    announced_s = time.monotonic()

    def report(done: float, total: float, doing: str = "") -> None:
        nonlocal announced_s
        if doing or not total or time.monotonic() - announced_s < SAY_S:
            return
        announced_s = time.monotonic()
        _send_whole(pipe, min(done / total, 1.0))

    return report


def _work_off(pipe: "Connection", module: str, params: Any, force: bool) -> None:
    while True:
        try:
            job: Job = pipe.recv()
        except EOFError:
            return
        try:
            pipe.send(_in_worker(module, job, params, force, _sending(pipe)))
        except Exception as error:  # a defect: shown by the parent, as it would be without workers
            error.add_note(traceback.format_exc())
            pipe.send(error)


def end_with_parent() -> None:
    """Wait until the parent process has ended for any reason, then kill this one, whose result is no longer needed.

    The sentinel is a pipe that the parent keeps open. Files left on disk are removed by the next run.
    """
    import multiprocessing
    from multiprocessing.connection import wait

    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os.kill(os.getpid(), signal.SIGKILL)


class _Worker:
    """A worker process, its pipe, and its current job."""

    def __init__(self, context: "SpawnContext", module: str, params: Any, force: bool, quiet: bool) -> None:
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, module, params, force, quiet, plugins.parts()))
        self.process.start()
        theirs.close()
        self.job: Job | None = None
        self.share = 0.0  # completed share of the job

    def begin(self, job: Job) -> None:
        """Send a job to the worker; a dead worker is noticed when its result is read."""
        self.job, self.share = job, 0.0
        with suppress(OSError):
            self.pipe.send(job)

    def result(self) -> Any:
        """Return the next message, at the end the job's result, None if it was aborted, EvetacError if it died."""
        assert self.job is not None
        try:
            return self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            killed = self.process.exitcode == -signal.SIGKILL  # as the system does when memory runs out
            return EvetacError(
                "the worker process died",
                where=str(self.job.output),
                found=exit_code_words(self.process.exitcode),
                hint="out of memory? use fewer --jobs" if killed else "run again with --jobs 1 to see more details",
            )

    def interrupt(self) -> None:
        """Ask the worker to stop."""
        assert self.process.pid is not None
        with suppress(ProcessLookupError):
            os.kill(self.process.pid, signal.SIGINT)

    def end(self) -> None:
        """End the worker; it is killed if it has a job."""
        self.pipe.close()
        if self.job is not None:
            self.process.kill()
        self.process.join()


def run_parallel(
    module: str,
    jobs: list[Job],
    params: Any,
    force: bool,
    at_once: int,
    progress: Progress,
    results: dict[Path, Outcome | EvetacError],
    *,
    quiet: bool = True,
) -> None:
    """Run jobs in `at_once` processes, and store each result in `results` under its output, also on Ctrl-C.

    After Ctrl-C, workers have GRACE_S to stop and are then killed. If a worker dies, only its own job is lost. Unless
    `quiet`, the first worker reports when it has to compile.
    """
    import multiprocessing
    from multiprocessing import resource_tracker

    compute_on_one_thread()
    # Spawned, not forked: HDF5 does not support forking.
    context = multiprocessing.get_context("spawn")
    waiting = deque(jobs)
    workers: list[_Worker] = []
    interrupted = False
    progress(0, 0, f"starting {at_once} processes")
    resource_tracker.ensure_running()  # otherwise starting the first worker starts it, and unblocks interrupts
    # Workers inherit the block, and lift it while they work. Here interrupts are raised only between complete steps.
    with signals_blocked():
        try:
            while waiting or any(worker.job for worker in workers):
                missing = min(at_once - len(workers), len(waiting))
                for _ in range(missing):  # only the first one reports
                    workers.append(_Worker(context, module, params, force, quiet or bool(workers)))
                for worker in workers:
                    if worker.job is None and waiting:
                        worker.begin(waiting.popleft())
                for worker in _ready(workers):
                    interrupted |= _take(worker, workers, results)
                done = sum(job.output in results for job in jobs)
                progress(done + sum(worker.share for worker in workers if worker.job), len(jobs))
        except KeyboardInterrupt:
            interrupted = True
            _stop(workers, results)
        finally:
            for worker in workers:
                worker.end()
            begun = (job for job in jobs if job not in waiting)
            broken_off = [job.output for job in begun if not isinstance(results.get(job.output), Outcome)]
            remove_unfinished(broken_off)
    if interrupted:
        raise KeyboardInterrupt


def _ready(workers: Sequence[_Worker], timeout_s: float | None = None) -> list[_Worker]:
    """Wait for workers that sent a message or died; without a timeout, SIGINT and SIGTERM are raised here."""
    from multiprocessing.connection import wait

    busy = {worker.pipe: worker for worker in workers if worker.job is not None}
    with SignalsLetThrough() if timeout_s is None else nullcontext():
        return [busy[pipe] for pipe in wait(list(busy), timeout_s)]  # type: ignore[index]


def _take(worker: _Worker, workers: list[_Worker], results: dict[Path, Outcome | EvetacError]) -> bool:
    """Process a worker's message, and remove the worker if it died; return whether its job was interrupted."""
    result = worker.result()
    assert worker.job is not None
    if isinstance(result, float):
        worker.share = result
        return False
    if isinstance(result, str):
        console.say(result)
        return False
    output, worker.job = worker.job.output, None
    if worker.process.exitcode is not None:
        workers.remove(worker)
        worker.end()
        remove_unfinished([output])
    if isinstance(result, Exception) and not isinstance(result, EvetacError):
        raise result
    if result is not None:
        results[output] = result
    return result is None


def _stop(workers: list[_Worker], results: dict[Path, Outcome | EvetacError]) -> None:
    """Ask all workers to stop and wait briefly; what they finish goes into `results`."""
    for worker in workers:
        worker.interrupt()
    end_s = time.monotonic() + GRACE_S
    while any(worker.job for worker in workers) and (left_s := end_s - time.monotonic()) > 0:
        for worker in _ready(workers, left_s):
            _take(worker, workers, results)


def remove_unfinished(outputs: Sequence[Path]) -> None:
    """Remove temporary files that dead processes of this computer left next to these outputs."""
    from evetac_cli.store.hdf5 import disk

    for output in outputs:
        disk.remove_unfinished(output)
