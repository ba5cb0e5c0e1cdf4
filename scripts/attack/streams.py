"""Attack the stream of a virtual camera while `evetac record` records it; print one row per fault, exit 1 on failure.

    python scripts/attack/streams.py --seconds 5 --events-per-s 300000

A fault fails if the recording does not end in time, needs more memory than --memory-mb, or makes more slices than the
host's time allows. It also fails if the recording reports another number of lost events than the camera counts.
stream_attacks.py gives the allowed difference for each fault, and whether the report may be `at least`.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from evetac_cli.devices.virtual import dvxplorer
from scripts.attack.stream_attacks import ATTACKS, Attack, Ending

COLUMNS = ("fault", "wall_s", "peak_mb", "slices", "host_ms", "lost_reported", "lost_true", "ok", "wrong")
START_S = 60.0  # time for a recording beyond its seconds: to load, to compile and to join the file, in s


class CountingDvxplorer(dvxplorer.VirtualDvxplorer):
    """A virtual camera that records when it was first and last read."""

    made: "list[CountingDvxplorer]" = []

    def __init__(self, *given: Any, **more: Any) -> None:
        super().__init__(*given, **more)
        self.first_s = self.last_s = 0.0
        self.made.append(self)

    def ctrl_transfer(self, *given: Any) -> int:
        """Note the time of the last request before the stream runs."""
        self.first_s = time.monotonic() if self.last_s == 0.0 else self.first_s
        return super().ctrl_transfer(*given)

    def bulk_read(self, *given: Any) -> int:
        """Note the time of the last read of the stream."""
        self.last_s = time.monotonic() if self.model._runs else 0.0
        return super().bulk_read(*given)


def record_and_count(words: list[str], counts: Path) -> None:
    """Run `evetac` in this process, and write the camera's counts and the memory used to a file."""
    from evetac_cli.cli.main import main as run_evetac

    dvxplorer.VirtualDvxplorer = CountingDvxplorer  # type: ignore[misc]
    try:
        sys.argv = ["evetac", *words]
        run_evetac()
    finally:
        (camera,) = CountingDvxplorer.made
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        host_ms = 1e3 * (camera.last_s - camera.first_s)
        counts.write_text(json.dumps({"seen": camera.model.events_seen, "host_ms": host_ms, "peak_mb": peak_mb}))


def attacked(attack: Attack, seconds: float, events_s: float, memory_mb: float) -> dict[str, Any]:
    """Record with a fault in a process of its own; return the row of the table."""
    with tempfile.TemporaryDirectory() as folder:
        counts = Path(folder) / "counts.json"
        camera = f"virtual:prepared={events_s:g}+{attack.fault}"
        words = ["record", "--camera", camera, "--gripper", "none", "--seconds", f"{seconds:g}", "--json"]
        words += ["--expected-event-rate", f"{events_s:g}", "-o", f"{folder}/a.recording.h5"]
        began_s = time.monotonic()
        row: dict[str, Any] = dict.fromkeys(COLUMNS) | {"fault": attack.fault, "ok": False}
        try:
            run = subprocess.run(
                [sys.executable, __file__, "--counts", str(counts), *words],
                capture_output=True,
                check=False,
                text=True,
                timeout=START_S + 4 * seconds,
            )
        except subprocess.TimeoutExpired:
            return row | {"wrong": f"it did not end in {START_S + 4 * seconds:g} s"}
        row["wall_s"] = round(time.monotonic() - began_s, 1)
        if run.returncode != 0 or not counts.exists():
            return row | {"wrong": f"exit {run.returncode}: {run.stderr.strip()[-200:]}"}
        known = json.loads(counts.read_text())
        (made,) = json.loads(run.stdout)["rows"]
    ending = Ending(made["slices"], known["host_ms"], made["events"], known["seen"], made["lost"])
    wrong = ending.faults(attack, events_s)
    if known["peak_mb"] > memory_mb:
        wrong.append(f"more than {memory_mb:g} MB")
    return row | {
        "peak_mb": round(known["peak_mb"]),
        "slices": ending.slices,
        "host_ms": round(ending.host_ms),
        "lost_reported": ending.reported_lost,
        "lost_true": ending.lost,
        "ok": not wrong,
        "wrong": "; ".join(wrong),
    }


def main() -> int:
    """Run all attacks, or the named ones, and print a row for each."""
    if sys.argv[1:2] == ["--counts"]:
        record_and_count(sys.argv[3:], Path(sys.argv[2]))
        return 0
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=5.0, help="length of each recording")
    parser.add_argument("--events-per-s", type=float, default=300_000.0)
    parser.add_argument("--memory-mb", type=float, default=500.0, help="memory limit of a recording")
    parser.add_argument("--only", nargs="*", default=[], metavar="FAULT", help="these faults only")
    asked = parser.parse_args()
    attacks = [attack for attack in ATTACKS if not asked.only or attack.fault in asked.only]
    print(" | ".join(COLUMNS))
    failed = 0
    for attack in attacks:
        row = attacked(attack, asked.seconds, asked.events_per_s, asked.memory_mb)
        print(" | ".join("" if row[name] is None else str(row[name]) for name in COLUMNS), flush=True)
        failed += not row["ok"]
    print(f"{len(attacks) - failed} of {len(attacks)} as they should be")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
