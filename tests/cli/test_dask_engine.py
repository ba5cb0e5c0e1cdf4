"""Jobs on a Dask cluster: the same arrays as without, and workers that die, join, do not fit or are told to stop."""

import json
import os
import shutil
import signal
import socketserver
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.cli import dask_engine, workers
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.jobs import Job, Outcome
from evetac_cli.resources import PACKAGE
from tests.cli.test_jobs import lives
from tests.conftest import Made
from tests.patience import PATIENCE_S, until

MADE = Outcome([{"output": "a"}], True)
# A stage whose jobs do what their names say; the program below loads it, and so does every worker.
STAGE = """
import os, platform, signal, sys, time, types
from evetac_cli.jobs import Outcome

def run(job, chosen, *, force, progress):
    name = job.output.stem
    if name.startswith("full"):
        raise OSError(28, "No space left on device", "a.h5")
    with open(f"{name}.pids", "a") as file:
        print(os.getpid(), file=file)
    if name.startswith("killed") or name.startswith("once") and len(open(f"{name}.pids").readlines()) == 1:
        job.output.with_name(f".{job.output.name}.{platform.node()}.{os.getpid()}.tmp").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    while name.startswith("long"):
        time.sleep(0.01)
        progress(0, 1)
    return Outcome([{"output": name}], True)

stage = sys.modules["evetac_cli.standing"] = types.ModuleType("evetac_cli.standing")
stage.run = run
"""
PROGRAM = """
import json, sys
from pathlib import Path
import standing_stage
from evetac_cli import interrupts
from evetac_cli.cli import dask_engine
from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Job, silent

if __name__ == "__main__":
    interrupts.catch_interrupts()
    results = {}
    ended = ""
    try:
        jobs = [Job((), Path(name + ".h5")) for name in sys.argv[2:]]
        dask_engine.run_on_dask(sys.argv[1], "standing", jobs, None, False, silent, results)
    except KeyboardInterrupt:
        ended = "interrupted"
    except (EvetacError, OSError) as error:
        ended = str(error)
    jobs = {path.stem: str(result) if isinstance(result, EvetacError) else "made" for path, result in results.items()}
    print(json.dumps({"ended": ended, "jobs": jobs}))
"""


class _Answering(socketserver.BaseRequestHandler):
    """A server that is no scheduler."""

    def handle(self) -> None:
        self.request.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n" * 9)


class _Silent(socketserver.BaseRequestHandler):
    """A server that says nothing for longer than anybody waits."""

    def handle(self) -> None:
        self.request.recv(1 << 16)
        self.request.recv(1 << 16)


