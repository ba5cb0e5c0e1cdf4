"""Run many short trajectories through record, label, track and featurize on every engine; compare digests and times.

    python scripts/compare_engines.py FOLDER --count 1000 --rounds 2    # local --jobs 2 against dask --jobs 2
    python scripts/compare_engines.py FOLDER --count 300 --kill     # workers that die and join, every 20 s
    python scripts/compare_engines.py FOLDER --count 200 --nodes    # 4 workers at 40 % of a core each, against 1

The scene is `slip`, cut to 150 slices and with a coarse gel: a few tenths of a second of processor time per trajectory.
A table lists the time of every command on each engine. The digests cover all arrays of all files (digests.py).

--kill starts a separate Dask cluster (scheduler and two workers). Every 20 s, one worker is killed and another joins.

--nodes simulates 4 nodes on the cores of this computer. Each worker is stopped (SIGSTOP) for 60 ms of every 100 ms. The
workers' 40 ms are spread over the period so that at most two run at once. First one such worker makes a fourth of the
trajectories, then four make all of them; efficiency is the ratio of the times. Workers load and warm up first.
Efficiency is limited by the processor time per trajectory (cores share caches and memory), and by the share of their 40
% that workers wait, for the next task and for the last tasks to end.

Exit code 1 if a command fails or digests differ. Run it on a quiet computer, because it measures wall-clock time.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from digests import digest
from made_tables import commit
from results import put_measured

from evetac_cli.console import print_table
from evetac_cli.jobs import Row
from evetac_cli.resources import SCENES
from evetac_cli.text_files import as_toml

ROOT = Path(__file__).resolve().parents[1]
STAGES = ("record", "label", "track", "featurize")
KINDS = ("recording", "labels", "tracks", "features")
OBJECTS = 20
KILL_EVERY_S = 20.0
NODES, SHARE, PERIOD_S = 4, 0.4, 0.1
START_S = 60.0  # time limit for the start of a cluster, in s


def write_scene(path: Path) -> None:
    """Write the scene `slip`, shortened as far as all of its parts allow."""
    scene = tomllib.loads((SCENES / "slip.toml").read_text())
    scene["name"] = "tiny"
    scene["time"] |= {"rest_s": 0.05, "load_s": 0.05, "hold_s": 0.05, "after_lost_s": 0.02, "longest_s": 0.15}
    scene["solver"] = {"node_pitch_mm": 1.667}
    scene["gripper"] = {"start_factor": [1.05, 1.3], "friction_factor": [0.1, 0.12]}
    path.write_text(as_toml(scene))


def run_stage(stage: str, folder: Path, count: int, *engine: str, seed: int = 0) -> float:
    """Run one command on all files of a folder; return its seconds. SystemExit with its messages if it fails."""
    words = [sys.executable, "-P", "-m", "evetac_cli", stage, "--quiet", *engine]
    if stage == "record":
        each = -(-count // OBJECTS)
        words += ["--scene", "../tiny.toml", "--object", f"1-{-(-count // each)}", "--count", str(each)]
        words += ["--seed", str(seed), "--out", "."]
    else:
        words += sorted(path.name for path in folder.glob(f"*-s{seed}-*.recording.h5"))
    folder.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{stage} on {' '.join(engine)} ended with {done.returncode}: {done.stdout}{done.stderr}")
    return time.perf_counter() - started


def digests(folder: Path) -> dict[str, str]:
    """Return the digest of every stage file of a folder."""
    return {path.name: digest(path) for kind in KINDS for path in sorted(folder.glob(f"*.{kind}.h5"))}


def different(one: Path, other: Path) -> tuple[int, list[str]]:
    """Return how many files two folders have in total, and which are missing in one or have other arrays."""
    first, second = digests(one), digests(other)
    names = sorted(first.keys() | second.keys())
    return len(names), [name for name in names if first.get(name) != second.get(name)]


def with_certificates(folder: Path) -> None:
    """Make all Dask processes started from here use one certificate, as docs/cluster.md does by hand.

    Without a certificate, any user who can reach the scheduler, also on this computer, can run programs as its owner.
    """
    import dask
    from distributed import Security

    made = Security.temporary()
    files = {"cert": made.tls_client_cert, "key": made.tls_client_key}
    for name, text in files.items():
        path = folder / f"cluster-{name}.pem"
        path.unlink(missing_ok=True)
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(text)
    tls = "DASK_DISTRIBUTED__COMM__TLS__"
    os.environ[f"{tls}CA_FILE"] = str(folder / "cluster-cert.pem")
    for role in ("SCHEDULER", "WORKER", "CLIENT"):
        os.environ |= {f"{tls}{role}__{name.upper()}": str(folder / f"cluster-{name}.pem") for name in files}
    os.environ["DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION"] = "True"
    for role in ("SCHEDULER", "WORKER"):
        os.environ[f"DASK_DISTRIBUTED__{role}__HTTP__ROUTES"] = "[]"
    dask.config.refresh()


class Cluster:
    """A Dask scheduler and single-threaded workers, each a separate process that can be killed or stopped."""

    def __init__(self, folder: Path, workers: int) -> None:
        self.folder = str(folder)
        self.file = folder / "scheduler.json"
        self.file.unlink(missing_ok=True)
        with_certificates(folder)
        self.log = (folder / "cluster.log").open("w")
        self.scheduler = self._start("scheduler", "--port", "0")
        self.address = self._address()
        self.workers = [self.join() for _ in range(workers)]

    def join(self) -> subprocess.Popen[bytes]:
        """Start another worker; it is not in `workers` yet."""
        return self._start(
            "worker", "--nthreads", "1", "--no-nanny", "--memory-limit", "0", "--local-directory", self.folder
        )

    def wait(self, workers: int) -> None:
        """Wait until a number of workers have joined."""
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=START_S)

    def close(self) -> None:
        """End the scheduler and all workers."""
        for process in (*self.workers, self.scheduler):
            with suppress(ProcessLookupError):
                process.kill()
            process.wait()
        self.log.close()

    def _start(self, what: str, *words: str) -> subprocess.Popen[bytes]:
        here = ("--host", "127.0.0.1", "--protocol", "tls", "--no-dashboard", "--scheduler-file", str(self.file))
        command = [sys.executable, "-P", "-m", "dask", what, *here, *words]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        return subprocess.Popen(command, stdout=self.log, stderr=self.log, env=environment)

    def _address(self) -> str:
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline:
            with suppress(OSError, ValueError):  # missing, or half written
                return str(json.loads(self.file.read_text())["address"])
            time.sleep(0.1)
        self.scheduler.kill()
        raise SystemExit(f"the scheduler did not start: {self.log.name}")


@contextmanager
def killing(cluster: Cluster) -> Iterator[list[float]]:
    """Every KILL_EVERY_S, add a worker and kill the oldest; return the times of the kills, in s."""
    ended, began = threading.Event(), time.monotonic()
    killed: list[float] = []

    def kill() -> None:
        while not ended.wait(KILL_EVERY_S):
            cluster.workers.append(cluster.join())
            victim = cluster.workers.pop(0)
            victim.kill()
            victim.wait()
            killed.append(time.monotonic() - began)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield killed
    finally:
        ended.set()
        thread.join()


@contextmanager
def held_to(share: float, processes: list[subprocess.Popen[bytes]]) -> Iterator[None]:
    """Let each process run for only a share of every period, one after the other as far as possible."""
    ended = threading.Event()

    def turn(process: subprocess.Popen[bytes], first_s: float) -> None:
        try:
            begin = first_s
            while not ended.is_set():
                for signal_, at in ((signal.SIGCONT, begin), (signal.SIGSTOP, begin + share * PERIOD_S)):
                    time.sleep(max(0.0, at - time.monotonic()))
                    process.send_signal(signal_)
                begin = max(begin + PERIOD_S, time.monotonic())
        finally:
            process.send_signal(signal.SIGCONT)

    now = time.monotonic()
    phases = [now + PERIOD_S * number / NODES for number in range(len(processes))]
    threads = [threading.Thread(target=turn, args=pair) for pair in zip(processes, phases, strict=True)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()


def cpu_s(process: subprocess.Popen[bytes]) -> float:
    """Return the processor time of a process so far, over all its threads."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


