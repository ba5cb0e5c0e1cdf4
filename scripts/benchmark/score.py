"""Score the first methods on evetac-bench: the paper's, evetac's, counts of events, chance, and oracles.

    python scripts/benchmark/score.py bench-small --work rows --paper fast-slow.model.h5 --force shear.force-model.h5

- `the paper's`: tracker `paper`, network fast-slow (--paper), linear regression of force (--force), law `paper`;
- `the paper's, network of force`: the same with the paper's network of force;
- `evetac's`: tracker `stable`, pretrained detector, touch maps, law `load-proportional`;
- `counts of events`: examples/benchmark_counts.py, made without evetac;
- `chance`: a random instant, a constant score, no force, dots at rest, the grip fixed:50;
- `oracle`: the truth, and the law oracle:1.3 of studies/grip/oracle.py.

The folder --work keeps reports and played lifts. Writes docs/results/benchmark.json and benchmark-splits.json. All
figures are simulated.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.devices.simulated import SimulatedGripper, rig
from evetac_cli.errors import InputError
from evetac_cli.evaluate.benchmark import EvaluateBenchmark, command, data_set, own_methods, predictions, scores
from evetac_cli.evaluate.benchmark.data_set import Benchmark, Truth
from evetac_cli.evaluate.benchmark.predictions import WARNING_KINDS, Predictions
from evetac_cli.jobs import Row, Rows
from evetac_cli.kernels.grip.control import Control
from evetac_cli.sim import grasp_outcome
from evetac_cli.sim.setup.parts import untimed
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.store.recordings.trial_writer import TrialBuffer
from evetac_cli.trials import grasp
from evetac_cli.trials.grasp.loop import grasp_slices
from evetac_cli.trials.grasp.settings import SimulatedGrasp
from scripts.reproduce.facts import RESULTS
from scripts.reproduce.made_tables import table_of, write
from scripts.studies.grip import oracle as grip_oracle

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "benchmark_counts.py"
CHANCE_SEED = 105_999
FIXED = "fixed:50"  # the best fixed grip of scripts/studies/grip/trials.py
WARNS_MS = 20  # how far ahead the oracle warns


def scored(folder: Path, work: Path, name: str, params: EvaluateBenchmark) -> Rows:
    """Return the rows of `evetac evaluate benchmark`; an existing report of the same is not made again."""
    work.mkdir(parents=True, exist_ok=True)
    (job,) = command.jobs([folder], params, work / f"{name}.report.h5")
    try:
        return command.run(job, params).rows
    except InputError:  # a report of other methods, whose files are used again if they fit
        return command.run(job, params, force=True).rows


def chance_of(benchmark: Benchmark, true: dict[str, Truth]) -> Predictions:
    """Return predictions that know nothing: a random instant, a constant score, no force, dots at rest."""
    rng = np.random.default_rng(CHANCE_SEED)
    made = Predictions(onset_ms={}, warning={}, force_n={}, dot_xy_px={})
    assert made.onset_ms is not None and made.warning is not None
    assert made.force_n is not None and made.dot_xy_px is not None
    for name, entry in benchmark.entries.items():
        one = true[name]
        with open_recording(entry.path) as recording:
            rest_px = recording.read("sensor/dot_xy_px").reshape(-1, 2)
        made.dot_xy_px[name] = np.repeat(rest_px[None], len(one.dots_ms), axis=0)
        if entry.kind == "slip":
            made.onset_ms[name] = int(rng.integers(one.slices))
        if entry.kind == "press":
            made.force_n[name] = np.zeros_like(one.shear_n)
        if entry.kind in WARNING_KINDS:
            made.warning[name] = np.full(one.slices, 0.5, np.float32)
    return made


def truth_as_predictions(benchmark: Benchmark, true: dict[str, Truth]) -> Predictions:
    """Return the truth as predictions; the score of slip is 1 from WARNS_MS before gross slip to its end."""
    made = Predictions(onset_ms={}, warning={}, force_n={}, dot_xy_px={})
    assert made.onset_ms is not None and made.warning is not None
    assert made.force_n is not None and made.dot_xy_px is not None
    for name, entry in benchmark.entries.items():
        one = true[name]
        made.dot_xy_px[name] = one.dot_xy_px
        if entry.kind == "slip":
            made.onset_ms[name] = one.onset_ms
        if entry.kind == "press":
            made.force_n[name] = one.shear_n
        if entry.kind in WARNING_KINDS:
            ahead = one.slips.copy()
            for begin in one.slip_begins:
                ahead[max(begin - WARNS_MS, 0) : begin] = True
            made.warning[name] = ahead.astype(np.float32)
    return made


def oracle_lifts(benchmark: Benchmark, law: str) -> Rows:
    """Return the outcomes of all lifts with a law that has the truth of the simulation."""
    rows = []
    for name, lift in own_methods.read_lifts(benchmark).items():
        params = own_methods.lift_flags(benchmark, name, lift, controller="none")
        (one,) = grasp.jobs([], params, Path(f"{name}.recording.h5"))
        assert isinstance(one, SimulatedGrasp)
        devices = rig(one.plan, one.seeds(), untimed, lift_s=lift["lift_s"], balance_s=lift["balance_s"])
        buffer = TrialBuffer()
        try:
            assert isinstance(devices.gripper, SimulatedGripper)
            control = Control(grip_oracle.of_name(law, devices.gripper.simulation), one.timing.control_hz, law)
            for _, row in grasp_slices(devices, None, control, one.timing):
                buffer.append_rows(row)
        finally:
            devices.close()
        sensor = one.plan.sensor
        figures = grasp_outcome.outcome(
            buffer.row_arrays(), sensor.mm_per_px, one.timing.end_ms, sensor.gripper.force_per_current_n_ma
        )
        rows.append({**figures, "name": name, **{key: lift[key] for key in ("split", "object", "sensor")}})
    return rows


def all_methods(
    folder: Path, work: Path, paper_model: Path | None, force_model: Path | None, *, lifted: bool
) -> dict[str, Rows]:
    """Return the rows of each method; the paper's network and force model are left out if no file is given."""
    benchmark = data_set.read(folder)
    true = data_set.read_truth(benchmark)
    model: Any = paper_model if paper_model is not None else Path("none")
    of_paper: dict[str, Any] = {"tracker": "paper", "model": model}
    of_force: dict[str, Any] = {"shear_force": "none"}
    if force_model is not None:
        of_force = {"shear_force": "regression", "force_model": force_model}
    law = "paper" if paper_model is not None and lifted else ""
    found = {
        "the paper's": scored(folder, work, "paper", EvaluateBenchmark(**of_paper, **of_force, controller=law)),
    }
    if force_model is not None:
        network = {"shear_force": "network", "force_model": force_model}
        rows = scored(folder, work, "paper-network", EvaluateBenchmark(tracker="paper", model=Path("none"), **network))
        found["the paper's, network of force"] = [row for row in rows if row["task"] == "force"]
    found["evetac's"] = scored(
        folder, work, "evetac", EvaluateBenchmark(controller="load-proportional" if lifted else "")
    )
    counts = work / "counts"
    subprocess.run([sys.executable, str(EXAMPLE), str(folder), "--out", str(counts)], check=True)
    found["counts of events, made without evetac"] = scored(
        folder, work, "counts", EvaluateBenchmark(predictions=counts)
    )
    for name, made in (("chance", chance_of(benchmark, true)), ("oracle", truth_as_predictions(benchmark, true))):
        predictions.write(work / name, made, true)
        found[name] = scored(folder, work, name, EvaluateBenchmark(predictions=work / name))
    if not lifted:
        return found
    fixed = EvaluateBenchmark(model=Path("none"), shear_force="none", controller=FIXED)
    found["chance"] += [row for row in scored(folder, work, "fixed", fixed) if row["task"] == "grip"]
    found["oracle"] += scores.grip_rows(oracle_lifts(benchmark, "oracle:1.3"))
    return found


