"""Measure the cost of a live view for a recording and its pictures per second, in recordings with and without a view.

    python scripts/studies/realtime/live_view.py [--seconds 60] [--pairs 5] [--busy 0] [-o runs.json]

A recording is `evetac record --camera virtual:prepared --gripper none` at 1000 slices per second: the real driver,
prepared event words, and the recorder. The view is `--live`. A client in this program requests
picture after picture, as a browser does, and counts them. The order within a pair alternates.

Lost slices are slices without an event, which this camera never sends, plus the number of slices that the events lost
in the queue would have filled. --busy starts programs that only compute. With them, pictures may be lost, but no more
slices than without a view. Simulated.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np

from evetac_cli.console import print_table
from evetac_cli.store.recordings.read import open_recording
from scripts.studies.realtime.grasps import grid

HERE = Path(__file__).resolve().parents[3]
ADDRESS = re.compile(r"live view: (http://\S+)")
SETTLE_S = 1.0  # the first pictures of a view are not counted, because the camera is still opening
MOST_LOST = 1e-4
LEAST_PICTURES_S = 15.0
BUSY = "while True: pass"


@dataclass
class Client:
    """Requests pictures until the recording ends, and records when each arrived."""

    received_s: list[float] = field(default_factory=list)
    left_out: int = 0
    ended: str = ""

    def watch(self, address: str) -> None:
        known = ""
        while not self.ended:
            with urlopen(f"{address}pictures?known={known}") as answer:
                message = answer.read()
            news = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
            self.ended = news.get("ended", "")
            known = news.get("version", "")
            if not self.ended and news["sample"]["slices"]:
                self.received_s.append(time.monotonic())
                self.left_out = news["left_out"]

    def figures(self) -> dict[str, Any]:
        came = np.array(self.received_s)
        came = came[came > came[0] + SETTLE_S] if len(came) else came
        if len(came) < 2:
            return {"pictures": len(self.received_s), "pictures_per_s": 0.0, "longest_ms": None}
        gaps_s = np.diff(came)
        rate = float((len(came) - 1) / (came[-1] - came[0]))
        longest_ms = float(1e3 * gaps_s.max())
        return {
            "pictures": len(self.received_s),
            "pictures_per_s": rate,
            "longest_ms": longest_ms,
            "left_out": self.left_out,
        }


def one(chosen: argparse.Namespace, folder: Path, *, live: bool) -> dict[str, Any]:
    """Make one recording; return the figures of its table and its file."""
    out = folder / "run.recording.h5"
    words = [
        *("--camera", f"virtual:prepared={chosen.events_per_s}", "--gripper", "none"),
        *("--calibration", str(grid(folder)), "--seconds", f"{chosen.seconds:g}"),
        *(["--live"] if live else []),
        *("-q", "--json", "--force", "-o", str(out)),
    ]
    away = ("DISPLAY", "WAYLAND_DISPLAY")  # no browser opens: the client takes its place
    environment = {name: value for name, value in os.environ.items() if name not in away} | {"PYTHONPATH": str(HERE)}
    command = [sys.executable, "-P", "-m", "evetac_cli", "record", *words]
    with subprocess.Popen(
        command, cwd=HERE, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        client, said = Client(), []
        thread = None
        for line in run.stderr or ():
            said.append(line)
            address = ADDRESS.search(line)
            if address:
                thread = threading.Thread(target=client.watch, args=(address.group(1),))
                thread.start()
        printed = run.stdout.read() if run.stdout else ""
    if thread is not None:
        thread.join()
    if run.returncode:
        raise SystemExit(f"no recording was made: {''.join(said)}{printed}")
    (row,) = json.loads(printed)["rows"]
    with open_recording(out) as recording:
        empty = int((np.diff(recording.starts) == 0).sum())
    out.unlink()
    lost = int(re.sub(r"\D", "", str(row["lost"])) or 0)
    slices_lost = empty + lost / (chosen.events_per_s * 1e-3)
    return {
        "live": live,
        "slices": row["slices"],
        "slices_per_s": row["slices_per_s"],
        "slices_lost": slices_lost,
        "lost_percent": 100 * slices_lost / row["slices"],
        "slice_late_us_p99": row["slice_late_us_p99"],
        "late_slices": row["late_slices"],
        **(client.figures() if live else {}),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="length of a recording, at most 119")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--events-per-s", type=int, default=1_000_000)
    parser.add_argument("--busy", type=int, default=0, help="number of programs that only compute")
    parser.add_argument("-o", "--out", type=Path, help="all runs as JSON")
    chosen = parser.parse_args()
    rows = []
    busy = [subprocess.Popen([sys.executable, "-P", "-c", BUSY]) for _ in range(chosen.busy)]
    try:
        with tempfile.TemporaryDirectory() as folder:
            for pair in range(chosen.pairs):
                for live in (False, True) if pair % 2 == 0 else (True, False):
                    rows.append({"pair": pair, **one(chosen, Path(folder), live=live)})
                    print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    finally:
        for each in busy:
            each.kill()
            each.wait()
    medians = []
    for live in (False, True):
        ours = [row for row in rows if row["live"] == live]
        names = ("slices_per_s", "slices_lost", "lost_percent", "slice_late_us_p99", "late_slices")
        figures = {name: float(np.median([row[name] for row in ours])) for name in names}
        most = max(row["lost_percent"] for row in ours)
        rates = [row["pictures_per_s"] for row in ours] if live else []
        pictures = {"pictures_per_s": float(np.median(rates)), "fewest_per_s": min(rates)} if live else {}
        medians.append({"live": live, "runs": len(ours), **figures, "most_lost_percent": most, **pictures})
    title = f"record, {chosen.seconds:g} s at {chosen.events_per_s:,} events/s, {chosen.busy} busy programs, medians"
    for group in medians:
        print_table(title, [group], {}, simulated=True)
    without, with_ = medians
    holds = {
        f"at least {LEAST_PICTURES_S:g} pictures/s in every run": with_["fewest_per_s"] >= LEAST_PICTURES_S,
        "median of slices lost not above that without": with_["slices_lost"] <= without["slices_lost"],
        f"at most {100 * MOST_LOST:g} % lost in every run": max(row["lost_percent"] for row in rows) <= 100 * MOST_LOST,
    }
    for words, held in holds.items():
        print(f"{'yes' if held else 'NO '}  {words}")
    if chosen.out:
        chosen.out.write_text(json.dumps({"settings": vars(chosen) | {"out": None}, "runs": rows, "holds": holds}))


if __name__ == "__main__":
    main()
