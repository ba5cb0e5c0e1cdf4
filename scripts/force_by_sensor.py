"""Forces on sensors that no model saw: the tables of docs/forces.md, as docs/results/force-sensors and force-objects.

    python scripts/force_randomized.py DATA --first 20000 --sensors 20 --trials shear-0 slip ADAPT
    python scripts/force_by_sensor.py DATA --first 20000 --identified BLIND

ADAPT stands for adapt-0 to adapt-11: a minute of known forces. BLIND is the folder of blind_identification.py on the
same sensors. For the paper's method it makes four trials of the sensor `evetac` besides (DATA/evetac). What is there is
not made again, and an evaluation that was done is read from its report; all figures are simulated.
"""

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

from experiment_tables import Column, Evaluation, Evaluations, Table
from reproduce import ROOT, Refusal, keep, report_header, result, run_command

from evetac_cli.resources import FORCE_MODEL

Row = dict[str, Any]
WAYPOINTS, TRIALS, SAMPLES = 8, 4, 100  # of the sensor that the paper's method learns
JUDGED_SAMPLES = 90
TRACKERS = ("stable", "paper")
STATES = {  # as `evaluate force` calls them
    "unknown": "nothing",
    "known": "scale, moduli within {stiffness_error:.0%}",
    "identified": "what `identify` tells, and the scale",
    "adapted": "nothing before, then adapted",
    "known, adapted": "scale, moduli within {stiffness_error:.0%}, then adapted",
    "identified, adapted": "what `identify` tells, and the scale, then adapted",
}
PAPER_MODELS = {"regression": "linear regression", "network": "network"}
FIGURES = ("mae_n", "worst_sensor_mae_n", "normal_mae_n", "normal_mae_of_range", "shear_within_sd", "normal_within_sd")


def state_rows(evaluation: Evaluation, tracker: str) -> list[Row]:
    """A row for everything that is known of the gel."""
    rows, summary = [], evaluation.summary
    for state, words in STATES.items():
        name = state.replace(", ", "_and_")
        if f"{name}_mae_n" in summary:
            figures = {key: summary[f"{name}_{key}"] for key in FIGURES}
            sensors = summary.get(f"{name}_sensors", summary["sensors"])
            rows.append({"known": words.format_map(summary), "tracker": tracker, "sensors": sensors, **figures})
    return rows


def paper_rows(evaluation: Evaluation, tracker: str) -> list[Row]:
    """A row for each of the paper's models, trained on one sensor."""
    rows = []
    for model, words in PAPER_MODELS.items():
        by_sensor: dict[str, list[float]] = {}
        for row in evaluation.rows:
            if row["model"] == model:
                by_sensor.setdefault(row["sensor_name"], []).append((row["mae_n_x"] + row["mae_n_y"]) / 2)
        errors = [sum(values) / len(values) for values in by_sensor.values()]
        known = f"the paper's {words}, trained on `evetac` alone"
        figures = {"mae_n": sum(errors) / len(errors), "worst_sensor_mae_n": max(errors)}
        rows.append({"known": known, "tracker": tracker, "sensors": len(errors), **figures})
    return rows


def sensor_rows(evaluations: Evaluations) -> list[Row]:
    """Rows of both trackers, then the paper's method."""
    rows = []
    for tracker in TRACKERS:
        if tracker in evaluations:
            rows += state_rows(evaluations[tracker], tracker)
    for tracker in TRACKERS:
        if f"evetac-{tracker}" in evaluations:
            rows += paper_rows(evaluations[f"evetac-{tracker}"], tracker)
    return rows


COLUMNS = (
    Column("what is known of the gel", "{known}"),
    Column("dots tracked by", "{tracker}"),
    Column("sensors", "{sensors}"),
    Column("shear, mean error [N]", "{mae_n:.2f}"),
    Column("worst sensor [N]", "{worst_sensor_mae_n:.2f}"),
    Column("normal, mean error [N] (of range)", "{normal_mae_n:.1f} ({normal_mae_of_range:.1%})"),
    Column("within one sd: shear, normal", "{shear_within_sd:.0%}, {normal_within_sd:.0%}"),
)
ABOUT = "Range: the largest normal force. `known` moduli are the true ones times a lognormal error, creep is not known."
SENSORS = Table(
    "force-sensors",
    "Shear and normal force on sensors that no model saw, a flat face",
    (*TRACKERS, *(f"evetac-{tracker}" for tracker in TRACKERS)),
    sensor_rows,
    COLUMNS,
    notes=(ABOUT,),
)
OBJECTS = Table(
    "force-objects",
    "The same where one of the paper's objects slips out of the grip, a cut gel, adapted on flat faces",
    ("slip",),
    lambda evaluations: state_rows(evaluations["slip"], "stable"),
    COLUMNS,
    notes=(ABOUT,),
)


