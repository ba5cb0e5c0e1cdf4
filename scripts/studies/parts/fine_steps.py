"""Run whole trials with the default steps of the mechanics and with a very fine fixed step, and compare them.

    python scripts/studies/parts/fine_steps.py -o steps.jsonl  # 100 slips, then 40 grasps
    python scripts/studies/parts/fine_steps.py -o steps.jsonl --kind slip --first 20 --count 20
    python scripts/studies/parts/fine_steps.py -o steps.jsonl --count 0  # the summary of the existing trials

Both simulations of a trial have the same seeds, node pitch, friction and camera; only the steps differ. The trials are
those of `evetac record --scene slip --object 1-20 --seed 10017 --count 5` and of `evetac grasp --object 1-20 --seed
10017 --count 2 --lift-s 3.5 --balance-s 1`, one trial of each object in turn, then the next of each. Every slip is
labelled, tracked, featurized and evaluated by the pretrained detector, with the default methods.

A trial is a line of JSON, written when both simulations are done, with the commit that made it. Trials that already
have a line are not run again. Three tables are printed, all simulated:

- How many slips differ, and by how much, in t_s (onset of gross slip), in the onset by the last stuck node, in the
  onset of the labels, and in the first detection.
- How often labels and detector are right against the truth of their own simulation, and how many grasps held.
- Every slip.

Shares have 95 % intervals. Exit code 1 if t_s differs by more than 1 ms in more than 2 of 100 slips. A step of 0.0125
ms costs about 80 times as much as a step of 1 ms: some 10 to 30 s of processor time per slip.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.arrays import Flags
from evetac_cli.console import show
from evetac_cli.evaluate.common.rows import ConfidenceInterval, SolverSetting, finite_or_none, share_difference
from evetac_cli.evaluate.cost.pipeline import ChainTrial, run_chain, run_grasp, slip_trial
from evetac_cli.evaluate.labels.measure import EARLIEST_MS, LATEST_MS, true_onsets
from evetac_cli.jobs import Row
from evetac_cli.kernels import estimates
from evetac_cli.kernels.slip import metrics
from evetac_cli.store.recordings.read import open_recording

OBJECTS = 20
COUNTS = {"slip": 100, "grasp": 40}
FINE_STEP_MS = 0.0125
APART_MS = (1, 5)
BOTH = DEFAULT, FINE = "default", "fine"
TIMINGS = ("early", "correct", "late")
MOST_APART = 0.02  # share of slips in which t_s may differ by more than 1 ms
ONSETS = ("t_s_ms", "t_every_node_ms", "label_ms", "detection_ms")


def settings(step_ms: float) -> dict[str, SolverSetting]:
    """Return the two settings of the simulation of a trial."""
    return {DEFAULT: SolverSetting(DEFAULT), FINE: SolverSetting("fixed step", solver={"step_ms": step_ms})}


def slip(trial: ChainTrial, setting: SolverSetting, folder: Path) -> Row:
    """Return the onsets of one slip, in slices from the start of the recording; None if there is none."""
    chain = run_chain(trial, setting, folder)
    with open_recording(slip_trial(trial, setting, folder).output) as recording:
        true = true_onsets(recording)
        steps = recording.read("truth/mechanical_steps")
    onsets = {"t_s_ms": true["t_s_ms"], "t_every_node_ms": true["t_every_node_ms"]}
    onsets |= {"label_ms": chain.label_ms, "detection_ms": chain.detection_ms}
    return {**onsets, "slices": chain.slices, "steps_a_slice": float(steps.mean()), "record_us": chain.record_us}


def grasp(trial: ChainTrial, setting: SolverSetting, folder: Path) -> Row:
    """Return the outcome of one grasp."""
    lifted = run_grasp(trial, setting, folder)
    return {"held": lifted.held, "moved_mm": lifted.moved_mm, "grasp_us": lifted.grasp_us}


def missing(chosen: argparse.Namespace, rows: list[Row]) -> Iterator[Row]:
    """Return the identities of requested trials that are not in rows."""
    done = {identity(row) for row in rows}
    for kind in chosen.kind:
        count = COUNTS[kind] - chosen.first if chosen.count is None else chosen.count
        for index in range(chosen.first, chosen.first + count):
            object_, number = index % OBJECTS + 1, index // OBJECTS
            row = {"kind": kind, "object": object_, "number": number, "seed": chosen.seed, "step_ms": chosen.step_ms}
            if identity(row) not in done:
                yield row


def identity(row: Row) -> tuple[Any, ...]:
    """Return the fields that identify a trial."""
    return tuple(row[name] for name in ("kind", "object", "number", "seed", "step_ms"))


def run(row: Row) -> Row:
    """Run both simulations of a trial."""
    trial = ChainTrial(row["object"], row["seed"], row["object"], row["number"])
    results = {}
    for name, setting in settings(row["step_ms"]).items():
        with tempfile.TemporaryDirectory() as folder:
            results[name] = (slip if row["kind"] == "slip" else grasp)(trial, setting, Path(folder))
    return {**row, "commit": commit(), **results}


def finished_rows(path: Path) -> list[Row]:
    """Return the JSON lines of a file, if it exists; an incomplete last line is removed from the file."""
    content = path.read_bytes() if path.exists() else b""
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        os.truncate(path, len(whole))
    return [json.loads(line) for line in whole.splitlines()]


def commit() -> str:
    """Return the current commit, marked if files have changed since."""
    command = ("git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--exclude", "*")
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def tables(rows: list[Row]) -> list[Row]:
    """Return three tables: how often onsets differ, how often labels and detections are right, and every slip."""
    slips = [row for row in rows if row["kind"] == "slip"]
    grasps = [row for row in rows if row["kind"] == "grasp"]
    held = {one: np.array([row[one]["held"] for row in grasps], bool) for one in BOTH}
    slipped = [row for row in slips if all(row[one]["t_s_ms"] is not None for one in BOTH)]
    answers = [
        _shares(f"labels {EARLIEST_MS} to {LATEST_MS} ms off", {one: _labelled(slipped, one) for one in BOTH}),
        *(_shares(f"detection {when}", {one: _detected(slipped, one, when) for one in BOTH}) for when in TIMINGS),
        _shares("grasp held", held),
    ]
    return [*(_differences(slips, name) for name in ONSETS), *answers, *map(_trial, slips)]


def _differences(slips: list[Row], name: str) -> Row:
    """Return the differences of an onset; an onset found in only one simulation counts as infinitely far."""
    apart = np.array([_apart(row, name) for row in slips])
    both = apart[np.isfinite(apart)]
    row: Row = {
        "onset": name.removesuffix("_ms"),
        "trials": len(slips),
        "in_one_alone": int(np.isinf(apart).sum()),
        "median_apart_ms": float(np.median(both)) if len(both) else None,
    }
    for limit_ms in APART_MS:
        beyond = np.abs(apart) > limit_ms
        row[f"over_{limit_ms}_ms"] = int(beyond.sum())
        row |= {f"share_over_{limit_ms}_ms_{end}": value for end, value in _ends(_share(beyond)).items()}
    return row


def _share(flags: Flags) -> ConfidenceInterval:
    """Return the share of trials in which a condition holds, with Wilson's interval."""
    return ConfidenceInterval(*estimates.share(int(np.count_nonzero(flags)), len(flags)), len(flags))


