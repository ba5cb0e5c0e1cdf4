"""Jobs on a Dask cluster: the same arrays as without, and workers that die, join, do not fit or are told to stop."""

import asyncio
import json
import os
import shutil
import signal
import socketserver
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.cli import dask_engine, dask_worker, workers
from evetac_cli.cli.dask_worker import WorkerRefused
from evetac_cli.cli.flags import Engine
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.jobs import Job, Outcome
from evetac_cli.resources import PACKAGE
from tests.cli.test_jobs import lives
from tests.conftest import Made
from tests.patience import PATIENCE_S, until

SILENCE_S = 5.0  # after which whoever asks without credentials gets no answer any more
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
from evetac_cli.cli import dask_engine, flags, workers
from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Job, silent

if __name__ == "__main__":
    interrupts.catch_interrupts()
    results = {}
    ended = ""
    try:
        jobs = [Job((), Path(name + ".h5")) for name in sys.argv[2:]]
        engine = flags.Engine.parse(sys.argv[1])
        dask_engine.run_on_dask(engine, "standing", jobs, None, False, 2, silent, results)
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
    with pytest.raises(InputError, match="requires a certificate"):
        dask_engine._require_scheduler("tls://127.0.0.1:1")
    with (
        dask.config.set({"distributed.comm.tls.ca-file": "/none.pem", "distributed.comm.tls.client.cert": "/none.pem"}),
        pytest.raises(InputError, match="No such file"),
    ):
        dask_engine._require_scheduler("tls://127.0.0.1:1")


# --- what a worker does -----------------------------------------------------------------------------------------------


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dask_worker.ClusterCommand:
    """A command that was started in a folder of its own and runs."""
    (tmp_path / "sign").touch()
    monkeypatch.setattr(dask_worker, "LOOK_S", 0.0)
    return dask_worker.ClusterCommand("standing", None, False, dask_worker.__version__, tmp_path, tmp_path / "sign")


def stage_is(monkeypatch: pytest.MonkeyPatch, run: Any) -> None:
    """Let a function stand in for the work on a job."""
    monkeypatch.setattr(workers, "run_one", run)


