"""Estimate the cost of the whole reproduction: tasks, hours and gigabytes, on 1, 16 and 256 cores.

    python scripts/plan.py                                # from the costs in scripts/plan_costs.json
    python scripts/plan.py --cores 1,64 --trajectories 10000,1000000
    python scripts/plan.py --measure FOLDER               # measure these costs again: some ten minutes of one core

The counts are those of the experiments (experiments.py) at full size: every command of reproduce.py and its number of
tasks. A task's cost is the processor time per second of recording, per training step or per evaluated file, measured on
one core, times their number. As in reproduce.py, a command begins when the previous one has ended, so a command with 5
trainings uses 5 cores. The tasks of one command are assumed to be equal.

The table also has a lower bound for any schedule: the longest chain of dependent tasks (record, label, track,
featurize, train, judge), or the total work divided by the cores, if that is larger. Training may stop earlier than
planned, by its validation. A training's data includes the files for evaluating its checkpoints. Pictures, `ship`,
studies and reports of costs are left out, as are storage, transfers and the cluster's own time.

--trajectories: record, label, track and featurize of that many independent trajectories of `slip`.
"""

import argparse
import json
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from statistics import median

from experiment_steps import Command
from experiments import EXPERIMENTS
from made_tables import commit
from reproduce import IN_PARALLEL
from results import put_measured

from evetac_cli.cli.workers import ONE_THREAD
from evetac_cli.console import print_table
from evetac_cli.events import SLICES_PER_S
from evetac_cli.jobs import Row
from evetac_cli.kernels.slip.metrics import LAST_CHECKPOINTS

Costs = dict[str, dict[str, float]]

COSTS = Path(__file__).with_name("plan_costs.json")
TONES = 5  # number of tones in the scenes `vibration` and `vibration-randomized` without --tone
VIBRATION_S = 102.2  # seconds of the scene `vibration`; the other scene differs only in its length
TOUCH_S = 1.5  # of a grasp, before it lifts
LIFT_S, BALANCE_S = 10.0, 20.0
LOOP = ("--controller", "paper", "--model", "shipped", "--node-pitch-mm", "1.45")
LABEL_METHODS = ("farneback", "event-flow")
PRESETS = ("unregularised", "paper", "official", "stable")
RECORDED = ("slip", "edge", "shear", "data-rate", "vibration-randomized")
EPOCH_STEPS = 100  # a guess, for the demo; all other trainings are planned in steps
STEPS = (50, 250)  # steps of two short trainings; the cost of a step is their difference


@dataclass(frozen=True)
class Files:
    """Files of one kind made by a command: the name of one of them, their number, and the seconds of each recording."""

    name: str
    count: int
    seconds: float


@dataclass(frozen=True)
class Step:
    """A command: equal tasks, each with its processor time and the bytes that it writes."""

    experiment: str
    command: str
    tasks: int
    cpu_s: float
    size_bytes: float

    def took_s(self, cores: int) -> float:
        """Return the time on a number of cores, each with one task at a time."""
        return math.ceil(self.tasks / cores) * self.cpu_s


def option(words: Command, name: str, usual: str = "") -> str:
    """Return the value of an option."""
    return words[words.index(name) + 1] if name in words else usual


def numbers(text: str) -> int:
    """Return how many whole numbers `1-9,12` names."""
    ends = [part.split("-") for part in text.split(",")]
    return sum(int(end[-1]) - int(end[0]) + 1 for end in ends)


def matching(patterns: Command, made: list[Files]) -> list[Files]:
    """Return the files of the folders and kinds that patterns name; as in a shell, a star does not match a slash."""

    def matches(files: Files, pattern: str) -> bool:
        (folder, name), (of_folder, of_name) = files.name.rpartition("/")[::2], pattern.rpartition("/")[::2]
        same_depth = files.name.count("/") == pattern.count("/")
        return same_depth and fnmatchcase(folder, of_folder) and name.split(".")[1:] == of_name.split(".")[1:]

    return [files for files in made if any(matches(files, pattern) for pattern in patterns)]


