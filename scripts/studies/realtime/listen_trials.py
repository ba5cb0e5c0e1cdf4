"""Record trials of a virtual arm through `evetac record --listen`, while client and server are killed.

    python scripts/studies/realtime/listen_trials.py -o rows.jsonl  # 200 trials, 50 kills: four to five minutes
    python scripts/studies/realtime/listen_trials.py -o rows.jsonl --trials 12 --connections 2 --clients 1 --servers 1

The camera is the real driver with a virtual DVXplorer. The pixel of each event encodes the time, by the computer's
clock, at which the event was made. A recording therefore contains the true time of each slice, and each mark can be
compared with the time at which the client sent it. One mark of each trial has no time of its own, another has `at_s`.

There are three kinds of kill. The connection is cut during a trial, and the client connects again. The client's process
is killed (SIGKILL), and another client takes over. The server is killed (SIGKILL), a new one starts in the same folder,
and `evetac validate --repair` joins the segments.

A trial counts as kept if its file is valid, has a slice for each ms from the answer to `start` until `stop` was sent,
and has all events in these slices. After a kill of the server, the last LOST_MS may be missing. After the trials, the
script tries to get in without the token: lines without it, HTTP, an endless line, and silent connections. -o gets one
line of JSON for each trial and attempt. All trials are simulated, by the computer's own clock.
"""

import argparse
import contextlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.console import print_table
from evetac_cli.events import FRAME_PX
from evetac_cli.inspect import validate
from evetac_cli.store.recordings.read import open_recording
from scripts.reproduce.facts import RESULTS
from scripts.reproduce.made_tables import table_of, write
from scripts.studies.realtime.clock_camera import BEGAN, EVENT_US, PIXELS, Clock

ROOT = Path(__file__).resolve().parents[3]
Recorder = runpy.run_path(str(ROOT / "examples" / "robot_trials.py"))["Recorder"]  # the client of the documentation
LOST_MS = 400.0  # allowed loss after a kill of the server: the open segment of 250 ms, and a busy disk
PATIENCE_S = 120.0
TITLE = "Trials that a virtual arm's program records through `record --listen`, with kills"
COLUMNS = {
    "killed in the middle of a trial": "{kill}",
    "trials": "{trials}",
    "kept": "{kept}",
    "lost at the end, most [ms]": "{lost_ms_most:.0f}",
    "`start` answered after, median [ms]": "{start_ms_median:.1f}",
    "marks with `at_s` off, most [ms]": "{stamped_off_ms_most:.2f}",
    "marks without it off, median [ms]": "{arrived_off_ms_median:.2f}",
    "within 1 ms": "{arrived_within_1_ms} of {trials}",
    "most [ms]": "{arrived_off_ms_most:.1f}",
}
NOTES = (
    "Kept: a valid file with every slice and event from the answer to `start` until `stop`, and both marks; if the"
    " server was killed, everything except the end, repaired. Each trial has one mark of each kind. The events of the"
    " recording show the time, from which the error of a mark is measured against the clock of the client. All rows:"
    " rows/listen.jsonl.",
)
Row = dict[str, Any]


class Server:
    """`evetac record --listen` with the clock camera, in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.began_file = folder.parent / "began"
        self.starts = 0
        self.start()

    def start(self) -> None:
        """Start it, and wait until it listens."""
        flags = ("--camera", Clock.name, "--gripper", "none", "--listen", "-o", str(self.folder))
        command = [sys.executable, str(Path(__file__).with_name("clock_camera.py")), "record", *flags]
        environment = {**os.environ, BEGAN: str(self.began_file)}
        self.process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            with contextlib.suppress(OSError, ValueError, RuntimeError):
                Recorder(str(self.folder)).ask("status")  # a killed server's file names a port that no longer exists
                break
            time.sleep(0.05)
        self.began_s = float(self.began_file.read_text())
        self.starts += 1

    def kill(self) -> None:
        """Kill it without warning."""
        self.process.kill()
        self.process.wait()

    def end(self) -> None:
        """Stop it with Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(PATIENCE_S)


CLIENT = """
import sys, time
sys.path.insert(0, {examples!r})
from robot_trials import Recorder
Recorder(sys.argv[1]).ask("start", name=sys.argv[2])
print(time.monotonic(), flush=True)
time.sleep(600)
"""


