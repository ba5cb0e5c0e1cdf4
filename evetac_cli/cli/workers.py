"""Run jobs, one after the other or several at a time in processes of their own, so that Ctrl-C always ends them.

Interrupts are remembered too (interrupts.py), and looked at after every job. SIGTERM is treated as Ctrl-C.

Why no pool of the standard library: there a worker that is killed takes the jobs of all others along, and one that was
only told to end finishes its job first. Here each worker has a pipe of its own, which closes when either end dies.
"""

import importlib
import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evetac_cli import console, plugins
from evetac_cli.cli import compiling
from evetac_cli.errors import EvetacError, attach_outcome, attached_outcome, exit_code_words
from evetac_cli.interrupts import SignalsLetThrough, catch_interrupts, interrupt_came, signals_blocked
from evetac_cli.jobs import Job, Outcome, Progress, silent

if TYPE_CHECKING:  # `evetac --help` loads none of it
    from multiprocessing.connection import Connection
    from multiprocessing.context import SpawnContext

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # of numerical libraries
SAY_S = 0.2  # so often a worker tells how far it is
GRACE_S = 0.5  # in which workers that were told to stop may clean up; then they are killed


def compute_on_one_thread() -> None:
    """Have numerical libraries start no threads in this process and those that it starts, unless the user says so.

    Why so: they start them when they are loaded, needed or not, which takes as long as loading numpy itself; threads of
    several workers would fight over the cores; and one thread gives one result.
    """
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")


def run_one(module: str, job: Job, chosen: Any, force: bool, progress: Progress = silent) -> Outcome | EvetacError:
    """Run one job of a stage; an error in words is its result."""
    try:
        stage = importlib.import_module(f"evetac_cli.{module}")
        if interrupt_came():  # swallowed while modules were loaded
            raise KeyboardInterrupt
        noticed = progress if job.exclusive else _noticing_interrupts(progress)  # devices end in order of their own
        result: Outcome = stage.run(job, chosen, force=force, progress=noticed)
    except EvetacError as error:
        return error
    except Exception:
        if interrupt_came():
            raise KeyboardInterrupt from None
        raise
    if interrupt_came():
        raise attach_outcome(KeyboardInterrupt(), result)
    return result


def _noticing_interrupts(progress: Progress) -> Progress:
    """The same progress, at which an interrupt that was swallowed comes up."""

    def report(done: float, total: float, doing: str = "") -> None:
        if interrupt_came():
            raise KeyboardInterrupt
        progress(done, total, doing)

    return report


def _in_worker(
    module: str, job: Job, chosen: Any, force: bool, progress: Progress = silent
) -> Outcome | EvetacError | None:
    """As run_one, but Ctrl-C ends the job quietly: the parent process reports it. Nothing is begun after it."""
    if interrupt_came():
        return None
    catch_interrupts(every=False)  # Ctrl-C comes from the terminal, and from the parent too
    try:
        with SignalsLetThrough():  # one that came while the process started, comes up now
            return run_one(module, job, chosen, force, progress)
    except KeyboardInterrupt as error:
        finished: Outcome | None = attached_outcome(error)
        return finished


def _work(
    pipe: "Connection", module: str, chosen: Any, force: bool, quiet: bool, parts: tuple[plugins.Part, ...]
) -> None:
    """What a worker process does: job after job from the pipe, until it closes; at once ended if the parent dies.

    Through the pipe come back, of each job, the part that is done and what came of it; in between what is to be said.
    parts: plug-ins that headers are to name.
    """
    plugins.take_part(parts)
    threading.Thread(target=_end_with_parent, daemon=True).start()

    if not getattr(importlib.import_module(f"evetac_cli.{module}"), "COMPILES", True):  # and needs no numba for that
        _work_off(pipe, module, chosen, force)
        return
    with compiling.announced(quiet=quiet, interrupted=interrupt_came, say=lambda text: _send_whole(pipe, text)):
        _work_off(pipe, module, chosen, force)


def _send_whole(pipe: "Connection", what: str | float) -> None:
    """Send something in the middle of a job: a message that an interrupt cuts in two would spoil all that follow."""
    with signals_blocked():
        pipe.send(what)


def _sending(pipe: "Connection") -> Progress:
    """Progress of a job that goes to the parent, every SAY_S: the part of it that is done."""
    said_s = time.monotonic()

    def report(done: float, total: float, doing: str = "") -> None:
        nonlocal said_s
        if doing or not total or time.monotonic() - said_s < SAY_S:
            return
        said_s = time.monotonic()
        _send_whole(pipe, min(done / total, 1.0))

    return report