def steps(costs: Costs) -> Iterator[Step]:
    """Return every command of every experiment at full size; SystemExit for a command without a measured cost."""
    folders: dict[str, list[Files]] = {}
    for experiment in EXPERIMENTS:
        if not experiment.in_plan:
            continue
        made = folders.setdefault(experiment.folder, [])
        for words in (*experiment.steps(experiment.full), *experiment.evaluations(experiment.full).values()):
            if words[0] == "evetac" and words[1:3] != ["evaluate", "cost"]:
                yield from of_command(experiment.name, words[1:], made, costs)


def trainings() -> list[tuple[str, str]]:
    """Return the networks that the experiments train, each with its presets."""
    commands = [words for experiment in EXPERIMENTS for words in experiment.steps(experiment.full)]
    training = [words for words in commands if words[:2] == ["evetac", "train"]]
    return sorted({(option(words, "--model", "hist10"), option(words, "--preset", "adamw")) for words in training})


def of_command(experiment: str, words: Command, made: list[Files], costs: Costs) -> Iterator[Step]:
    """Yield the steps of one command, given without `evetac`, and add the files that it makes to `made`."""
    command = words[0]
    if command in ("record", "grasp"):
        yield _recorded(experiment, words, made, costs)
        return
    end = next((number for number, word in enumerate(words) if word.startswith("--")), len(words))
    if command == "evaluate":
        what, patterns = words[1], [word for word in words[2:end] if "*" in word]
        models = matching(words[end:], made)
        judged = sum(files.count for files in matching(patterns, made))
        if what == "slip":  # each model is evaluated separately
            count = sum(files.count for files in models)
            yield Step(experiment, "evaluate slip", count, costs["evaluate slip"]["cpu_s"] * judged, 0.0)
            return
        many = sum(files.count for files in models) or 1
        yield Step(experiment, f"evaluate {what}", 1, costs[f"evaluate {what}"]["cpu_s"] * judged * many, 0.0)
        return
    inputs = matching(words[1:end], made)
    if not inputs:
        raise SystemExit(f"{experiment}: no file of an earlier command matches {' '.join(words)}")
    if command.startswith("train"):
        yield _trained(experiment, words, inputs, made, costs)
        return
    kind = {"track": f"track {option(words, '--preset', 'stable')}", "featurize": "featurize",
            "label": f"label {option(words, '--method', 'event-flow')}",
            "track-rgb": "track-rgb"}[command]  # fmt: skip
    suffix = {"label": "labels", "featurize": "features"}.get(command, "tracks")
    for files in inputs:
        path = PurePosixPath(files.name)
        usual = path.parent / "rgb" if command == "track-rgb" else path.parent
        folder = PurePosixPath(option(words, "--out", str(usual)))
        name = path.name.replace(".recording.", f".{suffix}.")
        made.append(Files(str(folder / name), files.count, files.seconds))
    count = sum(files.count for files in inputs)
    seconds = sum(files.count * files.seconds for files in inputs)
    each = costs[kind]
    yield Step(experiment, kind, count, each["cpu_s"] * seconds / count, each["size_bytes"] * seconds / count)


def _recorded(experiment: str, words: Command, made: list[Files], costs: Costs) -> Step:
    grasp = words[0] == "grasp"
    scene = "grasp" if grasp else option(words, "--scene", "slip")
    count = numbers(option(words, "--object", "8")) * int(option(words, "--count", "1"))
    if scene.startswith("vibration"):
        count = int(option(words, "--count", "1")) * (numbers(option(words, "--tone")) if "--tone" in words else TONES)
    each = costs["vibration-randomized" if scene == "vibration" else scene]
    seconds = VIBRATION_S if scene == "vibration" else each["seconds"]
    if grasp:
        seconds = (
            TOUCH_S
            + float(option(words, "--lift-s", str(LIFT_S)))
            + float(option(words, "--balance-s", str(BALANCE_S)))
        )
    share = seconds / each["seconds"]
    out = option(words, "--out")
    name = out if out.endswith(".h5") else str(PurePosixPath(out) / f"{scene}-200hz-s0-000.recording.h5")
    made.append(Files(name, count, seconds))
    return Step(experiment, f"record {scene}", count, each["cpu_s"] * share, each["size_bytes"] * share)


