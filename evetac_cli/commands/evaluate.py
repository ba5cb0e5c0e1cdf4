"""evaluate: the flags and examples of each subject, and the module that measures it."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter


@dataclass(frozen=True)
class EvaluateSlip:
    """Measure slip timing and F1 of models on trajectories they never saw."""

    model: Path | None = parameter(
        None,
        "Model file, a folder of them, a glob, or `shipped` for the package's; models may also be among the files.",
        recipe=False,
    )
    threshold: float | None = parameter(None, "Use this threshold instead of each model's own.", low=0.0, high=1.0)
    false_alarms_per_min: float | None = parameter(
        None,
        "Use the lowest threshold of each model with at most so many false alarms per minute, as they were counted in"
        " its training.",
        unit="1/min",
        low=0.0,
        high=300.0,
        recipe=False,  # the thresholds are
    )
    recordings: Path | None = parameter(
        None,
        "Folder of the recordings, if they do not lie beside the features: the truth of simulated ones tells the"
        " covariates of the slips.",
        recipe=False,
    )
    all_tables: bool = parameter(
        False,
        "Print all tables: timing of settings, by object, by model, by trajectory; --json always has them.",
        recipe=False,
        flag="--all",
    )


@dataclass(frozen=True)
class EvaluateDataRate:
    """Compare bytes per second with an RGB sensor's: whole, in contact, about slip; 540 columns, the window apart."""

    event_bytes: int = parameter(5, "Size of an event: x, y and polarity.", unit="bytes", low=1, high=64)
    rgb_frame: str = parameter("540x480x3", "Frame of the RGB sensor: width, height, bytes a pixel.")
    rgb_hz: float = parameter(25.0, "Frames a second of the RGB sensor.", unit="Hz", low=0.001, high=1e6)
    around_s: float = parameter(0.5, "How long about the onset is about slip, half of it before.", unit="s", low=0.002)


@dataclass(frozen=True)
class EvaluateVibration:
    """Estimate the frequency at which the gel vibrates, and how often windows of several lengths get it right."""

    preset: str = parameter(
        "default",
        "default: how far the gel moves at each frequency, and the paper's method beside it; paper: only the strongest"
        " line in the number of events a slice.",
        choices=("default", "paper"),
    )
    windows: str = parameter("10,2,1", "Lengths of windows, 0.1 to 10.", unit="s")
    true_hz: float | None = parameter(
        None, "The tone that was played; default: the truth of a simulation.", unit="Hz", low=0.1, high=1e6
    )
    tolerance_hz: float = parameter(
        1.0,
        "A frequency so near to the tone is right; at least 0.5 over the window's length, 2 Hz in 0.25 s.",
        unit="Hz",
        low=0.0,
        high=1e3,
    )
    lowest_hz: float = parameter(25.0, "Lower frequencies are left out.", unit="Hz", low=1.0, high=1e4)
    rate: int = parameter(
        1000, "Frequencies up to half of this; events are counted so often a second.", unit="Hz", low=100, high=20000
    )
    false_alarms: float = parameter(
        0.01, "Probability that noise alone is taken for a vibration; default preset.", low=1e-9, high=0.5
    )


@dataclass(frozen=True)
class EvaluateRealism:
    """Compare a simulated recording with a real one: rates, intervals, dot edges, if they can be told apart."""

    same: Path | None = parameter(
        None, "Another recording of the real sensor, with the same motion: how well two of one can be told apart.",
        recipe=False,
    )  # fmt: skip


@dataclass(frozen=True)
class EvaluateLikeness:
    """Measure what recordings, simulated or real, say of the public facts about the sensor, and what they cannot."""

    results: Path | None = parameter(
        None, "Folder of tables that tell what needs trainings or grasps; default: docs/results of the clone.",
        recipe=False,
    )  # fmt: skip


@dataclass(frozen=True)
class EvaluateLabels:
    """Compare the onset of labels with the true onset of gross slip (simulated recordings)."""


@dataclass(frozen=True)
class EvaluateTracking:
    """Measure whether dots end where they began, and how far from the truth they were (simulated recordings)."""

    recordings: Path | None = parameter(
        None, "Folder of the recordings, if they do not lie beside the tracks.", recipe=False
    )


@dataclass(frozen=True)
class EvaluateGrasp:
    """Report the outcome of grasps: lifted, balanced, moved (simulated recordings)."""


@dataclass(frozen=True)
class EvaluateCost:
    """Measure error against run time of a part's numerical choices: table, report, plot."""

    part: str = parameter(
        "sim",
        "What is measured; sim: the simulator; pipeline: settings of a recording, at the end of the whole chain; label:"
        " slip labels; track: the dot tracker; model: slip detectors; grasp: grasps with a late detector, a slow"
        " controller, other detectors; scenes: what the parts of three scenes cost a slice, each scene with and without"
        " them.",
        choices=("sim", "pipeline", "label", "track", "model", "grasp", "scenes"),
        flag="PART",
    )
    model: Path | None = parameter(
        None,
        "Part model: model file, a folder of them, a glob, or `shipped`, the package's, beside the report of `evaluate"
        " slip` on them; without: untrained ones. Part grasp: detectors to try beside the package's.",
        recipe=False,
    )
    trials: int | None = parameter(
        None,
        "Trials of each setting, where they are simulated; default: as many as fit into three minutes.",
        low=1,
        high=10000,
    )
    seed: int = parameter(
        10000,
        "Seed of the first trial; constants were chosen on seeds below 10,000, with exceptions that docs/results.md"
        " names.",
        low=0,
        high=2**31 - 1 - 10000,
    )
    full: bool = parameter(False, "More settings, finer references, more trials; takes many minutes.")