def run(words: list[str], data: Path) -> str:
    """What a command prints; Refusal where it fails."""
    print(
        "+",
        *(shlex.quote(word) for word in words if "*" in word or not word.endswith(".tracks.h5")),
        file=sys.stderr,
        flush=True,
    )
    code, printed = run_command(words, data)
    if code:
        raise Refusal(f"{' '.join(words[:3])} ended with exit code {code}")
    return printed


def train_on_evetac(data: Path) -> None:
    """The paper's models of the sensor `evetac`, one for each tracker."""
    text = (data / "scenes" / "shear-0.toml").read_text()
    scene = data / "scenes" / "evetac.toml"
    scene.write_text("\n".join(f"count = {WAYPOINTS}" if x.startswith("count =") else x for x in text.split("\n")))
    run(["evetac", "record", "--scene", str(scene), "--count", str(TRIALS), "--seed", "1", "--out", "evetac"], data)
    recordings = sorted(str(path.relative_to(data)) for path in (data / "evetac").glob("*.recording.h5"))
    for tracker in TRACKERS:
        folder = "evetac" if tracker == "stable" else "evetac/paper"
        run(["evetac", "track", *recordings, "--preset", tracker, "--out", folder], data)
        tracks = sorted(str(path.relative_to(data)) for path in (data / folder).glob("*.tracks.h5"))
        model = f"evetac/{tracker}.force-model.h5"
        run(["evetac", "train-force", *tracks, "--samples", str(SAMPLES), "--out", model], data)


def evaluations_of(first: int, identified: Path | None) -> dict[str, tuple[str, list[str]]]:
    """The files of each evaluation, as a glob, and its flags."""
    sensor_files = ["--identified", str(identified.resolve())] if identified is not None else []

    def any_sensor(folder: str) -> list[str]:
        own = ["--adapt-on", f"{folder}*-adapt-*.tracks.h5"]
        return ["--model", str(FORCE_MODEL), "--seed", str(first), *own, *sensor_files]

    asked = {
        "stable": ("*-shear-0.tracks.h5", any_sensor("")),
        "paper": ("paper/*-shear-0.tracks.h5", any_sensor("paper/")),
        "slip": ("*-slip.tracks.h5", any_sensor("")),
    }
    for tracker in TRACKERS:
        of_evetac = ["--model", f"evetac/{tracker}.force-model.h5", "--samples", str(JUDGED_SAMPLES)]
        asked[f"evetac-{tracker}"] = (asked[tracker][0], [*of_evetac, "--seed", str(first)])
    return asked


def shown(words: list[str]) -> str:
    """A command as it is kept beside a table: files of this machine by their names alone."""
    return shlex.join(Path(word).name if word.startswith("/") else word for word in words)


def main() -> None:
    """Evaluate, and keep the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of force_randomized.py")
    parser.add_argument("--first", type=int, default=20000, help="seed of readings and of moduli: the first sensor's")
    parser.add_argument("--identified", type=Path, help="folder of blind_identification.py")
    parser.add_argument("--only", nargs="+", choices=(*SENSORS.evaluations, "slip"), help="these evaluations alone")
    parser.add_argument("--force", action="store_true", help="evaluate again, over reports of other files")
    parser.add_argument("--results", type=Path, default=ROOT / "docs" / "results")
    parser.add_argument("--replace", action="store_true", help="also tables of larger runs")
    chosen = parser.parse_args()
    data = chosen.data.resolve()
    evaluations: Evaluations = {}
    commands: dict[str, str] = {}
    if not chosen.only or any(name.startswith("evetac") for name in chosen.only):
        train_on_evetac(data)
    for name, (pattern, flags) in evaluations_of(chosen.first, chosen.identified).items():
        if chosen.only and name not in chosen.only:
            continue
        files = sorted(str(path.relative_to(data)) for path in data.glob(pattern))
        report = f"reports/{name}.report.h5"
        again = ["--force"] if chosen.force else []
        command = ["evetac", "evaluate", "force", *files, *flags, "--out", report]
        answer = json.loads(run([*command, "--json", *again], data))
        header = report_header(data / report)
        evaluations[name] = Evaluation(answer["rows"], answer["summary"], answer["simulated"], header)
        commands[name] = f"evetac evaluate force {pattern} {shown(flags)}"
    for table in (SENSORS, OBJECTS):
        used = {name: evaluations[name] for name in table.evaluations if name in evaluations}
        if used:
            made = result(table, used, [commands[name] for name in used])
            made["summaries"] = {name: evaluation.summary for name, evaluation in used.items()}
            keep(made, chosen.results, replace=chosen.replace)


if __name__ == "__main__":
    try:
        main()
    except Refusal as error:
        sys.exit(str(error))