def _trained(experiment: str, words: Command, inputs: list[Files], made: list[Files], costs: Costs) -> Step:
    out = option(words, "--out")
    if words[0] == "train-force":
        made.append(Files(out, 1, 0.0))
        return Step(experiment, "train-force", 1, costs["train-force"]["cpu_s"], 0.0)
    model = option(words, "--model", "hist10")
    seeds = int(option(words, "--seeds", "1")) * int(option(words, "--folds", "1"))
    networks = int(option(words, "--networks", "1"))
    preset = option(words, "--preset", "adamw")
    each = costs[f"train {model} {preset}"]
    planned = int(option(words, "--max-steps", "0")) or int(option(words, "--epochs")) * EPOCH_STEPS
    name = out if out.endswith(".h5") else f"{out}/{model}-s0.model.h5"
    validated = sum(files.count for files in matching([f"{option(words, '--validate')}/*.features.h5"], made))
    read_s = costs["train: a file read"]["cpu_s"] * (sum(files.count for files in inputs) + validated)
    judged_s = costs["evaluate slip"]["cpu_s"] * validated * LAST_CHECKPOINTS * networks
    cpu_s = each["cpu_s"] * planned * networks + read_s + judged_s
    made.append(Files(name, seeds, 0.0))
    return Step(experiment, f"train {model}", seeds, cpu_s, each["size_bytes"] * networks)


# --- what is planned from it ------------------------------------------------------------------------------------------


def chain_s(planned: list[Step]) -> float:
    """Return the longest chain of dependent tasks: one task of every kind, from the longest experiment."""
    longest = 0.0
    for name in dict.fromkeys(step.experiment for step in planned):
        kinds: dict[str, float] = {}
        for step in planned:
            if step.experiment == name:
                kind = step.command.split()[0]
                kinds[kind] = max(kinds.get(kind, 0.0), step.cpu_s)
        longest = max(longest, sum(kinds.values()))
    return longest


def table(planned: list[Step], cores: list[int]) -> list[Row]:
    """Return a row for every experiment, and one for all."""
    rows: list[Row] = []
    for name in (*dict.fromkeys(step.experiment for step in planned), "all"):
        chosen = [step for step in planned if name in ("all", step.experiment)]
        row: Row = {"experiment": name, "tasks": sum(step.tasks for step in chosen)}
        row["size_gb"] = sum(step.tasks * step.size_bytes for step in chosen) / 1e9
        row |= {f"hours_on_{count}": sum(step.took_s(count) for step in chosen) / 3600 for count in cores}
        rows.append(row)
    return rows


def least(planned: list[Step], cores: list[int]) -> Row:
    """Return the hours that no order of the tasks can undercut."""
    work_s = sum(step.tasks * step.cpu_s for step in planned)
    return {f"at_least_hours_on_{count}": max(work_s / count, chain_s(planned)) / 3600 for count in cores}


def many(costs: Costs, counts: list[int], cores: list[int]) -> list[Row]:
    """Return a row for every number of trajectories: the cost of the four stages, one trajectory after the other."""
    seconds = costs["slip"]["seconds"]
    stages = ("label event-flow", "track stable", "featurize")
    each_s = costs["slip"]["cpu_s"] + seconds * sum(costs[stage]["cpu_s"] for stage in stages)
    each_bytes = costs["slip"]["size_bytes"] + seconds * sum(costs[stage]["size_bytes"] for stage in stages)
    return [
        {"trajectories": count, "recorded_hours": count * seconds / 3600, "core_hours": count * each_s / 3600,
         "size_gb": count * each_bytes / 1e9,
         **{f"hours_on_{number}": math.ceil(count / number) * each_s / 3600 for number in cores}}
        for count in counts
    ]  # fmt: skip


