"""Run jobs, one after the other or several at a time in processes of their own, so that Ctrl-C always ends them.

Why so: KeyboardInterrupt may come up inside a callback of the compiler that numba uses, where it is swallowed or turned
into another error. So it is remembered too, and looked at after every job. SIGTERM is treated as Ctrl-C.
"""

import importlib
import os
import signal
from pathlib import Path
from types import FrameType
from typing import Any

from evetac_cli.errors import EvetacError, attach_outcome, attached_outcome
from evetac_cli.jobs import Job, Outcome, Progress, silent

_INTERRUPTS = {signal.SIGINT, signal.SIGTERM}
_came = False


def catch_interrupts() -> None:
    """From now on SIGINT and SIGTERM raise KeyboardInterrupt, and are remembered."""

    def remember(number: int, frame: FrameType | None) -> None:
        global _came  # noqa: PLW0603 - a signal handler has nowhere else to put it
        _came = True
        raise KeyboardInterrupt

    for number in _INTERRUPTS:
        signal.signal(number, remember)


def run_one(module: str, job: Job, chosen: Any, force: bool, progress: Progress = silent) -> Outcome | EvetacError:
    """Run one job of a stage; an error in words is its result."""
    try:
        stage = importlib.import_module(f"evetac_cli.{module}")
        result: Outcome = stage.run(job, chosen, force=force, progress=progress)
    except EvetacError as error:
        return error
    except Exception:
        if _came:
            raise KeyboardInterrupt from None
        raise
    if _came:
        raise attach_outcome(KeyboardInterrupt(), result)
    return result


def _in_worker(module: str, job: Job, chosen: Any, force: bool) -> Outcome | EvetacError | None:
    """As run_one, but Ctrl-C ends the job quietly: the parent process reports it. Nothing is begun after it."""
    if _came:
        return None
    catch_interrupts()
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _INTERRUPTS)  # one that came while the process started, comes up now
        return run_one(module, job, chosen, force)
    except KeyboardInterrupt as error:
        finished: Outcome | None = attached_outcome(error)
        return finished
    finally:
        signal.pthread_sigmask(signal.SIG_BLOCK, _INTERRUPTS)


def run_parallel(
    module: str,
    jobs: list[Job],
    chosen: Any,
    force: bool,
    at_once: int,
    progress: Progress,
    results: dict[Path, Outcome | EvetacError],
) -> None:
    """Run jobs in `at_once` processes; what came of each goes into `results`, by its output, also on Ctrl-C."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from concurrent.futures.process import BrokenProcessPool

    # Each worker computes on one core: threads of numerical libraries would fight over the cores. Spawned, not forked:
    # HDF5 and a fork do not mix.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    with ProcessPoolExecutor(at_once, mp_context=multiprocessing.get_context("spawn")) as pool:
        signal.pthread_sigmask(signal.SIG_BLOCK, _INTERRUPTS)  # workers inherit this, and lift it while they work
        interrupted = False
        futures = [pool.submit(_in_worker, module, job, chosen, force) for job in jobs]
        try:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _INTERRUPTS)
            progress(0, len(jobs))
            for done, _ in enumerate(as_completed(futures), start=1):
                progress(done, len(jobs))
        except KeyboardInterrupt:
            interrupted = True
            pool.shutdown(wait=True, cancel_futures=True)
        for job, future in zip(jobs, futures, strict=True):
            try:
                result = None if future.cancelled() else future.result()
            except BrokenProcessPool:
                result = EvetacError(
                    "the process that worked on it died", where=str(job.output), hint="out of memory? use fewer --jobs"
                )
            if result is None:
                interrupted = True
            else:
                results[job.output] = result
    if interrupted:
        raise KeyboardInterrupt