@pytest.mark.parametrize("server", [_Answering, _Silent, None])
def test_what_is_no_scheduler_is_refused_in_words(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that another program at the address, a silent one and none at all are one error that names the address."""
    pytest.importorskip("distributed")
    monkeypatch.setattr(dask_engine, "CONNECT_S", 1.0)
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), server or _Silent) as listening:
        listening.daemon_threads = True
        if server:
            threading.Thread(target=listening.serve_forever, daemon=True).start()
        else:
            listening.socket.close()
        address = f"tcp://127.0.0.1:{listening.server_address[1]}"
        with pytest.raises(InputError, match="no Dask scheduler answers") as refused:
            dask_engine._require_scheduler(address)
        if server:
            listening.shutdown()
    assert address in refused.value.found


def test_a_cluster_with_certificates_is_not_asked_without(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that tls:// is refused where Dask's settings name no certificate, or one that is not there."""
    dask = pytest.importorskip("dask")
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        dask_engine._require_scheduler("tls://127.0.0.1:1")
    with (
        dask.config.set({"distributed.comm.tls.ca-file": "/none.pem", "distributed.comm.tls.client.cert": "/none.pem"}),
        pytest.raises(InputError, match="No such file"),
    ):
        dask_engine._require_scheduler("tls://127.0.0.1:1")


# --- what a worker does -----------------------------------------------------------------------------------------------


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dask_engine.ClusterCommand:
    """A command that was started in a folder of its own and runs."""
    (tmp_path / "sign").touch()
    monkeypatch.setattr(dask_engine, "LOOK_S", 0.0)
    return dask_engine.ClusterCommand("standing", None, False, dask_engine.__version__, tmp_path, tmp_path / "sign")


def stage_is(monkeypatch: pytest.MonkeyPatch, run: Any) -> None:
    """Let a function stand in for the work on a job."""
    monkeypatch.setattr(workers, "run_one", run)


def test_a_worker_goes_to_the_folder_of_the_command(
    command: dask_engine.ClusterCommand, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Assert that paths mean in the worker what they mean in the command, and that it goes back."""
    before = Path.cwd()
    where = []
    stage_is(monkeypatch, lambda *_: where.append(Path.cwd()) or MADE)
    assert dask_engine.run_task(command, Job((), Path("a.h5")), ()) == MADE
    assert where == [tmp_path]
    assert Path.cwd() == before


def test_a_worker_that_does_not_fit_refuses(
    command: dask_engine.ClusterCommand, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Assert that another version and storage that is not shared are said in words, and nothing is begun."""
    stage_is(monkeypatch, lambda *_: pytest.fail("begun"))
    job = Job((), Path("a.h5"))
    monkeypatch.setattr(dask_engine, "__version__", "0.0.0")
    refused = dask_engine.run_task(command, job, ())
    assert isinstance(refused, str)
    assert "0.0.0" in refused and command.version in refused
    monkeypatch.setattr(dask_engine, "__version__", command.version)
    (tmp_path / "sign").unlink()
    refused = dask_engine.run_task(command, job, ())
    assert isinstance(refused, str) and "no shared storage" in refused
    elsewhere = dask_engine.ClusterCommand("standing", None, False, command.version, tmp_path / "none", command.sign)
    assert str(tmp_path / "none") in dask_engine.check_worker(elsewhere)


def test_an_input_that_a_worker_does_not_see(
    command: dask_engine.ClusterCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that an input that only the command sees is an error that names it."""
    stage_is(monkeypatch, lambda *_: pytest.fail("begun"))
    result = dask_engine.run_task(command, Job((), Path("a.h5")), (Path("b.recording.h5"),))
    assert isinstance(result, EvetacError)
    assert "b.recording.h5" in str(result) and "no shared storage" in str(result)


def test_a_job_ends_with_its_command(command: dask_engine.ClusterCommand, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a job that has begun is broken off when it next tells its progress, once the command is gone."""

    def run(module: str, job: Job, chosen: Any, force: bool, progress: Any) -> Outcome:
        progress(1, 3)
        command.sign.unlink()
        progress(2, 3)
        pytest.fail("went on")

    stage_is(monkeypatch, run)
    assert dask_engine.run_task(command, Job((), Path("a.h5")), ()) is None


# --- clusters ---------------------------------------------------------------------------------------------------------


class Program:
    """The program above at work on an engine."""

    def __init__(self, folder: Path, address: str, *names: str) -> None:
        self.folder = folder
        (folder / "program.py").write_text(PROGRAM)
        self.process = subprocess.Popen(
            [sys.executable, str(folder / "program.py"), address, *names],
            cwd=folder,
            env=environment(folder),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,  # a group of its own, as of a terminal's
        )

    def started(self, *names: str) -> list[int]:
        """The numbers of the processes that last began these jobs, once they did."""
        files = [self.folder / f"{name}.pids" for name in names]
        assert until(lambda: all(file.exists() and file.read_text() for file in files))
        return [int(file.read_text().split()[-1]) for file in files]

    def ended(self) -> dict[str, Any]:
        """What the program reported at its end, and what it said."""
        output, said = self.process.communicate(timeout=PATIENCE_S)
        reported: dict[str, Any] = json.loads(output)
        return reported | {"said": said}


def environment(folder: Path) -> dict[str, str]:
    """That of a program that finds evetac, and the stage in a folder."""
    paths = [str(PACKAGE.parent), str(folder), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}


@pytest.fixture
def started(tmp_path: Path) -> Iterator[list[subprocess.Popen[Any]]]:
    """Processes that a test starts; nothing of them is left, nor of their workers."""
    pytest.importorskip("distributed")
    processes: list[subprocess.Popen[Any]] = []
    yield processes
    for process in processes:
        if lives(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


class Cluster:
    """A scheduler and its workers; the program's folder, and another folder that all of them import from."""

    def __init__(self, folder: Path, started: list[subprocess.Popen[Any]]) -> None:
        self.folder, self._started = folder, started
        self.work, self._other = folder / "work", folder / "other"
        for each in (self.work, self._other):
            each.mkdir(parents=True)
            (each / "standing_stage.py").write_text(STAGE)
        (self._other / "of_another_version.py").write_text(
            "import evetac_cli.cli.dask_engine as e; e.__version__ = '0.0.0'"
        )
        self._file = folder / "scheduler.json"
        self._start("scheduler", "--port", "0")
        assert until(lambda: self._file.exists() and self._file.read_text())
        self.address = json.loads(self._file.read_text())["address"]

    def _start(self, what: str, *words: str) -> None:
        one = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--scheduler-file", str(self._file), *words]
        quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
        at = {"cwd": self.folder, "env": environment(self._other)}
        self._started.append(subprocess.Popen([*one, "--no-dashboard"], **at, **quiet))

    def add_workers(self, number: int, *words: str) -> None:
        """Start workers of one thread each."""
        self._start("worker", "--nworkers", str(number), "--nthreads", "1", "--preload", "standing_stage", *words)

    def run(self, *names: str) -> Program:
        """Start the program with jobs of these names."""
        program = Program(self.work, self.address, *names)
        self._started.append(program.process)
        return program


@pytest.fixture
def cluster(tmp_path: Path, started: list[subprocess.Popen[Any]]) -> Cluster:
    """A cluster without workers."""
    return Cluster(tmp_path, started)


def left(folder: Path) -> list[str]:
    """What lies in a folder that has no business there once a command has ended."""
    return [path.name for path in folder.iterdir() if path.name.startswith(".") or path.suffix == ".part"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
def test_a_job_whose_worker_dies_runs_again(cluster: Cluster) -> None:
    """Assert that one death costs nothing, that many at the same job are an error that names it, others go on.

    Also where short jobs were handed out together. What a job raises is not taken for a broken connection. Slow: it
    starts a cluster, whose workers are started again.
    """
    cluster.add_workers(2)
    others = ["quick-1", "once-1", *(f"quick-{number}" for number in range(2, 20))]
    reported = cluster.run(*others[:15], "killed-1", *others[15:]).ended()
    assert reported["ended"] == ""
    assert {name for name, result in reported["jobs"].items() if result == "made"} == set(others)
    assert "killed-1.h5" in reported["jobs"]["killed-1"] and "4 workers died" in reported["jobs"]["killed-1"]
    assert len((cluster.work / "once-1.pids").read_text().split()) >= 2
    assert [name for name in left(cluster.work) if "killed" in name or "runs" in name] == []
    assert "No space left on device" in cluster.run("full-1").ended()["ended"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
def test_workers_join_do_not_fit_and_are_told_to_stop(
    cluster: Cluster, tmp_path: Path, started: list[subprocess.Popen[Any]]
) -> None:
    """Assert that workers are waited for, that one of another version is refused, and that Ctrl-C keeps what is made.

    Slow: it starts a cluster.
    """
    first = cluster.run("quick-1", "once-1", "quick-2")
    cluster.add_workers(1, "--preload", "of_another_version")
    assert first.process.poll() is None  # it waits for workers
    reported = first.ended()
    assert "a worker of the cluster cannot be used" in reported["ended"] and "has evetac 0.0.0" in reported["ended"]
    assert left(cluster.work) == []
    cluster = Cluster(tmp_path / "fits", started)
    cluster.add_workers(1)
    last = cluster.run("quick-3", "long-1", "long-2")
    (process,) = last.started("long-1")
    os.killpg(last.process.pid, signal.SIGINT)
    reported = last.ended()
    assert (reported["ended"], reported["jobs"]) == ("interrupted", {"quick-3": "made"})
    assert "Traceback" not in reported["said"]
    assert lives(process)  # it is the cluster's
    assert not (cluster.work / "long-2.pids").exists()
    assert left(cluster.work) == []


def arrays(path: Path) -> dict[str, Any]:
    """All datasets of a file, and its recipe id."""
    stored: dict[str, Any] = {}
    with h5py.File(path) as h5:
        h5.visititems(lambda name, item: stored.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
        stored["id"] = json.loads(h5.attrs["header"])["id"]
    return stored


@pytest.mark.slow
def test_both_engines_make_the_same_arrays(made: Made, cluster: Cluster, tmp_path: Path) -> None:
    """Assert that tracks of two engines, paths and rows included, are the same."""
    cluster.add_workers(2)
    rows = []
    for name, how in (("local", ("--jobs", "2")), ("dask", ("--engine", f"dask:{cluster.address}"))):
        folder = tmp_path / name
        folder.mkdir()
        for path in made.recordings[:2]:
            shutil.copy(path, folder)
        words = ["track", *sorted(path.name for path in folder.iterdir()), "--json", *how]
        done = subprocess.run(
            [sys.executable, "-m", "evetac_cli", *words],
            cwd=folder,
            env=environment(folder),
            capture_output=True,
            text=True,
            check=True,
        )
        rows.append(json.loads(done.stdout))
    assert rows[0] == rows[1]
    for ours in sorted((tmp_path / "local").glob("*.tracks.h5")):
        one, other = arrays(ours), arrays(tmp_path / "dask" / ours.name)
        assert one.keys() == other.keys()
        for name, value in one.items():
            np.testing.assert_array_equal(value, other[name], err_msg=name)
