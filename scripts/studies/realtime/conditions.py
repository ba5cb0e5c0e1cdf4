"""Conditions for a grasp in real time (quiet, with busy loops, at half speed), and the CPU use of its processes.

Half speed: each process of the command is in a group of its own, which gets one millisecond of CPU time in every two.
With real-time priority it gets a part of that, because the kernel gives 0.95 of a core to all groups of a folder
together. A process enters its group within POLL_S of its start. Between groups, a process's nice value has no effect,
so each group gets the nice value of the process's nicest thread.

This needs cgroups that the user may write: version 1 with the controller cpu, or version 2. Groups of version 2 do not
limit real-time processes.
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
POLL_S, PATIENCE_S = 0.02, 5.0
PERIOD_US, QUOTA_US = 2000, 1000
PROCESSES = ("recorder", "servo", "detector", "controller")
REALTIME_US = {"controller": 800, "servo": 700, "recorder": 300}
USUAL_SHARES, NICER = 1024, 1.25  # weight for nice 0; each nice step divides the weight by this factor


def processes_of(recorder: int) -> dict[str, int]:
    """Return the running processes of a grasp, by role."""
    found, spawned = {"recorder": recorder}, []
    with contextlib.suppress(OSError):  # it may end meanwhile
        for task in Path(f"/proc/{recorder}/task").iterdir():
            for pid in (task / "children").read_text().split():
                line = Path(f"/proc/{pid}/cmdline").read_text()
                if "devices.virtual.gripper" in line:
                    found["servo"] = int(pid)
                elif "multiprocessing-fork" in line:
                    spawned.append((int(_fields(Path(f"/proc/{pid}"))[_STARTED]), int(pid)))
    return {**found, **dict(zip(("detector", "controller"), (pid for _, pid in sorted(spawned)), strict=False))}


class ProcessState(NamedTuple):
    """CPU time of a process so far, and the nice value of its nicest thread."""

    cpu_s: float
    niceness: int


def _fields(folder: Path) -> list[str]:
    """Return the kernel's fields for a process or thread, after its name; OSError if it has ended."""
    return (folder / "stat").read_text().rpartition(")")[2].split()


_USER, _SYSTEM, _NICENESS, _STARTED = 11, 12, 16, 19  # index in these fields


def state_of(pid: int) -> ProcessState | None:
    """Return the present state of a process; None if it has ended."""
    folder = Path(f"/proc/{pid}")
    try:
        fields = _fields(folder)
        niceness = max(int(_fields(thread)[_NICENESS]) for thread in (folder / "task").iterdir())
    except (OSError, ValueError):
        return None
    return ProcessState((int(fields[_USER]) + int(fields[_SYSTEM])) / os.sysconf("SC_CLK_TCK"), niceness)


