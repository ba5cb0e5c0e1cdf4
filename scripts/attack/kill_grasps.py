"""Kill and stop processes of `grasp` or `record` at random times. How long does the motor keep its current?

    python scripts/attack/kill_grasps.py --kills 40 --stops 20 -o kills.jsonl          # of grasps, on a quiet machine
    python scripts/attack/kill_grasps.py --kills 40 --stops 20 -o kills.jsonl --json   # the same as one JSON object
    python scripts/attack/kill_grasps.py --kills 40 --stops 20 --commands two-fingers  # of grasps with two cameras
    python scripts/attack/kill_grasps.py --kills 10 --stops 0 --commands grasp record --watchdog-ms 100 --busy 4

The commands are real ones, with a camera that plays prepared words and a gripper at a port. At the other end of the
port is a virtual servo, in a process of its own that outlives the commands. The servo keeps a log by the same clock
that times the kill: when the motor got current, when it lost it, and when the last goal arrived.

The time of the kill is random, from before the first message to after the last. In every other trial it is drawn
between the motor's first current and a time after its end. The process is the recorder (the parent of all), the
detector or the controller, if it exists. A kill is SIGKILL. A stop is SIGSTOP: the stopped process continues after 1 s
and is watched for 1 s more.

Every trial is a line of JSON; trials that are already in the file of -o are not run again. During each trial, a thread
that wakes every millisecond measures the lateness of the machine itself. The output ends with a row for the kills, one
for the stops and one for all: their number, and the longest time with current, in ms.

Exit code 1 if a motor had current for more than 100 ms, or gripped again. With busy loops (--busy) the time is reported
without a bound.
"""

import argparse
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

BOUND_MS = 100.0
STOPPED_S = 1.0  # and the process is watched for as long again after SIGCONT
TRIES = 6
WORDS_S = 5.0  # limit after that, for a command to end by itself
SETTLED_S = 0.3  # without current for this long, the motor counts as off
LONGEST_S = 60.0  # limit for a command
LOOP = ("--controller", "paper", "--model", "shipped")
# The processes of each command, in the order of their start.
PARTS = {
    "grasp": ("recorder", "detector", "controller"),
    "two-fingers": ("recorder", "detector", "second detector", "controller"),
    "record": ("recorder",),
}
TICK_S = 1e-3  # of the servo; a real servo is not slower
SERVO_PRIORITY, CLOSE_MA = 40, 0.5
BUSY = "while True: pass"


# The servo


def be_servo(log: Path) -> None:
    """Run the servo until stdin ends; log a line for every change."""
    from evetac_cli.devices.rh_p12_rn.control_table import REGISTERS, baud_code
    from evetac_cli.devices.virtual import gripper as virtual_gripper
    from evetac_cli.devices.virtual.dynamixel_frames import DynamixelFrame, Instruction
    from evetac_cli.devices.virtual.servo import Answer, VirtualServo
    from evetac_cli.devices.virtual.servo_plant import Goals, Obstacle, OwnDynamics, ServoMotion
    from evetac_cli.realtime.processes import set_realtime_priority
    from evetac_cli.realtime.shared_time import HOST_TIME

    goal_registers = {REGISTERS[name].address for name in ("Goal Current", "Goal Position")}

    class LoggedPlant(OwnDynamics):
        """A finger in front of an obstacle; logs when its motor gets current and when it loses it."""

        has_current = False
        goal_s = 0.0

        def advance(self, goals: Goals, now_s: float) -> ServoMotion:
            motion = super().advance(goals, now_s)
            has_current = goals.torque or abs(motion.current_ma) >= CLOSE_MA
            if has_current != self.has_current:
                self.has_current = has_current
                line = {"t_s": time.monotonic(), "has_current": has_current, "goal_s": self.goal_s}
                os.write(file, (json.dumps(line) + "\n").encode())
            return motion

    class LoggedServo(VirtualServo):
        """A servo that logs when the last goal arrived."""

        def handle(self, frame: DynamixelFrame, now_s: float) -> list[Answer]:
            written = frame.instruction in (Instruction.WRITE, Instruction.SYNC_WRITE)
            if written and int.from_bytes(frame.parameters[:2], "little") in goal_registers:
                plant.goal_s = now_s
            return super().handle(frame, now_s)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    plant = LoggedPlant(Obstacle())
    servo = LoggedServo(plant, {"Baud Rate": baud_code(2_000_000)}, time.monotonic())
    virtual_gripper.IDLE_S = TICK_S
    line = virtual_gripper.ServoLine(servo, virtual_gripper.Faults([], np.random.default_rng(0)), HOST_TIME)
    print(line.port, flush=True)
    set_realtime_priority(SERVO_PRIORITY)
    while not line.wait(sys.stdin.fileno()):
        pass