def test_a_worker_goes_to_the_folder_of_the_command(
    command: dask_worker.ClusterCommand, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Assert that paths mean in the worker what they mean in the command, and that it goes back."""
    before = Path.cwd()
    where = []
    stage_is(monkeypatch, lambda *_: where.append(Path.cwd()) or MADE)
    assert dask_worker.run_task(command, [Job((), Path("a.h5")), Job((), Path("b.h5"))], [(), ()]) == [MADE, MADE]
    assert where == [tmp_path, tmp_path]
    assert Path.cwd() == before


def test_a_worker_that_does_not_fit_refuses(
    command: dask_worker.ClusterCommand, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Assert that another version and storage that is not shared are said in words, and nothing is begun."""
    stage_is(monkeypatch, lambda *_: pytest.fail("begun"))
    job = Job((), Path("a.h5"))
    monkeypatch.setattr(dask_worker, "__version__", "0.0.0")
    refused = dask_worker.run_task(command, [job], [()])
    assert isinstance(refused, WorkerRefused)
    assert "0.0.0" in refused.reason and command.version in refused.reason
    monkeypatch.setattr(dask_worker, "__version__", command.version)
    (tmp_path / "sign").unlink()
    refused = dask_worker.run_task(command, [job], [()])
    assert isinstance(refused, WorkerRefused) and "no shared storage" in refused.reason
    elsewhere = dask_worker.ClusterCommand("standing", None, False, command.version, tmp_path / "none", command.sign)
    assert str(tmp_path / "none") in dask_worker.check_worker(elsewhere)


def test_an_input_that_a_worker_does_not_see(
    command: dask_worker.ClusterCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that an input that only the command sees is an error that names it."""
    stage_is(monkeypatch, lambda *_: pytest.fail("begun"))
    results = dask_worker.run_task(command, [Job((), Path("a.h5"))], [(Path("b.recording.h5"),)])
    assert isinstance(results, list) and isinstance(results[0], EvetacError)
    result = results[0]
    assert "b.recording.h5" in str(result) and "no shared storage" in str(result)


def test_a_job_ends_with_its_command(command: dask_worker.ClusterCommand, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a job that has begun is broken off when it next tells its progress, once the command is gone.

    What the task had finished before is told.
    """

    def run(module: str, job: Job, chosen: Any, force: bool, progress: Any) -> Outcome:
        if job.output.stem == "first":
            return MADE
        progress(1, 3)
        command.sign.unlink()
        progress(2, 3)
        pytest.fail("went on")

    stage_is(monkeypatch, run)
    jobs = [Job((), Path(f"{name}.h5")) for name in ("first", "second", "third")]
    assert dask_worker.run_task(command, jobs, [(), (), ()]) == [MADE]


# --- who may give work ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def own_cluster() -> Iterator[Any]:
    """A client of the cluster that `--engine dask` starts, with one worker."""
    pytest.importorskip("distributed")
    with dask_engine._client(Engine("dask"), 1) as client:
        yield client


def addresses(client: Any) -> list[str]:
    """Where scheduler, workers and their nannies listen."""
    workers = client.scheduler_info()["workers"]
    return [client.scheduler.address, *workers, *(worker["nanny"] for worker in workers.values())]


def test_all_of_the_own_cluster_listens_here_with_credentials(own_cluster: Any) -> None:
    """Assert that scheduler, worker and nanny use TLS on this computer alone, and that the cluster works."""
    assert len(addresses(own_cluster)) == 3
    assert all(address.startswith("tls://127.0.0.1:") for address in addresses(own_cluster))
    assert own_cluster.submit(os.getpid, pure=False).result() not in (0, os.getpid())


@pytest.mark.parametrize("credentials", ["none", "tcp", "of another cluster"])
def test_no_stranger_gives_work_to_the_own_cluster(own_cluster: Any, credentials: str) -> None:
    """Assert that neither scheduler nor worker nor nanny take a call of whoever lacks the cluster's certificate."""
    from distributed import Security
    from distributed.core import rpc

    security = Security.temporary() if credentials == "of another cluster" else Security()

    async def call(address: str) -> Any:
        to = address.replace("tls://", "tcp://") if credentials == "tcp" else address
        arguments = security.get_connection_args("client")
        async with rpc(to, connection_args=arguments, timeout=SILENCE_S) as remote:
            return await asyncio.wait_for(remote.identity(), SILENCE_S)

    for address in addresses(own_cluster):
        with pytest.raises((OSError, TypeError, TimeoutError)):  # TypeError: tls:// without any certificate
            asyncio.run(call(address))


def test_no_cluster_is_started_without_credentials(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert words and a line that installs it where cryptography is missing, before anything is started."""
    pytest.importorskip("distributed")
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(EvetacError, match="cryptography") as refused, dask_engine._client(Engine("dask"), 1):
        pytest.fail("started")
    assert "[cluster]" in refused.value.hint and "--engine dask" in refused.value.where


# --- clusters ---------------------------------------------------------------------------------------------------------


class Program:
    """The program above at work on an engine."""

    def __init__(self, folder: Path, engine: str, *names: str) -> None:
        self.folder = folder
        (folder / "standing_stage.py").write_text(STAGE)
        (folder / "program.py").write_text(PROGRAM)
        self.process = subprocess.Popen(
            [sys.executable, str(folder / "program.py"), engine, *names],
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


def run(started: list[subprocess.Popen[Any]], folder: Path, engine: str, *names: str) -> Program:
    program = Program(folder, engine, *names)
    started.append(program.process)
    return program


def left(folder: Path) -> list[str]:
    """What lies in a folder that has no business there once a command has ended."""
    return [path.name for path in folder.iterdir() if path.name.startswith(".") or path.suffix == ".part"]


@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
@pytest.mark.slow
def test_a_job_whose_worker_dies_runs_again(tmp_path: Path, started: list[subprocess.Popen[Any]]) -> None:
    """Assert that one death costs nothing, that the third at the same job is an error that names it, others go on.

    Also where short jobs were handed out together.
    """
    others = ["quick-1", "once-1", *(f"quick-{number}" for number in range(2, 20))]
    reported = run(started, tmp_path, "dask", *others[:15], "killed-1", *others[15:]).ended()
    assert reported["ended"] == ""
    assert {name for name, result in reported["jobs"].items() if result == "made"} == set(others)
    assert "killed-1.h5" in reported["jobs"]["killed-1"] and "3 workers died" in reported["jobs"]["killed-1"]
    assert len((tmp_path / "once-1.pids").read_text().split()) >= 2
    assert [name for name in left(tmp_path) if "killed" in name or "runs" in name] == []


@pytest.mark.slow
def test_an_error_of_the_system_stays_what_it_is(tmp_path: Path, started: list[subprocess.Popen[Any]]) -> None:
    """Assert that what a job raises is not taken for a broken connection."""
    assert "No space left on device" in run(started, tmp_path, "dask", "full-1").ended()["ended"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
def test_ctrl_c_of_a_terminal_stops_all(tmp_path: Path, started: list[subprocess.Popen[Any]]) -> None:
    """Assert that Ctrl-C, which reaches workers too, ends all of them in order and keeps what is finished."""
    program = run(started, tmp_path, "dask", "quick-1", "long-1", "long-2", "long-3")
    processes = program.started("long-1", "long-2")
    os.killpg(program.process.pid, signal.SIGINT)
    reported = program.ended()
    assert (reported["ended"], reported["jobs"]) == ("interrupted", {"quick-1": "made"})
    assert "Traceback" not in reported["said"]
    assert until(lambda: not any(map(lives, processes)))
    assert not (tmp_path / "long-3.pids").exists()
    assert left(tmp_path) == []


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
def test_workers_end_with_a_command_that_is_killed(tmp_path: Path, started: list[subprocess.Popen[Any]]) -> None:
    """Assert that kill -9 of the command leaves no worker, and that the next command removes what it left."""
    program = run(started, tmp_path, "dask", "long-1", "long-2")
    processes = program.started("long-1", "long-2")
    program.process.kill()
    assert until(lambda: not any(map(lives, processes)))
    assert any("runs" in name for name in left(tmp_path))
    program.process.communicate()
    assert run(started, tmp_path, "dask", "quick-1").ended()["jobs"] == {"quick-1": "made"}
    assert left(tmp_path) == []


@pytest.mark.slow
def test_a_cluster_that_runs_already(tmp_path: Path, started: list[subprocess.Popen[Any]]) -> None:
    """Assert that it is waited for its workers, that one of another version is left out, that one may join or die."""
    scheduler = tmp_path / "scheduler.json"
    work, other = tmp_path / "work", tmp_path / "other"
    for folder in (work, other):
        folder.mkdir()
        (folder / "standing_stage.py").write_text(STAGE)
    (other / "of_another_version.py").write_text("import evetac_cli.cli.dask_worker as e; e.__version__ = '0.0.0'")

    def start(what: str, *words: str) -> subprocess.Popen[Any]:
        one = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--scheduler-file", str(scheduler), *words]
        quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
        process = subprocess.Popen([*one, "--no-dashboard"], cwd=tmp_path, env=environment(other), **quiet)
        started.append(process)
        return process

    start("scheduler", "--port", "0")
    assert until(lambda: scheduler.exists() and scheduler.read_text())
    engine = f"dask:{json.loads(scheduler.read_text())['address']}"
    first = run(started, work, engine, "quick-1", "once-1", "quick-2")
    worker = ("worker", "--nthreads", "1", "--preload", "standing_stage")
    start(*worker, "--preload", "of_another_version")
    refused = first.process.poll()
    assert refused is None  # it waits for workers
    reported = first.ended()
    assert "no worker of the cluster can be used" in reported["ended"] and "has evetac 0.0.0" in reported["ended"]
    start(*worker)
    deadline_s = time.monotonic() + PATIENCE_S
    while True:  # until the second worker has joined
        reported = run(started, work, engine, "quick-1", "once-1", "quick-2").ended()
        if not reported["ended"] or time.monotonic() > deadline_s:
            break
    assert (reported["ended"], set(reported["jobs"].values())) == ("", {"made"})
    assert "left out: the worker" in reported["said"]
    last = run(started, work, engine, "long-1")
    (process,) = last.started("long-1")
    os.kill(last.process.pid, signal.SIGINT)
    assert last.ended()["ended"] == "interrupted"
    assert lives(process)  # it is the cluster's
    assert left(work) == []


def arrays(path: Path) -> dict[str, Any]:
    """All datasets of a file, and its recipe id."""
    stored: dict[str, Any] = {}
    with h5py.File(path) as h5:
        h5.visititems(lambda name, item: stored.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
        stored["id"] = json.loads(h5.attrs["header"])["id"]
    return stored


@pytest.mark.slow
def test_both_engines_make_the_same_arrays(made: Made, tmp_path: Path) -> None:
    """Assert that tracks of two engines, paths and rows included, are the same."""
    pytest.importorskip("distributed")
    rows = []
    for engine in ("local", "dask"):
        folder = tmp_path / engine
        folder.mkdir()
        for path in made.recordings[:2]:
            shutil.copy(path, folder)
        words = ["track", *sorted(path.name for path in folder.iterdir()), "--jobs", "2", "--json", "--engine", engine]
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