class HalfSpeed:
    """Groups in which each process of a grasp gets half a core; SystemExit if none can be made."""

    def __init__(self) -> None:
        self._is_v1, self._above = _cpu_controller()
        for left in self._above.glob("evetac-*"):  # left by a killed run: it would keep its share of real time
            with contextlib.suppress(OSError):  # the weight of a working process
                left.rmdir()
        self._groups = {what: self._above / f"evetac-{os.getpid()}-{what}" for what in PROCESSES}
        self._nice = dict.fromkeys(PROCESSES, 0)
        self._held: set[int] = set()
        until_s = time.monotonic() + PATIENCE_S
        while (error := self._make_groups()) is not None:
            if time.monotonic() > until_s:
                self.close()
                raise SystemExit(f"--condition half: no group can be made below {self._above}: {error}")
            time.sleep(POLL_S)  # the kernel frees the share of removed groups later

    def _make_groups(self) -> OSError | None:
        """Make the missing groups; return the error, or None."""
        try:
            for what, group in self._groups.items():
                group.mkdir(exist_ok=True)
                if not self._is_v1:
                    (group / "cpu.max").write_text(f"{QUOTA_US} {PERIOD_US}")
                    continue
                (group / "cpu.cfs_period_us").write_text(str(PERIOD_US))
                (group / "cpu.cfs_quota_us").write_text(str(QUOTA_US))
                if what in REALTIME_US:
                    (group / "cpu.rt_period_us").write_text(str(PERIOD_US))
                    (group / "cpu.rt_runtime_us").write_text(str(REALTIME_US[what]))
        except OSError as error:
            return error
        return None

    def hold(self, what: str, pid: int, niceness: int) -> None:
        """Limit a process and its threads to half speed, with its present nice value; may be called repeatedly."""
        group = self._groups[what]
        if pid not in self._held:
            self._held.add(pid)
            with contextlib.suppress(ProcessLookupError):
                (group / "cgroup.procs").write_text(str(pid))
        if niceness != self._nice[what]:
            self._nice[what] = niceness
            if self._is_v1:
                (group / "cpu.shares").write_text(str(round(USUAL_SHARES * NICER**-niceness)))
            else:
                (group / "cpu.weight.nice").write_text(str(niceness))

    def close(self) -> None:
        """Remove the groups, once their processes have ended."""
        until_s = time.monotonic() + PATIENCE_S
        while any(group.exists() for group in self._groups.values()) and time.monotonic() < until_s:
            for group in self._groups.values():
                with contextlib.suppress(OSError):
                    group.rmdir()
            time.sleep(POLL_S)


def _cpu_controller() -> tuple[bool, Path]:
    """Return whether the cpu controller is version 1, and the folder for groups; SystemExit if there is none."""
    for line in Path("/proc/mounts").read_text().splitlines():
        _, where, kind, options, *_ = line.split()
        if kind == "cgroup" and "cpu" in options.split(","):
            return True, Path(where) / _own_group()
        if kind == "cgroup2" and "cpu" in (Path(where) / "cgroup.subtree_control").read_text().split():
            return False, Path(where)
    raise SystemExit("--condition half: no cgroup controller `cpu` is mounted; use --condition busy, which needs none")


def _own_group() -> str:
    """Return the path of this process's group below the mount of version 1's cpu controller."""
    for line in Path("/proc/self/cgroup").read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        if "cpu" in controllers.split(","):
            return path.lstrip("/")
    return ""


class Watched:
    """A command whose processes are watched for their CPU use while it records, and optionally held to half speed."""

    def __init__(self, run: "subprocess.Popen[str]", recording: Path, half: HalfSpeed | None = None) -> None:
        """recording: the path that exists while it records. half: limits the processes."""
        self._run, self._recording, self._half = run, recording, half
        self._seen: dict[str, list[tuple[float, float]]] = {}  # time of day and CPU time, first and last
        self.names: dict[int, str] = {}  # of processes, when first seen; later some have ended
        self._ended = threading.Event()
        self._look()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        while not self._ended.wait(POLL_S):
            self._look()

    def _look(self) -> None:
        records = self._recording.exists()
        for name, pid in processes_of(self._run.pid).items():
            what = self.names.setdefault(pid, name)
            state = state_of(pid)
            if state is None:
                continue
            if self._half is not None:
                self._half.hold(what, pid, state.niceness)
            if records:
                self._seen[what] = [*self._seen.get(what, [])[:1], (time.monotonic(), state.cpu_s)]

    def shares(self) -> dict[str, float]:
        """Stop watching; return the share of a core that each process used, by role."""
        self._ended.set()
        self._thread.join()
        return {
            what: round((seen[-1][1] - seen[0][1]) / (seen[-1][0] - seen[0][0]), 3)
            for what, seen in self._seen.items()
            if len(seen) == 2 and seen[-1][0] > seen[0][0]
        }


@contextlib.contextmanager
def condition(name: str) -> Iterator[HalfSpeed | None]:
    """Apply a condition during the block; yield the half-speed groups, or None."""
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