def _shares(what: str, holds: dict[str, Flags]) -> Row:
    """Return the share of trials in which a condition holds by default and with the fine step, and the difference."""
    shares = {one: _share(holds[one]) for one in BOTH}
    shares["more_by_default"] = share_difference(holds[DEFAULT], holds[FINE])
    row: Row = {"what": what, "trials": len(holds[DEFAULT])}
    for name, interval in shares.items():
        row[name] = finite_or_none(interval.mean)
        row |= {f"{name}_{end}": value for end, value in _ends(interval).items()}
    return row


def _ends(interval: ConfidenceInterval) -> Row:
    return {"low": finite_or_none(interval.low), "high": finite_or_none(interval.high)}


def _trial(row: Row) -> Row:
    """Return a slip by default, and how much later each onset is than with the fine step."""
    later = {f"{name.removesuffix('_ms')}_later_ms": finite_or_none(_apart(row, name)) for name in ONSETS}
    return {"object": row["object"], "trial": row["number"], "t_s_ms": row[DEFAULT]["t_s_ms"], **later}


def _apart(row: Row, name: str) -> float:
    """Return the onset by default minus that with the fine step; 0 if neither has one."""
    default, fine = row[DEFAULT][name], row[FINE][name]
    if default is None or fine is None:
        return 0.0 if default is fine else np.inf
    return float(default - fine)


def _labelled(slipped: list[Row], one: str) -> Flags:
    """Return in which trials the labels' onset is within the bounds around the truth of the same simulation."""
    errors = [_or_never(row[one]["label_ms"]) - row[one]["t_s_ms"] for row in slipped]
    return np.array([EARLIEST_MS <= error <= LATEST_MS for error in errors], bool)


def _detected(slipped: list[Row], one: str, when: str) -> Flags:
    """Return in which trials the first detection is early, correct or late against the truth of the same simulation."""
    first_ms = [(-1 if row[one]["detection_ms"] is None else row[one]["detection_ms"]) for row in slipped]
    pairs = zip(first_ms, slipped, strict=True)
    return np.array([metrics.timing(first, row[one]["t_s_ms"]) == when for first, row in pairs], bool)


def _or_never(onset_ms: int | None) -> float:
    return np.inf if onset_ms is None else float(onset_ms)


def main() -> None:
    """Run the missing trials and print the summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, required=True, help="JSON lines, one per trial")
    parser.add_argument("--kind", action="append", choices=tuple(COUNTS), help="slip or grasp; default: both")
    parser.add_argument("--first", type=int, default=0, help="number of the first trial, from 0")
    parser.add_argument("--count", type=int, help="trials of each kind; default: up to 100 slips and 40 grasps")
    parser.add_argument("--seed", type=int, default=10_017)
    parser.add_argument("--step-ms", type=float, default=FINE_STEP_MS, help="the fine step")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    chosen = parser.parse_args()
    chosen.kind = chosen.kind or list(COUNTS)

    rows = finished_rows(chosen.out)
    for planned in missing(chosen, rows):
        row = run(planned)
        rows.append(row)
        text = json.dumps(row)
        print(text, file=sys.stderr, flush=True)
        with chosen.out.open("a") as file:
            file.write(text + "\n")
    compared = [row for row in rows if (row["seed"], row["step_ms"]) == (chosen.seed, chosen.step_ms)]
    everything = tables(compared)
    (gross,) = (row for row in everything if row.get("onset") == "t_s")
    whole = {
        "slips": gross["trials"],
        "grasps": len(compared) - gross["trials"],
        "t_s_over_1_ms": gross["over_1_ms"],
        "fine_step_ms": chosen.step_ms,
        "commits": ", ".join(sorted({row["commit"] for row in compared})),
    }
    show("fine_steps", everything, whole, simulated=True, as_json=chosen.json)
    if gross["over_1_ms"] > MOST_APART * gross["trials"]:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