# --- what is compared -------------------------------------------------------------------------------------------------


def engines(folder: Path, count: int, rounds: int) -> list[Row]:
    """Run every command on both engines, alternating the order; return the shortest time over several rounds."""
    both = {"local": ("--jobs", "2"), "dask": ("--jobs", "2", "--engine", "dask")}
    took: dict[tuple[str, str], float] = {}
    for number in range(rounds):
        for name in both:
            shutil.rmtree(folder / name, ignore_errors=True)
        for turn, stage in enumerate(STAGES, number):
            for name in list(both) if turn % 2 == 0 else reversed(both):
                now_s = run_stage(stage, folder / name, count, *both[name])
                took[stage, name] = min(now_s, took.get((stage, name), now_s))
    rows: list[Row] = [{"command": stage, **{f"{name}_s": took[stage, name] for name in both}} for stage in STAGES]
    rows.append({"command": "all", **{f"{name}_s": sum(row[f"{name}_s"] for row in rows) for name in both}})
    for row in rows:
        row["dask_over_local"] = row["dask_s"] / row["local_s"]
    return rows


def kills(folder: Path, count: int) -> list[Row]:
    """Run every command on a cluster whose workers die and join, and on this computer for reference."""
    rows: list[Row] = []
    cluster = Cluster(folder, 2)
    try:
        cluster.wait(2)
        with killing(cluster) as killed:
            for stage in STAGES:
                before = len(killed)
                took_s = run_stage(stage, folder / "dask", count, "--engine", f"dask:{cluster.address}")
                rows.append({"command": stage, "dask_s": took_s, "workers_killed": len(killed) - before})
    finally:
        cluster.close()
    for row in rows:
        row["local_s"] = run_stage(row["command"], folder / "local", count, "--jobs", "2")
    return rows