SHARE, LENGTH = "{%s:.2f} ({%s_low:.2f} to {%s_high:.2f})", "{%s:.3g} ({%s_low:.3g} to {%s_high:.3g})"
CELLS = {
    "onset within 50 ms before to 20 ms after slip": SHARE.replace("%s", "onset"),
    "warned 10 ms ahead at one false alarm per minute": SHARE.replace("%s", "warning"),
    "error of shear force [N]": LENGTH.replace("%s", "force"),
    "error of dots, rms [px]": LENGTH.replace("%s", "dots"),
    "held with at most 3 times the holding force": SHARE.replace("%s", "grip"),
    "held": SHARE.replace("%s", "kept"),
    "mean force over holding force": LENGTH.replace("%s", "force_over_holding"),
}


def flat(method: str, rows: Rows) -> Rows:
    """Return a row for each split of a method, with all tasks beside each other; no figure: a column is left out."""
    found: dict[str, Row] = {}
    for row in rows:
        one = found.setdefault(row["split"], {"method": method, "split": row["split"]})
        task = row["task"]
        one |= {task: row["value"], f"{task}_low": row["low"], f"{task}_high": row["high"], f"{task}_n": row["n"]}
        if task == "grip":
            one |= {key: value for key, value in row.items() if key.startswith(("kept", "force_over_holding"))}
    return list(found.values())