def trial(server: Server, name: str, kill: str, rng: np.random.Generator) -> Row:
    """Record one trial, with or without a kill in the middle, and compare its file with the arm's actions."""
    row: Row = {"trial": name, "kill": kill, "simulated": True}
    folder = str(server.folder)
    asked_s = time.monotonic()
    if kill == "client":
        source = CLIENT.format(examples=str(ROOT / "examples"))
        with subprocess.Popen(
            [sys.executable, "-P", "-c", source, folder, name], stdout=subprocess.PIPE, text=True
        ) as client:
            assert client.stdout is not None
            began_s = float(client.stdout.readline())
            time.sleep(rng.uniform(0.1, 0.3))
            client.kill()
        arm = Recorder(folder)
    else:
        arm = Recorder(folder)
        arm.ask("start", name=name)
        began_s = time.monotonic()
        row["start_ms"] = 1e3 * (began_s - asked_s)
        time.sleep(rng.uniform(0.1, 0.3))
        if kill == "connection":
            arm._lines.close()
            time.sleep(rng.uniform(0.0, 0.1))
            arm = Recorder(folder)
    status = arm.ask("status")
    row["continues"] = (status["state"], status["name"]) == ("recording", name)
    sent = {}
    for text, at in (("arrived", False), ("stamped", True)):
        sent[text] = time.monotonic()
        answer = arm.ask("mark", text=text, **({"at_s": sent[text]} if at else {}))
        row[f"{text}_answered_ms"] = 1e3 * (time.monotonic() - sent[text])
        row[f"{text}_slice"] = answer["slice"]
        time.sleep(rng.uniform(0.02, 0.1))
    if kill == "server":
        time.sleep(0.5)
        stopped_s = time.monotonic()
        server.kill()
        path = server.folder / f"{name}.recording.h5"
        began_of_camera_s = server.began_s
        validate.repair([path.with_name(f"{name}.recording.part")])
        server.start()
    else:
        stopped_s = time.monotonic()
        path = Path(arm.ask("stop")["file"])
        row["stop_ms"] = 1e3 * (time.monotonic() - stopped_s)
        began_of_camera_s = server.began_s
    return row | judged(path, began_of_camera_s, began_s, stopped_s, sent)


def judged(path: Path, camera_s: float, began_s: float, stopped_s: float, sent: dict[str, float]) -> Row:
    """Return what a file contains of a trial; camera_s: host time at which the camera's time began."""
    with open_recording(path) as recording:
        t_us = recording.read("events/t")
        shown = recording.read("events/x").astype(np.int64) + FRAME_PX[0] * recording.read("events/y").astype(np.int64)
        seen = np.concatenate([[0], np.cumsum(np.diff(shown) % PIXELS)])  # number of events made since the first
        first_s = camera_s + EVENT_US * 1e-6 * shown[0]
        first_s += round((began_s - first_s) / (EVENT_US * 1e-6 * PIXELS)) * EVENT_US * 1e-6 * PIXELS
        host_s = first_s + EVENT_US * 1e-6 * seen  # when each event was made
        end_s = host_s[-1] + EVENT_US * 1e-6
        row: Row = {
            "slices": len(recording),
            "events_missing": int(seen[-1] + 1 - len(seen)),
            "starts_late_ms": 1e3 * (host_s[0] - began_s),
            "ends_early_ms": 1e3 * (stopped_s - end_s),
            "marks": len(recording.marks),
        }
        for mark in recording.marks:
            nearest = int(np.argmin(np.abs(t_us - mark.t_us)))
            marked_s = host_s[nearest] + 1e-6 * (mark.t_us - t_us[nearest])
            row[f"{mark.text}_off_ms"] = 1e3 * (marked_s - sent[mark.text])
            row[f"{mark.text}_same_slice"] = mark.slice == row.get(f"{mark.text}_slice", mark.slice)
    row["faults"] = validate.run([path]).rows[0]["faults"]
    return row


def is_kept(row: Row) -> bool:
    """Whether the file contains the whole trial."""
    ends_early_ms = LOST_MS if row["kill"] == "server" else 0.0
    whole = row["starts_late_ms"] <= 0.0 and row["ends_early_ms"] <= ends_early_ms
    whole = whole and row["events_missing"] == 0 and row["continues"]
    return bool(row["faults"] is None and whole and row["marks"] == 2)


def reply_to(address: tuple[str, int], request: bytes, wait_s: float = 10.0) -> bytes:
    """Return what arrives on a connection until it closes."""
    answer = b""
    with socket.create_connection(address) as line, contextlib.suppress(OSError):
        line.settimeout(wait_s)
        line.sendall(request)
        while part := line.recv(4096):
            answer += part
    return answer