@dataclass(frozen=True)
class EvaluateStability:
    """Run the stiff, extreme and nonsensical cases of a part: within stated bounds, or refused in words."""

    part: str = parameter(
        "sim",
        "What is tried; sim: the simulator; track: the dot tracker; grasp: the loop of detector, controller, gripper.",
        choices=("sim", "track", "grasp"),
        flag="PART",
    )
    seed: int = parameter(0, "Seed of the cases that are drawn.", low=0, high=2**31 - 1)
    full: bool = parameter(False, "More settings, longer runs and many more random cases; takes a few minutes.")
    strict: bool = parameter(
        False, "Exit with 1 where a case is not ok; without, what is not ok is printed and counted.", recipe=False
    )


@dataclass(frozen=True)
class EvaluateForce:
    """Compare forces that touch maps, or the paper's models, tell with the true ones (simulated recordings)."""

    model: str = parameter(
        "",
        "Force model of the paper's method, folder or glob of several: each judges the tracks of its own sensor;"
        " default: none, touch maps are judged.",
        recipe=False,
    )
    adapt_on: str = parameter(
        "",
        "Tracks (a folder or a glob) of the same sensors, on which touch maps are adapted first: more rows of each"
        " sensor.",
        recipe=False,
    )
    identified: str = parameter(
        "",
        "Folder with files of the same sensors by `evetac identify`, 7.sensor.toml for randomized:7: one row more of"
        " each sensor that has one.",
        recipe=False,
    )
    stiffness_error: float = parameter(
        0.1, "Of touch maps: relative error of the modulus that is taken as known, sd.", low=0.0, high=2.0
    )
    samples: int = parameter(
        200, "Of the paper's models: samples of each trajectory, evenly spread over the contact.", low=3, high=100000
    )
    noise_n: float = parameter(
        0.05, "Noise of the force sensor that is compared with, or adapted to, sd.", unit="N", low=0.0, high=100.0
    )
    seed: int = parameter(0, "Seed of the noise, and of the error of the modulus.", low=0, high=2**31 - 1)


COMMANDS = (
    Command(
        "slip",
        EvaluateSlip,
        "evaluate.slip",
        "Labelled features that the model never saw.",
        kind="features",
        unit="files",
        examples=(
            "evetac evaluate slip unseen --model hist10.model.h5",
            "evetac evaluate slip unseen --model shipped --all",
        ),
    ),
    Command(
        "vibration",
        EvaluateVibration,
        "evaluate.vibration",
        "Recordings.",
        unit="ms",
        examples=("evetac evaluate vibration tones", "evetac evaluate vibration own.recording.h5 --true-hz 300"),
    ),
    Command(
        "data-rate",
        EvaluateDataRate,
        "evaluate.data_rate",
        "Recordings.",
        unit="files",
        examples=("evetac evaluate data-rate data",),
    ),
    Command(
        "labels",
        EvaluateLabels,
        "evaluate.labels",
        "Labels of simulated recordings.",
        kind="labels",
        unit="files",
        examples=("evetac evaluate labels data",),
    ),
    Command(
        "tracking",
        EvaluateTracking,
        "evaluate.tracking",
        "Tracks by one preset or more.",
        kind="tracks",
        unit="files",
        examples=("evetac evaluate tracking data", "evetac evaluate tracking stable paper --recordings data"),
    ),
    Command(
        "grasp",
        EvaluateGrasp,
        "evaluate.grasp",
        "Recordings made by grasp.",
        unit="files",
        examples=("evetac evaluate grasp grasps",),
    ),
    Command(
        "force",
        EvaluateForce,
        "evaluate.force",
        "Tracks of simulated shear recordings.",
        kind="tracks",
        unit="files",
        examples=("evetac evaluate force unseen", "evetac evaluate force unseen --model shear.force-model.h5"),
    ),
    Command(
        "realism",
        EvaluateRealism,
        "evaluate.realism",
        "A real recording, then a simulated one.",
        unit="files",
        examples=("evetac evaluate realism real.recording.h5 simulated.recording.h5",),
    ),
    Command(
        "likeness",
        EvaluateLikeness,
        "evaluate.likeness.command",
        "Recordings: rests, presses, slips, what there is.",
        unit="files",
        examples=(
            "evetac evaluate likeness slip rest.recording.h5",
            "evetac evaluate likeness real.recording.h5 --json",
        ),
    ),
    Command(
        "cost",
        EvaluateCost,
        "evaluate.cost.command",
        "Part model: the report of `evaluate slip`, and models.",
        kind="report",
        unit="rows",
        files_needed=False,
        examples=("evetac evaluate cost sim", "evetac evaluate cost model unseen.slip.report.h5 --model models"),
    ),
    Command(
        "stability",
        EvaluateStability,
        "evaluate.stability.command",
        "",
        unit="rows",
        examples=("evetac evaluate stability sim", "evetac evaluate stability grasp --strict"),
    ),
)