def tables(benchmark: Benchmark, found: dict[str, Rows], words: str) -> tuple[Row, Row]:
    """Return the table over all splits, and that by split."""
    rows = [row for method, of_method in found.items() for row in flat(method, of_method)]
    whole = [row for row in rows if row["split"] == scores.ALL]
    size = {task: whole[-1].get(f"{task}_n") for task in scores.TASKS}
    seeds = sorted(int(seed) for seed in _seeds(benchmark))
    sizes = {"recording_seeds": seeds, "size": benchmark.size, **size}
    counts = ", ".join(f"{task} {count}" for task, count in size.items() if count is not None)
    note = f"95 % intervals over sensors and objects, in brackets. n: {counts}. An empty cell: nothing was predicted."
    title = f"First methods on {data_set.NAME} v{data_set.VERSION}, {benchmark.size} size"
    of_all = {"method": "{method}", **CELLS}
    of_split = {"method": "{method}", "split": "{split}", **CELLS}
    parts = [row for row in rows if row["split"] != scores.ALL]
    return (
        table_of("benchmark", title, of_all, whole, words, sizes, notes=[note]),
        table_of("benchmark-splits", f"{title}, by split", of_split, parts, words, sizes),
    )


def _seeds(benchmark: Benchmark) -> set[str]:
    lines = (benchmark.folder / "truth" / "recordings.csv").read_text().splitlines()[1:]
    return {line.rsplit(",", 1)[1] for line in lines} | {
        str(lift["seed"]) for lift in own_methods.read_lifts(benchmark).values()
    }


def main() -> None:
    """Score all methods and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("benchmark", type=Path, help="folder of the benchmark")
    parser.add_argument("--work", type=Path, required=True, help="folder of reports and played lifts")
    parser.add_argument("--paper", type=Path, help="fast-slow, 10 ms ahead, trained by the paper's recipe")
    parser.add_argument("--force", type=Path, help="force model of the paper's method, on tracks by tracker `paper`")
    parser.add_argument("--no-lifts", action="store_true", help="leave out grip, whose lifts take most of the time")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the tables")
    chosen = parser.parse_args()
    found = all_methods(chosen.benchmark, chosen.work, chosen.paper, chosen.force, lifted=not chosen.no_lifts)
    words = f"python scripts/benchmark/score.py bench-{data_set.read(chosen.benchmark).size} --work FOLDER"
    words += "".join(
        f" --{flag} {path.name}" for flag, path in (("paper", chosen.paper), ("force", chosen.force)) if path
    )
    words += " --no-lifts" * chosen.no_lifts
    write(chosen.out, *tables(data_set.read(chosen.benchmark), found, words))
    sys.stdout.write(json.dumps({name: len(rows) for name, rows in found.items()}) + "\n")


if __name__ == "__main__":
    main()