class Servo:
    """The servo's process and its log."""

    def __init__(self, folder: Path) -> None:
        self._log = folder / "servo.jsonl"
        command = [sys.executable, __file__, "--servo", str(self._log)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        assert self._process.stdout is not None
        self.port = self._process.stdout.readline().strip()
        self._begun_s = time.monotonic()

    def spans(self, from_s: float) -> list[tuple[float, float]]:
        """Return the spans with motor current that end after a time, as start and end (inf: still on)."""
        spans: list[tuple[float, float]] = []
        for text in self._log.read_text().splitlines():
            line = json.loads(text)
            if line["has_current"]:
                spans.append((line["t_s"], float("inf")))
            else:
                spans[-1] = (spans[-1][0], line["t_s"])
        return [(begin, end) for begin, end in spans if end > from_s]

    def last_goal_s(self) -> float:
        """Return when the last goal before the motor's last change arrived."""
        lines = self._log.read_text().splitlines() if self._log.exists() else []
        return float(json.loads(lines[-1])["goal_s"]) if lines else 0.0

    def wait_without_current(self) -> None:
        """Wait until the motor is without current and stays without it for a while."""
        until_s = time.monotonic() + LONGEST_S
        while time.monotonic() < until_s and any(end > time.monotonic() - SETTLED_S for _, end in self.spans(0.0)):
            time.sleep(0.005)

    def close(self) -> None:
        """End the servo."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(10.0)


# The machine


class Lateness:
    """Measures how late a thread wakes that sleeps for a millisecond, again and again."""

    def __init__(self) -> None:
        self._late_ms: list[float] = []
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            due_s = time.monotonic() + 1e-3
            time.sleep(1e-3)
            self._late_ms.append((time.monotonic() - due_s) * 1e3)

    def take(self) -> tuple[float, float]:
        """Return the 99th percentile and the maximum since the last call, in ms."""
        late_ms, self._late_ms = self._late_ms, []
        return float(np.percentile(late_ms, 99)), max(late_ms)


@contextlib.contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Run a number of processes that only compute."""
    loops = [subprocess.Popen([sys.executable, "-P", "-c", BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


# The commands


def command_line(name: str, port: str, watchdog_ms: int, folder: Path) -> list[str]:
    """Return the arguments of a short `grasp` or `record` with the gripper at the port."""
    grid = folder / "grid.json"
    if not grid.exists():
        x, y = np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0)
        dots = np.stack([x, y], axis=-1).tolist()
        grid.write_text(json.dumps({"frame_px": [640, 480], "radius_px": 11.0, "dot_xy_px": dots}))
    cameras = ",".join(["virtual:prepared=10000"] * (2 if name == "two-fingers" else 1))
    more = ["--calibration", str(grid), *LOOP, "--lift-s", "1", "--balance-s", "0"]
    if name == "record":
        more = ["--seconds", "1.5", "--expected-event-rate", "1e5"]
    command = [sys.executable, "-P", "-m", "evetac_cli", "record" if name == "record" else "grasp", *more]
    devices = ["--camera", cameras, "--gripper", port, "--arm", "--watchdog-ms", str(watchdog_ms)]
    out = folder / ("recordings" if name == "two-fingers" else "one.recording.h5")
    return [*command, *devices, "-q", "--force", "-o", str(out)]


def clear(folder: Path) -> None:
    """Remove the files of an earlier trial."""
    for path in folder.glob("*recording*"):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


def processes_of(name: str, recorder: int) -> dict[str, int]:
    """Return the running processes of a command, by their role."""
    children: list[str] = []
    with contextlib.suppress(OSError):  # it has ended
        for task in Path(f"/proc/{recorder}/task").iterdir():
            children += (task / "children").read_text().split()
    spawned = []
    for pid in children:
        with contextlib.suppress(OSError):
            if "multiprocessing-fork" in Path(f"/proc/{pid}/cmdline").read_text():
                spawned.append(int(pid))
    return dict(zip(PARTS[name], (recorder, *sorted(spawned)), strict=False))


def lives_s(name: str, servo: Servo, watchdog_ms: int, folder: Path) -> tuple[float, float]:
    """Return how long a command takes that is not killed, and how long the motor has current in it.

    The first run compiles everything. On a machine that is too busy the command may end early; then it runs again.
    """
    whole_s = moving_s = 0.0
    for attempt in range(TRIES):
        clear(folder)
        began_s = time.monotonic()
        line = command_line(name, servo.port, watchdog_ms, folder)
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        whole_s = time.monotonic() - began_s
        servo.wait_without_current()
        spans = servo.spans(began_s)
        moving_s = max([moving_s, *(end - begin for begin, end in spans)])
        if done.returncode == 0 and attempt:
            break
    if not moving_s:
        raise SystemExit(f"{name} did not move the gripper: {done.stderr}")
    return whole_s, moving_s


def one(
    name: str, part: str, since: str, after_s: float, how: str, watchdog_ms: int, servo: Servo, folder: Path
) -> dict[str, Any]:
    """Run a command; kill or stop one process a given time after the command's start, or after first current.

    Return the servo's log and the command's outcome.
    """
    clear(folder)
    number = signal.SIGKILL if how == "kill" else signal.SIGSTOP
    with subprocess.Popen(
        command_line(name, servo.port, watchdog_ms, folder),
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
    ) as run:  # fmt: skip
        began_s = time.monotonic()
        while since == "current" and not servo.spans(began_s) and run.poll() is None:
            time.sleep(0.002)
        time.sleep(after_s)
        processes = processes_of(name, run.pid)
        struck = part if part in processes else "recorder"
        ended_before = run.poll() is not None
        struck_s = time.monotonic()
        if not ended_before:
            with contextlib.suppress(ProcessLookupError):
                os.kill(processes[struck], number)
        watched_until_s = float("inf")
        if how == "stop":
            time.sleep(STOPPED_S)
            watched_until_s = time.monotonic()
            with contextlib.suppress(ProcessLookupError):
                if not ended_before:
                    os.kill(processes[struck], signal.SIGCONT)
            time.sleep(STOPPED_S)
            with contextlib.suppress(subprocess.TimeoutExpired):  # for its messages
                run.wait(WORDS_S)
        elif struck == "recorder":
            servo.wait_without_current()
        else:
            with contextlib.suppress(subprocess.TimeoutExpired):
                run.wait(LONGEST_S)
            servo.wait_without_current()
        spans = servo.spans(struck_s)
        gripped_before = any(begin <= struck_s for begin, _ in servo.spans(began_s))
        exit_code = run.poll()
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(run.pid, signal.SIGKILL)
        stderr = run.communicate()[1]
    judged = [(begin, end) for begin, end in spans if begin < watched_until_s]
    first_off_s = min((end for _, end in judged), default=struck_s)
    had_current = any(begin <= struck_s for begin, _ in judged)
    last_s = max((min(end, watched_until_s) for _, end in judged), default=struck_s)
    again = gripped_before and any(begin > first_off_s for begin, _ in spans)
    servo.wait_without_current()
    return {
        "struck": "nothing: it had ended" if ended_before else struck,
        "after_s": round(after_s, 4),
        "had_current": had_current,
        "without_current_ms": round((last_s - struck_s) * 1e3, 2),
        "goal_after_ms": round(max(servo.last_goal_s() - struck_s, 0.0) * 1e3, 2),
        "gripped_again": again,
        "exit_code": exit_code,
        "traceback": "Traceback" in stderr,
        "words": [line for line in stderr.splitlines() if "torque" in line or "error" in line][-2:],
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Summarise trials in one row."""
    ms = np.array([row["without_current_ms"] for row in rows])
    moving = ms[[row["had_current"] for row in rows]]
    return {
        "trials": len(rows),
        "with_current_when_struck": len(moving),
        "without_current_ms_median": float(np.median(moving)) if len(moving) else None,
        "without_current_ms_p99": float(np.percentile(moving, 99)) if len(moving) else None,
        "without_current_ms_most": float(ms.max()) if len(ms) else None,
        "over_100_ms": int((ms > BOUND_MS).sum()),
        "gripped_again": sum(row["gripped_again"] for row in rows),
        "tracebacks": sum(row["traceback"] for row in rows),
        "machine_late_ms_p99": float(np.median([row["machine_late_ms_p99"] for row in rows])) if rows else None,
        "machine_late_ms_most": max((row["machine_late_ms_most"] for row in rows), default=None),
    }


def planned(chosen: argparse.Namespace) -> list[dict[str, Any]]:
    """Return all planned trials: kills, then stops, commands in turn, half of them timed from the first current."""
    trials = []
    for how, count in (("kill", chosen.kills), ("stop", chosen.stops)):
        for trial in range(count):
            name = chosen.commands[trial % len(chosen.commands)]
            since = ("start", "current")[trial // len(chosen.commands) % 2]
            which = {"watchdog_ms": chosen.watchdog_ms, "busy": chosen.busy, "seed": chosen.seed}
            trials.append({"how": how, "trial": trial, "command": name, "since": since, **which})
    return trials


def strike(plan: dict[str, Any], servo: Servo, lives: tuple[float, float], folder: Path) -> dict[str, Any]:
    """Run one trial; its time and its process are drawn from the seed, the trial's number and its kind."""
    name, how, since = plan["command"], plan["how"], plan["since"]
    rng = np.random.default_rng([plan["seed"], plan["trial"], how == "stop"])
    part = PARTS[name][rng.integers(len(PARTS[name]))]
    after_s = float(rng.uniform(0.0, lives[since == "current"] + SETTLED_S))
    return {**plan, **one(name, part, since, after_s, how, plan["watchdog_ms"], servo, folder)}


def main() -> None:
    """Run the trials and print the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, prog="kill_grasps.py"
    )
    parser.add_argument(
        "-o", "--out", type=Path, help="JSON lines, one per trial; trials in this file are not run again"
    )
    parser.add_argument("--kills", type=int, default=20, help="number of processes to kill")
    parser.add_argument("--stops", type=int, default=0, help="number of processes to stop for a second")
    parser.add_argument("--commands", nargs="+", choices=PARTS, default=["grasp"])
    parser.add_argument("--watchdog-ms", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--busy", type=int, default=0, help="number of busy loops that run at the same time")
    parser.add_argument("--json", action="store_true", help="print one JSON object with all trials")
    parser.add_argument("--servo", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.servo is not None:
        be_servo(chosen.servo)
        return
    trials = planned(chosen)
    lines = chosen.out.read_text().splitlines() if chosen.out is not None and chosen.out.exists() else []
    known = [json.loads(line) for line in lines]
    rows = [row for plan in trials for row in known if plan.items() <= row.items()]
    left = [plan for plan in trials if not any(plan.items() <= row.items() for row in known)]
    with ExitStack() as opened:
        folder = Path(opened.enter_context(tempfile.TemporaryDirectory()))
        servo = Servo(folder)
        opened.callback(servo.close)
        opened.enter_context(busy_loops(chosen.busy))
        needed = sorted({plan["command"] for plan in left})
        lives = {name: lives_s(name, servo, chosen.watchdog_ms, folder) for name in needed}
        late = Lateness()
        for plan in left:
            row = strike(plan, servo, lives[plan["command"]], folder)
            row["machine_late_ms_p99"], row["machine_late_ms_most"] = late.take()
            rows.append(row)
            text = json.dumps(row)
            print(text, file=sys.stderr, flush=True)
            if chosen.out is not None:
                with chosen.out.open("a") as file:
                    file.write(text + "\n")
    whole = summary(rows)
    if chosen.json:
        print(json.dumps({"command": "kill_grasps", "simulated": True, "rows": rows, "summary": whole}))
    else:
        for how in ("kill", "stop"):
            print(f"{how}s: {json.dumps(summary([row for row in rows if row['how'] == how]))}")
        print(f"all: {json.dumps(whole)}")
    if not chosen.busy and (whole["over_100_ms"] or whole["gripped_again"]):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
