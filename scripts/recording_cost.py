"""Measure the cost of writing a simulated recording, alone and alongside other programs, and its number of blocks.

    python scripts/recording_cost.py                     # 12 trials of the scene slip, quiet and with four busy loops
    python scripts/recording_cost.py --trials 4 --busy 8

Each column is a run of `evetac record --scene slip --jobs 2`. It states the number of blocks per trial and the share of
a trial's processor time spent on writing, from the first block to the closed file (median and maximum). No clock
decides when a block is full, so neither figure may depend on the load of the computer. The exit status is 1 if the
numbers of blocks differ, or if writing takes a tenth of a trial or more.
"""

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

from evetac_cli.cli.main import main as evetac
from evetac_cli.console import print_table
from evetac_cli.store.recordings.trial_writer import TrialWriter
from evetac_cli.trials.record import simulated

MEASURED = "EVETAC_RECORDING_COST"  # names the file to which a worker adds a line for each trial
MOST_SHARE = 0.1


class TimedWriter(TrialWriter):
    """A writer that measures its own processor time."""

    last: "TimedWriter"

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.seconds, self._is_timed = 0.0, False
        TimedWriter.last = self

    def _write_block(self, **named: Any) -> Any:
        return self._timed(super()._write_block, **named)

    def finish(self, *arguments: Any) -> Any:
        """Finish like a TrialWriter, and add the time."""
        return self._timed(super().finish, *arguments)

    def _timed(self, call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        if self._is_timed:  # the last block is part of finish
            return call(*arguments, **named)
        self._is_timed, began_s = True, time.thread_time()
        result = call(*arguments, **named)
        self._is_timed = False
        self.seconds += time.thread_time() - began_s
        return result


def measure(results: Path) -> None:
    """Make every simulated trial of this process add a line to the file of results."""
    run = simulated.run
    # A full collection of all objects takes 60 ms, and would add to the time of the next part that allocates.
    gc.disable()

    def measured(*arguments: Any, **named: Any) -> Any:
        began_s = time.process_time()
        outcome = run(*arguments, **named)
        took_s, writer = time.process_time() - began_s, TimedWriter.last
        with results.open("a") as file:
            file.write(json.dumps({"blocks": writer.blocks, "cpu_s": took_s, "writing_s": writer.seconds}) + "\n")
        return outcome

    simulated.run = measured
    simulated.TrialWriter = TimedWriter  # type: ignore[misc]


@contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Run a number of programs that each occupy a core."""
    loops = [subprocess.Popen([sys.executable, "-P", "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def recorded(trials: int, busy: int) -> dict[str, Any]:
    """Run the command once; return its figures."""
    with tempfile.TemporaryDirectory(prefix="evetac-cost-") as folder, busy_loops(busy):
        results = Path(folder) / "trials.jsonl"
        command = ["record", "--scene", "slip", "--count", str(trials), "--jobs", "2", "-q", "-o", folder]
        began_s = time.monotonic()
        subprocess.run([sys.executable, __file__, *command], env={**os.environ, MEASURED: str(results)}, check=True)
        seconds = time.monotonic() - began_s
        rows = [json.loads(line) for line in results.read_text().splitlines()]
    shares = [row["writing_s"] / row["cpu_s"] for row in rows]
    return {
        "busy_loops": busy,
        "trials": len(rows),
        "time_s": seconds,
        "cpu_a_trial_s": median(row["cpu_s"] for row in rows),
        "blocks_a_trial": " ".join(map(str, sorted({row["blocks"] for row in rows}))),
        "writing_share_median": median(shares),
        "writing_share_most": max(shares),
    }


def main() -> int:
    """Run both cases, and check the results."""
    about = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    about.add_argument("--trials", type=int, default=12)
    about.add_argument("--busy", type=int, default=4, help="number of busy loops in the second run")
    chosen = about.parse_args()
    rows = [recorded(chosen.trials, busy) for busy in (0, chosen.busy)]
    print_table("recording cost", rows, {}, simulated=True)
    same = rows[0]["blocks_a_trial"] == rows[1]["blocks_a_trial"]
    return 0 if same and all(row["writing_share_most"] < MOST_SHARE for row in rows) else 1


# Workers of `--jobs 2` also load this script, under another name than __main__.
if MEASURED in os.environ:
    measure(Path(os.environ[MEASURED]))
if __name__ == "__main__":
    if MEASURED in os.environ:
        evetac()
    else:
        sys.exit(main())
