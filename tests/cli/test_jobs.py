"""Jobs in processes of their own: they end with their parent, stop with it, and one that dies is said in words."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.patience import PATIENCE_S, until

# A stage whose jobs do what their names say; the main program registers it, and so does every worker that loads it.
PROGRAM = """
import json, os, platform, signal, sys, time, types
from pathlib import Path
from evetac_cli import interrupts
from evetac_cli.cli import workers
from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Job, Outcome, silent

def run(job, chosen, *, force, progress):
    name = job.output.stem
    job.output.with_name(f"{name}.pid").write_text(str(os.getpid()))
    if name.startswith("killed"):
        os.kill(os.getpid(), signal.SIGKILL)
    if name.startswith("deaf"):  # as compiled code, which hears of no signal
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
        job.output.with_name(f".{job.output.name}.{platform.node()}.{os.getpid()}.tmp").touch()
    while name.startswith("swallowed"):
        try:
            time.sleep(1e-3)
        except KeyboardInterrupt:  # as in a callback of the compiler
            pass
        progress(0, 1)
    if not name.startswith("quick"):
        time.sleep(86400.0)  # far longer than a test waits
    return Outcome([{"output": name}], True)

if __name__ == "__mp_main__":  # while a worker loads its modules
    held = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    Path(f"{os.getpid()}.held").write_text(str({signal.SIGINT, signal.SIGTERM} <= held))

stage = sys.modules["evetac_cli.standing"] = types.ModuleType("evetac_cli.standing")
stage.run = run

if __name__ == "__main__":
    interrupts.catch_interrupts()
    names = sys.argv[2:]
    results = {}
    interrupted = False
    try:
        jobs = [Job((), Path(name + ".h5")) for name in names]
        workers.run_parallel("standing", jobs, None, False, int(sys.argv[1]), silent, results)
    except KeyboardInterrupt:
        interrupted = True
    jobs = {path.stem: str(result) if isinstance(result, EvetacError) else "made" for path, result in results.items()}
    print(json.dumps({"interrupted": interrupted, "jobs": jobs}))
"""


class Jobs:
    """The program above at work, and the processes of its jobs."""

    def __init__(self, folder: Path, at_once: int, *names: str) -> None:
        self.folder = folder
        program = folder / "program.py"
        program.write_text(PROGRAM)
        python_path = os.pathsep.join(filter(None, [os.getcwd(), os.environ.get("PYTHONPATH")]))
        self.parent = subprocess.Popen(
            [sys.executable, str(program), str(at_once), *names],
            cwd=folder,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": python_path},
        )

    def started(self, *names: str) -> list[int]:
        """The numbers of the processes that work on these jobs, once they do."""
        files = [self.folder / f"{name}.pid" for name in names]
        assert until(lambda: all(file.exists() and file.read_text() for file in files))
        return [int(file.read_text()) for file in files]

    def ended(self) -> dict[str, dict[str, str]]:
        """What the parent reported at its end."""
        output, _ = self.parent.communicate(timeout=PATIENCE_S)
        reported: dict[str, dict[str, str]] = json.loads(output)
        return reported

    def end(self) -> None:
        """End whatever a failed test leaves."""
        for process in [self.parent.pid, *(int(file.read_text() or 0) for file in self.folder.glob("*.pid"))]:
            if lives(process):
                os.kill(process, signal.SIGKILL)
        with suppress(ValueError):
            self.parent.communicate()


@pytest.fixture
def jobs(tmp_path: Path) -> Iterator[list[Jobs]]:
    """Those that a test starts; nothing of them is left."""
    all_: list[Jobs] = []
    yield all_
    for one in all_:
        one.end()


def start(jobs: list[Jobs], folder: Path, at_once: int, *names: str) -> Jobs:
    """Start jobs, by names that say what they do, so many at a time."""
    jobs.append(Jobs(folder, at_once, *names))
    return jobs[-1]


def lives(process: int) -> bool:
    """Whether a process runs; one that ended and was not waited for does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
def test_m9_workers_end_with_a_parent_that_is_killed(tmp_path: Path, jobs: list[Jobs]) -> None:
    """Assert that kill -9 of the parent ends its workers at once, in the middle of jobs of a day."""
    run = start(jobs, tmp_path, 2, "long-1", "long-2", "long-3")
    processes = run.started("long-1", "long-2")
    run.parent.kill()
    run.parent.wait()
    assert until(lambda: not any(map(lives, processes)))
    assert not (tmp_path / "long-3.pid").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("job", ["long", "swallowed", "deaf"])
@pytest.mark.slow
def test_m9_a_signal_to_the_parent_alone_stops_the_work(
    tmp_path: Path, jobs: list[Jobs], number: signal.Signals, job: str
) -> None:
    """Assert that the parent stops its workers, also those that hear no signal, and keeps what is finished."""
    run = start(jobs, tmp_path, 2, "quick-1", job, "quick-2", "long-2", "long-3")
    processes = run.started(job, "long-2")
    run.parent.send_signal(number)
    assert run.ended() == {"interrupted": True, "jobs": {"quick-1": "made", "quick-2": "made"}}
    assert not any(map(lives, processes))
    assert not (tmp_path / "long-3.pid").exists()
    assert not list(tmp_path.glob(".*.tmp"))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
def test_a_worker_that_is_killed_is_said_in_words_and_others_go_on(tmp_path: Path, jobs: list[Jobs]) -> None:
    """Assert that each killed worker costs its own job only, also where all of the first ones are killed."""
    run = start(jobs, tmp_path, 2, "killed-1", "killed-2", "quick-1", "quick-2", "quick-3")
    reported = run.ended()
    assert not reported["interrupted"]
    assert {name for name, result in reported["jobs"].items() if result == "made"} == {"quick-1", "quick-2", "quick-3"}
    for name in ("killed-1", "killed-2"):
        assert "worker process died" in reported["jobs"][name]
        assert f"{name}.h5" in reported["jobs"][name]
        assert "SIGKILL" in reported["jobs"][name]


@pytest.mark.slow
def test_signals_wait_while_a_worker_loads_its_modules(tmp_path: Path, jobs: list[Jobs]) -> None:
    """Assert that they are held back in every worker until it works: before, they would end it with a traceback."""
    start(jobs, tmp_path, 2, "quick-1", "quick-2").ended()
    assert [path.read_text() for path in tmp_path.glob("*.held")] == ["True", "True"]