def unauthorised(folder: Path) -> list[Row]:
    """Return whether clients without the token got nothing, and one with it got in after they had gone."""
    host, port, token = (folder / "evetac.listen").read_text().split()
    address = (host, int(port))
    ask = json.dumps({"token": token, "command": "status"}).encode() + b"\n"
    tries = {
        "no token": b'{"command": "status"}\n',
        "another token": ask.replace(token.encode(), token[::-1].encode()),
        "token behind a line without": b"{}\n" + ask,
        "a page: GET": f"GET /{token} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode(),
        "a page: POST with the token": f"POST / HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode() + ask,
        "a line without an end": b"x" * 1_000_000,
        "no line at all": b"",
    }
    rows = []
    for name, request in tries.items():
        answer = reply_to(address, request)
        nothing = not answer or (b'"refused' in answer and b'"state"' not in answer)
        rows.append({"client": name, "refused": nothing})
    with contextlib.ExitStack() as held:
        for _ in range(100):
            held.enter_context(socket.create_connection(address))
        until_s = time.monotonic() + PATIENCE_S
        reached = False
        while not reached and time.monotonic() < until_s:
            with contextlib.suppress(OSError, RuntimeError):
                reached = Recorder(str(folder)).ask("status")["ok"]
            time.sleep(0.1)
    rows.append({"client": "100 silent connections", "refused": reached})
    return rows


def summary(rows: list[Row]) -> list[Row]:
    """Summarise the results by kind of kill; a last row is for clients without the token."""
    shown = []
    for kill in ("", "connection", "client", "server"):
        some = [row for row in rows if row.get("kill") == kill]
        if not some:
            continue
        off = {text: [abs(row[f"{text}_off_ms"]) for row in some] for text in ("arrived", "stamped")}
        starts = [row["start_ms"] for row in some if "start_ms" in row]
        shown.append(
            {
                "kill": {"": "nothing", "client": "process of the client"}.get(kill, kill),
                "trials": len(some),
                "kept": sum(map(is_kept, some)),
                "marks": sum(row["marks"] for row in some),
                "arrived_off_ms_median": float(np.median(off["arrived"])),
                "arrived_off_ms_most": max(off["arrived"]),
                "arrived_within_1_ms": sum(bool(one <= 1.0) for one in off["arrived"]),
                "stamped_off_ms_median": float(np.median(off["stamped"])),
                "stamped_off_ms_most": max(off["stamped"]),
                "stamped_within_1_ms": sum(bool(one <= 1.0) for one in off["stamped"]),
                "start_ms_median": float(np.median(starts)) if starts else None,
                "lost_ms_most": max(0.0, *(row["ends_early_ms"] for row in some)),
            }
        )
    return shown


def main() -> None:
    """Run the requested trials."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", type=Path, required=True, metavar="FILE", help="rows, one line of JSON each")
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--connections", type=int, default=30, help="kills of a connection")
    parser.add_argument("--clients", type=int, default=10, help="kills of a client's process")
    parser.add_argument("--servers", type=int, default=10, help="kills of the server")
    parser.add_argument("--table", action="store_true", help="write docs/results/listen-trials.json too")
    parser.add_argument("--seed", type=int, default=0, help="seed of the times of marks and kills")
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    kills = [*["connection"] * chosen.connections, *["client"] * chosen.clients, *["server"] * chosen.servers]
    kills += [""] * (chosen.trials - len(kills))
    rng.shuffle(kills)
    with tempfile.TemporaryDirectory(prefix="evetac-listen-trials-") as base, open(chosen.o, "w") as out:
        rows: list[Row] = []
        server = Server(Path(base) / "data")
        try:
            for number, kill in enumerate(kills):
                rows.append(trial(server, f"trial-{number:03d}", str(kill), rng))
                rows[-1]["kept"] = is_kept(rows[-1])
                print(json.dumps(rows[-1]), file=out, flush=True)
            for row in unauthorised(server.folder):
                rows.append(row)
                print(json.dumps(row), file=out, flush=True)
        finally:
            server.end()
        left = [path.name for path in server.folder.iterdir() if not path.name.endswith(".recording.h5")]
    if chosen.table:
        kills_said = f"--connections {chosen.connections} --clients {chosen.clients} --servers {chosen.servers}"
        command = (
            f"python scripts/studies/realtime/listen_trials.py --trials {chosen.trials} {kills_said} --table -o FILE"
        )
        trials_said = {"trials": chosen.trials, "kills": sum(map(bool, kills)), "servers": server.starts}
        write(RESULTS, table_of("listen-trials", TITLE, COLUMNS, summary(rows), command, trials_said, notes=NOTES))
    print_table("listen", summary(rows), {"servers": server.starts, "left_behind": len(left)}, simulated=True)
    print_table("unauthorised", [row for row in rows if "client" in row], {}, simulated=True)


if __name__ == "__main__":
    main()
