"""Forces from touch maps on sensors that no model saw, with different knowledge of the gel."""

from collections.abc import Iterator

from evetac_cli.jobs import Rows
from scripts.reproduce.experiment import Experiment, Study
from scripts.reproduce.steps import Command, Sizes, evetac, script
from scripts.reproduce.tables import Column, Evaluation, Evaluations, Table

TRACKERS = {"stable": "", "paper": "paper/"}  # folder of its tracks
STATES = {  # as `evaluate force` names them
    "unknown": "nothing",
    "known": "scale, modulus within {stiffness_error:.0%}",
    "identified": "what `identify` tells, and the scale",
    "adapted": "nothing before, then adapted",
    "known, adapted": "scale, modulus within {stiffness_error:.0%}, then adapted",
    "identified, adapted": "what `identify` tells, and the scale, then adapted",
}
PAPER_MODELS = {"regression": "linear regression", "network": "network"}
FIGURES = ("mae_n", "worst_sensor_mae_n", "normal_mae_n", "normal_mae_of_range", "shear_within_sd", "normal_within_sd")


def force_sensor_steps(sizes: Sizes) -> Iterator[Command]:
    """Press on every sensor and track in two ways; train the paper's models on the sensor `evetac`."""
    trials = ("shear-0", "slip", *(f"adapt-{number}" for number in range(sizes["adapt"])))
    yield script("studies/sensors/recordings.py", ".", "--first", sizes["first"], "--sensors", sizes["sensors"],
                 "--trials", *trials)  # fmt: skip
    yield evetac("record", "--scene", "scenes/evetac.toml", "--count", 4, "--seed", 1, "--out", "evetac")
    for tracker, folder in TRACKERS.items():
        yield evetac("track", "*.recording.h5", "--preset", tracker, "--out", folder or ".")
        yield evetac("track", "evetac/*.recording.h5", "--preset", tracker, "--out", f"evetac/{folder}")
        yield evetac("train-force", f"evetac/{folder}*.tracks.h5", "--samples", 100,
                     "--out", f"evetac/{tracker}.force-model.h5")  # fmt: skip


def force_sensor_evaluations(sizes: Sizes) -> dict[str, Command]:
    """Evaluate the paper's models, and touch maps with different knowledge of the gel, on faces and objects.

    The seed is that of the force readings and of the errors of moduli.
    """
    seed = ("--seed", sizes["first"])

    def of_any_sensor(folder: str, trial: str) -> Command:
        own = (f"--adapt-on={folder}*-adapt-*.tracks.h5", "--identified", "../blind-identification")
        return evetac("evaluate", "force", f"{folder}*-{trial}.tracks.h5", *seed, *own)

    evaluations = {tracker: of_any_sensor(folder, "shear-0") for tracker, folder in TRACKERS.items()}
    evaluations["slip"] = of_any_sensor("", "slip")
    for tracker, folder in TRACKERS.items():
        model = ("--model", f"evetac/{tracker}.force-model.h5", "--samples", 90)
        evaluations[f"evetac-{tracker}"] = evetac("evaluate", "force", f"{folder}*-shear-0.tracks.h5", *model, *seed)
    return evaluations


def state_rows(evaluation: Evaluation, tracker: str) -> Rows:
    """Return a row for each kind of knowledge of the gel."""
    rows, summary = [], evaluation.summary
    for state, words in STATES.items():
        name = state.replace(", ", "_and_")
        if f"{name}_mae_n" in summary:
            figures = {key: summary[f"{name}_{key}"] for key in FIGURES}
            sensors = summary.get(f"{name}_sensors", summary["sensors"])
            rows.append({"known": words.format_map(summary), "tracker": tracker, "sensors": sensors, **figures})
    return rows


def paper_rows(evaluation: Evaluation, tracker: str) -> Rows:
    """Return a row for each of the paper's models, trained on one sensor."""
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


def sensor_rows(evaluations: Evaluations) -> Rows:
    """Return the rows of both trackers, then of the paper's method."""
    any_sensor = [(tracker, evaluations[tracker]) for tracker in TRACKERS if tracker in evaluations]
    one_sensor = [(name, evaluations[f"evetac-{name}"]) for name in TRACKERS if f"evetac-{name}" in evaluations]
    return [
        *(row for tracker, evaluation in any_sensor for row in state_rows(evaluation, tracker)),
        *(row for tracker, evaluation in one_sensor for row in paper_rows(evaluation, tracker)),
    ]


FORCE_COLUMNS = (
    Column("what is known of the gel", "{known}"),
    Column("dots tracked by", "{tracker}"),
    Column("sensors", "{sensors}"),
    Column("shear, mean error [N]", "{mae_n:.2f}"),
    Column("worst sensor [N]", "{worst_sensor_mae_n:.2f}"),
    Column("normal, mean error [N] (of range)", "{normal_mae_n:.1f} ({normal_mae_of_range:.1%})"),
    Column("within one sd: shear, normal", "{shear_within_sd:.0%}, {normal_within_sd:.0%}"),
)
FORCE_NOTE = (
    "Range: the largest normal force. A `known` modulus is the true one times a lognormal error; creep is unknown."
)
FORCE_SENSORS = Table(
    "force-sensors",
    "Shear and normal force on unseen sensors, a flat face",
    (*TRACKERS, *(f"evetac-{tracker}" for tracker in TRACKERS)),
    sensor_rows,
    FORCE_COLUMNS,
    notes=(FORCE_NOTE,),
    measured=True,
    kept=False,
)
FORCE_OBJECTS = Table(
    "force-objects",
    "Shear and normal force while one of the paper's objects slips out of the grip, a cut gel, adapted on flat faces",
    ("slip",),
    lambda evaluations: state_rows(evaluations["slip"], "stable"),
    FORCE_COLUMNS,
    notes=(FORCE_NOTE,),
    measured=True,
    kept=False,
)

NOT_FROZEN = "not frozen: no result of the current method"
STUDY = Study(
    experiments=(
        Experiment(
            "force-sensors", "shear and normal force from touch maps of different sensors", "data/force-sensors", 3.0,
            full={"first": 20_020, "sensors": 20, "adapt": 12}, small={"sensors": 1, "adapt": 1},
            steps=force_sensor_steps, evaluations=force_sensor_evaluations,
            tables=(FORCE_SENSORS, FORCE_OBJECTS), after=("blind-identification",),
        ),
    ),
    checks={"force-sensors": NOT_FROZEN, "force-objects": NOT_FROZEN},
)  # fmt: skip