# --- measuring --------------------------------------------------------------------------------------------------------


def cpu_of(*words: object) -> float:
    """Return the processor time of a command in this process; SystemExit if it fails."""
    from typer.testing import CliRunner

    from evetac_cli.cli.main import app

    alone = ("--jobs", "1") if words[0] in IN_PARALLEL else ()
    began = time.process_time()
    done = CliRunner().invoke(app, [*map(str, (*words, *alone)), "--quiet", "--force"])
    if done.exit_code:
        raise SystemExit(f"{' '.join(map(str, words))} ended with {done.exit_code}: {done.output}")
    return time.process_time() - began


def measure(folder: Path) -> Costs:
    """Measure the cost of every kind of task on one core."""
    from evetac_cli.store.recordings.read import open_recording

    costs: Costs = {}
    folder.mkdir(parents=True)

    def size(pattern: str) -> float:
        return float(sum(path.stat().st_size for path in folder.glob(pattern)))

    def recorded(scene: str, words: tuple[object, ...], count: int) -> None:
        cpu_s = cpu_of(*words, "--out", folder / scene) / count
        lengths = []
        for path in sorted((folder / scene).glob("*.recording.h5")):
            with open_recording(path) as recording:
                lengths.append(len(recording) / SLICES_PER_S)
        costs[scene] = {"cpu_s": cpu_s, "seconds": sum(lengths) / count,
                        "size_bytes": size(f"{scene}/*.recording.h5") / count}  # fmt: skip
        print(scene, costs[scene], flush=True)

    cpu_of("record", "--object", "3,8", "--seed", 1, "--out", folder / "warm")  # loads the modules; evaluated later
    cpu_of("grasp", *LOOP, "--lift-s", 1, "--balance-s", 0, "--out", folder / "warm")
    for scene in RECORDED:
        tone = ("--tone", 200) if scene.startswith("vibration") else ()
        several = {"slip": 4, "shear": 3}.get(scene, 1)
        trials = ("--count", 3) if scene == "shear" else ("--object", "3,8,11,16") if several == 4 else ()
        recorded(scene, ("record", "--scene", scene, *trials, *tone), several)
    recorded("grasp", ("grasp", "--object", 11, *LOOP), 1)
    slips = sorted((folder / "slip").glob("*.recording.h5"))
    warm = sorted((folder / "warm").glob("slip*.recording.h5"))
    seconds = len(slips) * costs["slip"]["seconds"]

    def stage(name: str, made: str, *words: object) -> None:
        cpu_of(*words, *warm)
        cpu_s = cpu_of(*words, *slips)
        costs[name] = {"cpu_s": cpu_s / seconds, "size_bytes": size(f"slip/{made}.h5") / seconds}
        print(name, costs[name], flush=True)

    for method in LABEL_METHODS:
        stage(f"label {method}", "*.labels", "label", "--method", method)
    for preset in PRESETS:
        stage(f"track {preset}", "*.tracks", "track", "--preset", preset)
    stage("featurize", "*.features", "featurize")

    def trained(model: str, preset: str) -> None:
        how = ("train", *features[:-1], "--model", model, "--preset", preset, "--validate", features[-1],
               "--out", folder / f"{model}.model.h5")  # fmt: skip
        few, more = (cpu_of(*how, "--max-steps", count) for count in STEPS)
        costs[f"train {model} {preset}"] = {"cpu_s": (more - few) / (STEPS[1] - STEPS[0]),
                                           "size_bytes": size(f"{model}.model.h5")}  # fmt: skip
        print(model, preset, costs[f"train {model} {preset}"], flush=True)

    features = sorted((folder / "slip").glob("*.features.h5"))
    trained("hist10", "adamw")  # loads torch; measured again below
    for model, preset in trainings():
        trained(model, preset)

    def per_file(name: str, kind: str, words: tuple[object, ...], options: tuple[object, ...]) -> None:
        """Return the cost per file without the start of the command: all files minus one file, medians of three."""

        def took(paths: list[Path]) -> float:
            outputs = [folder / f"{turn}-of-{len(paths)}.{kind}.h5" for turn in range(3)]
            return median(cpu_of(*words, *paths, *options, "--out", output) for output in outputs)

        costs[name] = {"cpu_s": (took(features) - took(features[:1])) / (len(features) - 1), "size_bytes": 0.0}
        print(name, costs[name], flush=True)

    learn, validate = sorted((folder / "warm").glob("slip*.features.h5"))
    how = ("--max-steps", STEPS[0], "--validate", validate)
    per_file("train: a file read", "model", ("train",), ("--model", "hist10", *how))
    judge = folder / "judge.model.h5"
    cpu_of("train", learn, "--model", "hist10", *how, "--out", judge)
    per_file("evaluate slip", "report", ("evaluate", "slip"), ("--model", judge, "--jobs", 1))

    def judged(what: str, count: int, *words: object) -> None:
        cpu_of("evaluate", what, *words, "--out", folder / "warm" / f"{what}.report.h5")
        cpu_s = cpu_of("evaluate", what, *words, "--out", folder / f"{what}.report.h5")
        costs[f"evaluate {what}"] = {"cpu_s": cpu_s / count, "size_bytes": size(f"{what}.report.h5")}

    tracks = sorted((folder / "slip").glob("*.tracks.h5"))
    judged("labels", len(slips), *sorted((folder / "slip").glob("*.labels.h5")))
    judged("tracking", len(slips), *tracks)
    judged("data-rate", 1, *sorted((folder / "data-rate").glob("*.recording.h5")))
    judged("vibration", 1, *sorted((folder / "vibration-randomized").glob("*.recording.h5")),
           "--windows", "10,2,1,0.25")  # fmt: skip
    judged("grasp", 1, *sorted((folder / "grasp").glob("*.recording.h5")))
    stage("track-rgb", "rgb/*.tracks", "track-rgb", "--out", folder / "slip" / "rgb")
    force_model = folder / "dots.force-model.h5"
    shears = sorted((folder / "shear").glob("*.recording.h5"))
    cpu_of("track", *shears)
    *learnt, unseen = sorted((folder / "shear").glob("*.tracks.h5"))
    costs["train-force"] = {"cpu_s": cpu_of("train-force", *learnt, "--out", force_model),
                            "size_bytes": size(force_model.name)}  # fmt: skip
    judged("force", 1, unseen, "--model", force_model)
    return costs


