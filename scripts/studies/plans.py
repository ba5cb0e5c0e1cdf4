"""Define the studies that go beyond the paper's experiments: their commands, and the tables of their measurements.

Two are evaluated in modules of their own (parts/effects.py, sensors/blind.py). Two are evaluated by programs: the
touch sensor and the examples by robots/tables.py, forces by `evetac evaluate force`.
"""

from collections.abc import Iterator

from evetac_cli.jobs import Rows
from scripts.reproduce.steps import Command, Sizes, evetac, script
from scripts.reproduce.tables import Column, Evaluation, Evaluations, Table


def all_rows(evaluations: Evaluations) -> Rows:
    """Return the measured rows unchanged."""
    return [row for evaluation in evaluations.values() for row in evaluation.rows]


def measured(name: str, title: str, *columns: tuple[str, str], notes: tuple[str, ...] = ()) -> Table:
    """Return the table of a measurement of the same name; columns are heading and cell."""
    return Table(name, title, (name,), all_rows, tuple(Column(*one) for one in columns), notes=notes, measured=True)


# --- forces on sensors that no model saw ------------------------------------------------------------------------------

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

# --- what each part does to each stage --------------------------------------------------------------------------------

# A figure of parts/effects.py: heading and format of its cells.
PART_FIGURES = {
    "events_ms": ("events per ms", ".1f"),
    "tracking_px": ("tracking error [px]", ".3f"),
    "labels_in_time": ("labels in time", ".2f"),
    "labels_f1": ("F1 of labels", ".2f"),
    "slip_in_time": ("slip detected in time", ".2f"),
    "slip_f1": ("F1 of detector", ".2f"),
    "record_us": ("time to simulate [us per slice]", ".0f"),
    "rest_us": ("time to label, track, featurize and evaluate [us per slice]", ".0f"),
    "held": ("grasps held", ".2f"),
    "moved_mm": ("object moved in a grasp [mm]", ".2f"),
}
PART_EFFECTS = measured(
    "part-effects",
    "Effect of each part on each stage, {slips} slips and {grasps} grasps with each",
    ("part", "{part}"),
    ("size", "{size}"),
    *(
        (heading, f"{{{name}:{form}}}, {{{name}_low:+{form}}} to {{{name}_high:+{form}}}")
        for name, (heading, form) in PART_FIGURES.items()
    ),
    notes=(
        "A figure is followed by the 95 % interval of its change (bootstrap over pairs of trials) if the interval"
        " excludes 0. With fewer than some ten pairs the interval is too narrow, and one in 20 figures would have one"
        " by chance. Run times are processor times, measured while other work ran.",
    ),
)

# --- sensors identified blindly ---------------------------------------------------------------------------------------

BLIND_IDENTIFICATION = measured(
    "blind-identification",
    "Parameters of sensors randomized-narrow:{first} to {last} in blind identification",
    ("parameter", "{parameter}"),
    ("estimated", "{estimated} of {sensors}"),
    ("95 % interval contained the true value", "{held}"),
    ("width over the range of `randomized-narrow`, mean", "{width_mean:.2f}"),
    ("worst", "{width_worst:.2f}"),
    ("identifiable", "{found}"),
    notes=("Parameters that were estimated for no sensor cannot be identified.",),
)

# --- robot simulators -------------------------------------------------------------------------------------------------

TOUCH_COST = measured(
    "touch-cost",
    "Run time of a simulated millisecond of the touch sensor",
    ("contact", "{contact}"),
    ("CPU us per ms", "{CPU_us_a_ms:,.1f}"),
    ("with slip detector CPU us per ms", "{with_slip_detector_CPU_us_a_ms:,.1f}"),
)
MUJOCO_GRASPS = measured(
    "mujoco-grasps",
    "Grasps in MuJoCo",
    ("controller", "{controller}"),
    ("trials", "{trials}"),
    ("lifted", "{lifted}"),
    ("grip at the end N median", "{grip_at_the_end_N_median:.2f}"),
    ("steps of 1 ms a CPU second median", "{steps_of_1_ms_a_CPU_second_median:,.0f}"),
)
LIFT_BASELINE = measured(
    "lift-baseline",
    "Policies for evetac/Lift-v0, means over the evaluated episodes",
    ("policy", "{policy}"),
    ("return", "{return:.3g}"),
    ("lifted", "{lifted:.3g}"),
    ("kept", "{kept:.3g}"),
    ("mean grip N", "{mean_grip_N:.3g}"),
)


def mujoco_steps(sizes: Sizes) -> Iterator[Command]:
    yield ["python", "examples/mujoco_grasp.py", "--trials", str(sizes["trials"]), "--seed", str(sizes["seed"]),
           "--json", trials_file(sizes)]  # fmt: skip


def lift_steps(sizes: Sizes) -> Iterator[Command]:
    flags = (word for name, value in sizes.items() for word in (f"--{name.replace('_', '-')}", str(value)))
    yield ["python", "examples/cma_lift.py", *flags, "--json", trials_file(sizes)]


def trials_file(sizes: Sizes) -> str:
    """Return an example's output file, named by its sizes, because it has no recipe that distinguishes runs."""
    return "-".join(str(value) for value in sizes.values()) + ".json"