def _work_off(pipe: "Connection", module: str, chosen: Any, force: bool) -> None:
    while True:
        try:
            job: Job = pipe.recv()
        except EOFError:
            return
        try:
            pipe.send(_in_worker(module, job, chosen, force, _sending(pipe)))
        except Exception as error:  # a defect: shown by the parent, as it would be without workers
            error.add_note(traceback.format_exc())
            plugins.note_culprits(error)
            pipe.send(error)


def _end_with_parent() -> None:
    """Wait until the parent process is gone, whatever ended it, and end this one hard: nobody wants its result.

    The sentinel is a pipe that the parent holds open. What is left on disk is removed by the next run.
    """
    import multiprocessing
    from multiprocessing.connection import wait

    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os.kill(os.getpid(), signal.SIGKILL)


class _Worker:
    """A worker process, its pipe, and the job that it is at."""

    def __init__(self, context: "SpawnContext", module: str, chosen: Any, force: bool, quiet: bool) -> None:
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, module, chosen, force, quiet, plugins.parts()))
        self.process.start()
        theirs.close()
        self.job: Job | None = None
        self.share = 0.0  # of the job that is done

    def begin(self, job: Job) -> None:
        """Hand over a job; a worker that died meanwhile is noticed when its result is asked for."""
        self.job, self.share = job, 0.0
        with suppress(OSError):
            self.pipe.send(job)

    def result(self) -> Any:
        """What it sends next, at the end what came of the job, None if it was broken off; EvetacError if it died."""
        assert self.job is not None
        try:
            return self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            killed = self.process.exitcode == -signal.SIGKILL  # which is how a system takes memory back
            return EvetacError(
                "the process that worked on it died",
                where=str(self.job.output),
                found=exit_code_words(self.process.exitcode),
                hint="out of memory? use fewer --jobs" if killed else "run it again; with --jobs 1 it says more",
            )

    def interrupt(self) -> None:
        """Tell it to stop."""
        assert self.process.pid is not None
        with suppress(ProcessLookupError):
            os.kill(self.process.pid, signal.SIGINT)

    def end(self) -> None:
        """End it: at once if it waits, hard if it does not."""
        self.pipe.close()
        if self.job is not None:
            self.process.kill()
        self.process.join()


def run_parallel(
    module: str,
    jobs: list[Job],
    chosen: Any,
    force: bool,
    at_once: int,
    progress: Progress,
    results: dict[Path, Outcome | EvetacError],
    *,
    quiet: bool = True,
) -> None:
    """Run jobs in `at_once` processes; what came of each goes into `results`, by its output, also on Ctrl-C.

    After Ctrl-C workers have GRACE_S to stop, and are killed then. A worker that dies costs its own job only. Unless
    `quiet`, the first of them says when it has to compile.
    """
    import multiprocessing
    from multiprocessing import resource_tracker

    compute_on_one_thread()
    # Spawned, not forked: HDF5 and a fork do not mix.
    context = multiprocessing.get_context("spawn")
    waiting = deque(jobs)
    workers: list[_Worker] = []
    interrupted = False
    progress(0, 0, f"starting {at_once} processes")
    resource_tracker.ensure_running()  # or starting the first worker does so, and lets interrupts through again
    # Workers inherit this, and lift it while they work; here interrupts come up only where nothing is half done.
    with signals_blocked():
        try:
            while waiting or any(worker.job for worker in workers):
                missing = min(at_once - len(workers), len(waiting))
                for _ in range(missing):  # one of them speaks for all
                    workers.append(_Worker(context, module, chosen, force, quiet or bool(workers)))
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
    """Wait for workers that have a result, or died; without a timeout, SIGINT and SIGTERM come up here."""
    from multiprocessing.connection import wait

    busy = {worker.pipe: worker for worker in workers if worker.job is not None}
    with SignalsLetThrough() if timeout_s is None else nullcontext():
        return [busy[pipe] for pipe in wait(list(busy), timeout_s)]  # type: ignore[index]


def _take(worker: _Worker, workers: list[_Worker], results: dict[Path, Outcome | EvetacError]) -> bool:
    """Note what a worker sends, and let go of one that died; whether its job was interrupted."""
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
    """Tell all workers to stop and wait a little for them; what they finished goes into `results`."""
    for worker in workers:
        worker.interrupt()
    end_s = time.monotonic() + GRACE_S
    while any(worker.job for worker in workers) and (left_s := end_s - time.monotonic()) > 0:
        for worker in _ready(workers, left_s):
            _take(worker, workers, results)


def remove_unfinished(outputs: Sequence[Path]) -> None:
    """Remove the temporary files that dead processes of this computer left beside these outputs."""
    from evetac_cli.store.hdf5 import disk

    for output in outputs:
        disk.remove_unfinished(output)