def main() -> None:
    """Read the flags; measure, or plan."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cores", default="1,16,256", help="numbers of cores")
    parser.add_argument("--trajectories", default="10000,1000000", help="numbers of trajectories")
    parser.add_argument("--measure", type=Path, metavar="FOLDER", help="measure the costs, in a new folder")
    parser.add_argument("--page", type=Path, help="put the tables into this page")
    chosen = parser.parse_args()
    if chosen.measure:
        os.environ |= dict.fromkeys(ONE_THREAD, "1")  # before these libraries are loaded
        COSTS.write_text(json.dumps(measure(chosen.measure), indent=1) + "\n")
    elif not COSTS.exists():
        parser.error(f"{COSTS} is missing; make it with --measure FOLDER")
    costs: Costs = json.loads(COSTS.read_text())
    cores = [int(count) for count in chosen.cores.split(",")]
    planned = list(steps(costs))
    experiments, fastest = table(planned, cores), least(planned, cores)
    print_table("plan", experiments, fastest, simulated=True)
    trajectories = many(costs, [int(count) for count in chosen.trajectories.split(",")], cores)
    print_table("record, label, track, featurize", trajectories, {}, simulated=True)
    if chosen.page:
        said = f"By plan.py at commit {commit()[0]}, costs of tasks measured on one core"
        bound = {name.replace("at_least_", ""): value for name, value in fastest.items()}
        put_measured(chosen.page, "plan", [*experiments, {"experiment": "all, at least", **bound}], said)
        put_measured(chosen.page, "trajectories-planned", trajectories, said)


if __name__ == "__main__":
    main()