def nodes(folder: Path, count: int) -> list[Row]:
    """Run equally many trajectories per worker with one and with four workers, each limited to a share of a core."""
    rows: list[Row] = []
    for workers in (1, NODES):
        made = count * workers // NODES
        cluster = Cluster(folder, workers)
        engine = ("--engine", f"dask:{cluster.address}")
        try:
            cluster.wait(workers)
            for stage in STAGES:
                run_stage(stage, folder / f"warm-{workers}", 2 * workers, *engine, seed=1)
            for stage in STAGES:
                before = [cpu_s(worker) for worker in cluster.workers], cpu_s(cluster.scheduler)
                with held_to(SHARE, cluster.workers):
                    took_s = run_stage(stage, folder / f"nodes-{workers}", made, *engine)
                used_s = sum(map(cpu_s, cluster.workers)) - sum(before[0])
                rows.append({"command": stage, "workers": workers, "trajectories": made, "took_s": took_s,
                             "cpu_s": used_s, "scheduler_cpu_s": cpu_s(cluster.scheduler) - before[1]})  # fmt: skip
        finally:
            cluster.close()
        names = ("took_s", "cpu_s", "scheduler_cpu_s")
        total = {name: sum(row[name] for row in rows if row["workers"] == workers) for name in names}
        rows.append({"command": "all", "workers": workers, "trajectories": made, **total})
    took = {(row["command"], row["workers"]): row["took_s"] for row in rows}
    for row in rows:
        row["cpu_ms_a_trajectory"] = row["cpu_s"] / row["trajectories"] * 1e3
        row["share_used"] = row["cpu_s"] / (SHARE * row["workers"] * row["took_s"])
        row["efficiency"] = took[row["command"], 1] / row["took_s"]
    return rows


def main() -> int:
    """Read the flags, run the requested comparison, and compare the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a new folder for all files")
    parser.add_argument("--count", type=int, default=40, help="trajectories, a multiple of 20")
    parser.add_argument("--rounds", type=int, default=1, help="rounds of both engines; the shortest time counts")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--kill", action="store_true", help="kill workers and add new ones")
    what.add_argument("--nodes", action="store_true", help="simulate 4 nodes")
    parser.add_argument("--page", type=Path, help="put the table into this page")
    chosen = parser.parse_args()
    if chosen.folder.exists():
        parser.error(f"{chosen.folder} already exists")
    if chosen.count < OBJECTS or chosen.count % OBJECTS:
        parser.error(f"--count takes multiples of {OBJECTS}")
    folder = chosen.folder.absolute()
    folder.mkdir(parents=True)
    write_scene(folder / "tiny.toml")
    summary: Row = {"trajectories": chosen.count}
    wrong: list[str] = []
    if chosen.nodes:
        rows = nodes(folder, chosen.count)
        summary |= {"share_of_a_core": SHARE, "workers": "simulated nodes"}
    else:
        rows = kills(folder, chosen.count) if chosen.kill else engines(folder, chosen.count, chosen.rounds)
        files, wrong = different(folder / "local", folder / "dask")
        summary |= {"files": files, "different": len(wrong)}
    if chosen.page:
        name = "nodes" if chosen.nodes else "kills" if chosen.kill else "engines"
        figures = ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in summary.items())
        said = f"Simulated, by compare_engines.py at commit {commit()[0]} on {os.cpu_count()} cores, {figures}"
        put_measured(chosen.page, name, rows, said)
    print_table("engines", rows, summary, simulated=True)
    if wrong:
        print("different:", *wrong[:20], file=sys.stderr)
    else:
        shutil.rmtree(folder)
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
