"""Under what a grasp in real time runs, and what its processes take: quiet, beside busy loops, or at half speed.

Half speed: each process of the command has a group of its own, in which it gets a millisecond of CPU time in every two;
where it has real-time priority, 0.9 (what the kernel gives to all groups of a folder together is 0.95 of a core). A
process is put into its group within POLL_S of its start. Among groups it does not count how nice a process is, so each
group is as nice as its process. That needs cgroups that this user may write: of version 1 with the controller cpu, or
of version 2, whose groups hold no real-time process back.
"""

import contextlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

BUSY = "while True: pass"
BUSY_LOOPS = 2
CONDITIONS = ("quiet", "busy", "half")
POLL_S = 0.02
PERIOD_US, QUOTA_US, REALTIME_US = 2000, 1000, 900
USUAL_SHARES, NICER = 1024, 1.25  # of a process that is not nice; one that is nicer by one has so many times less
IN_REALTIME = ("controller", "servo")


def processes_of(recorder: int) -> dict[str, int]:
    """The processes of a grasp that there are now, by what they are."""
    found, spawned = {"recorder": recorder}, []
    with contextlib.suppress(OSError):  # it may end meanwhile
        for task in Path(f"/proc/{recorder}/task").iterdir():
            for pid in (task / "children").read_text().split():
                line = Path(f"/proc/{pid}/cmdline").read_text()
                if "servo_process" in line:
                    found["servo"] = int(pid)
                elif "multiprocessing-fork" in line:
                    spawned.append(int(pid))
    return {**found, **dict(zip(("detector", "controller"), sorted(spawned), strict=False))}


class ProcessState(NamedTuple):
    """CPU time of a process so far, and how nice it is."""

    cpu_s: float
    niceness: int


def state_of(pid: int) -> ProcessState | None:
    """A process, as it is now; None where it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return ProcessState((int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"), int(fields[16]))


class HalfSpeed:
    """Groups in which a process gets half a core; SystemExit where none can be made."""

    def __init__(self) -> None:
        self._groups: list[Path] = []
        self._held: dict[int, tuple[Path, int]] = {}  # group of a process, and how nice it is
        self._is_v1, self._above = _cpu_controller()
        try:
            self._group(f"evetac-{os.getpid()}-try", realtime=False)
        except OSError as error:
            raise SystemExit(f"--condition half: no group can be made below {self._above}: {error}") from None

    def _group(self, name: str, *, realtime: bool) -> Path:
        group = self._above / name
        group.mkdir()
        self._groups.append(group)
        if not self._is_v1:
            (group / "cpu.max").write_text(f"{QUOTA_US} {PERIOD_US}")
            return group
        (group / "cpu.cfs_period_us").write_text(str(PERIOD_US))
        (group / "cpu.cfs_quota_us").write_text(str(QUOTA_US))
        if realtime and (group / "cpu.rt_runtime_us").exists():
            (group / "cpu.rt_period_us").write_text(str(PERIOD_US))
            (group / "cpu.rt_runtime_us").write_text(str(REALTIME_US))
        return group

    def hold(self, what: str, pid: int, niceness: int) -> None:
        """Hold a process and its threads to half its speed, as nice as it is now; may be called again and again."""
        if pid not in self._held:
            group = self._group(f"evetac-{os.getpid()}-{what}-{pid}", realtime=what in IN_REALTIME)
            self._held[pid] = group, 0
            with contextlib.suppress(ProcessLookupError):
                (group / "cgroup.procs").write_text(str(pid))
        group, before = self._held[pid]
        if niceness != before:
            self._held[pid] = group, niceness
            if self._is_v1:
                (group / "cpu.shares").write_text(str(round(USUAL_SHARES * NICER**-niceness)))
            else:
                (group / "cpu.weight.nice").write_text(str(niceness))

    def close(self) -> None:
        """Remove the groups, once the processes in them have ended."""
        until_s = time.monotonic() + 5.0
        while self._groups and time.monotonic() < until_s:
            for group in self._groups.copy():
                with contextlib.suppress(OSError):
                    group.rmdir()
                    self._groups.remove(group)
            time.sleep(POLL_S)


def _cpu_controller() -> tuple[bool, Path]:
    """Whether the controller cpu is one of version 1, and the folder below which groups are made; SystemExit: none."""
    for line in Path("/proc/mounts").read_text().splitlines():
        _, where, kind, options, *_ = line.split()
        if kind == "cgroup" and "cpu" in options.split(","):
            return True, Path(where)
        if kind == "cgroup2" and "cpu" in (Path(where) / "cgroup.subtree_control").read_text().split():
            return False, Path(where)
    raise SystemExit("--condition half: no cgroup controller `cpu` is mounted; --condition busy needs none")


class Watched:
    """A command whose processes are watched: how much of a core each took while it recorded; and held to half speed."""

    def __init__(self, run: "subprocess.Popen[str]", recording: Path, half: HalfSpeed | None = None) -> None:
        """recording: what exists while it records; half: holds the processes."""
        self._run, self._recording, self._half = run, recording, half
        self._seen: dict[str, list[tuple[float, float]]] = {}  # time of day and CPU time, first and last
        self._ended = threading.Event()
        self._look()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        while not self._ended.wait(POLL_S):
            self._look()

    def _look(self) -> None:
        records = self._recording.exists()
        for what, pid in processes_of(self._run.pid).items():
            state = state_of(pid)
            if state is None:
                continue
            if self._half is not None:
                self._half.hold(what, pid, state.niceness)
            if records:
                self._seen[what] = [*self._seen.get(what, [])[:1], (time.monotonic(), state.cpu_s)]

    def shares(self) -> dict[str, float]:
        """Share of a core that each process took, by what it is; ends watching."""
        self._ended.set()
        self._thread.join()
        return {
            what: round((seen[-1][1] - seen[0][1]) / (seen[-1][0] - seen[0][0]), 3)
            for what, seen in self._seen.items()
            if len(seen) == 2 and seen[-1][0] > seen[0][0]
        }


@contextlib.contextmanager
def condition(name: str) -> Iterator[HalfSpeed | None]:
    """A condition for as long as the block lasts; what holds processes to half speed, if it is that one."""
    loops = [subprocess.Popen([sys.executable, "-P", "-c", BUSY]) for _ in range(BUSY_LOOPS * (name == "busy"))]
    half = HalfSpeed() if name == "half" else None
    try:
        yield half
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
        if half is not None:
            half.close()
