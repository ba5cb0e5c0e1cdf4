"""evaluate: the flags and examples of each subject, and the module that evaluates it."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli import names
from evetac_cli.commands.parameter import Command, parameter


@dataclass(frozen=True)
class EvaluateSlip:
    """Measure the slip timing and F1 of models on trajectories not used in their training."""

    model: Path | None = parameter(
        None,
        "Model file, folder of models, glob, or `shipped` for the pretrained one; several with commas. Models may also"
        " be among the files.",
        recipe=False,
    )
    truth: bool = parameter(
        False,
        "Judge simulated trials by the true onset of slip instead of the labels'. No trial abstains then.",
    )
    by: str | None = parameter(
        None,
        "Print a row per sensor, object or model file. --json always includes these rows.",
        choices=("sensor", "object", "model"),
        recipe=False,
    )
    threshold: float | None = parameter(None, "Use this threshold instead of each model's own.", low=0.0, high=1.0)
    false_alarms_per_min: float | None = parameter(
        None,
        "Use each model's lowest threshold with at most this many false alarms per minute, as counted during its"
        " training.",
        unit="1/min",
        low=0.0,
        high=300.0,
        recipe=False,  # the thresholds are
    )
    recordings: Path | None = parameter(
        None,
        "Folder of the recordings. Default: the features' folder, the one above and its sub-folders, where they are"
        " recognized by their ids. Covariates of the slips, and --truth, need simulated recordings.",
        recipe=False,
    )
    all_tables: bool = parameter(
        False,
        "Print all tables: timing by setting, object, model and trajectory. --json always includes them.",
        recipe=False,
        flag="--all",
    )


@dataclass(frozen=True)
class EvaluateDataRate:
    """Compare the data rate of events with that of an RGB sensor: overall, in contact, and around slip onset.

    As in the paper, only events in the first 540 columns are counted; those of the window are reported separately.
    """

    event_bytes: int = parameter(5, "Size of an event: x, y and polarity.", unit="bytes", low=1, high=64)
    rgb_frame: str = parameter("540x480x3", "Frame of the RGB sensor: width, height and bytes per pixel.")
    rgb_hz: float = parameter(25.0, "Frame rate of the RGB sensor.", unit="Hz", low=0.001, high=1e6)
    around_s: float = parameter(
        0.5, "Length of the interval that counts as around slip, centred on the onset.", unit="s", low=0.002
    )


@dataclass(frozen=True)
class EvaluateVibration:
    """Estimate the frequency at which the gel vibrates, and how often windows of each length estimate it correctly."""

    preset: str = parameter(
        "default",
        "default: the amplitude of the gel's motion at each frequency, together with the paper's method. paper: only"
        " the strongest line in the spectrum of events per slice.",
        choices=("default", "paper"),
    )
    windows: str = parameter("10,2,1", "Lengths of the windows, from 0.1 to 10.", unit="s")
    true_hz: float | None = parameter(
        None, "Tone that was played; default: the ground truth of a simulation.", unit="Hz", low=0.1, high=1e6
    )
    tolerance_hz: float = parameter(
        1.0,
        "An estimate this close to the tone counts as correct; at least 0.5 divided by the window's length is allowed,"
        " e.g. 2 Hz for 0.25 s.",
        unit="Hz",
        low=0.0,
        high=1e3,
    )
    lowest_hz: float = parameter(25.0, "Lowest frequency that is considered.", unit="Hz", low=1.0, high=1e4)
    rate: int = parameter(
        1000,
        "Sampling rate of the event counts; frequencies up to half of it are considered.",
        unit="Hz",
        low=100,
        high=20000,
    )
    false_alarms: float = parameter(
        0.01, "Probability that noise alone is reported as a vibration; for preset default.", low=1e-9, high=0.5
    )


@dataclass(frozen=True)
class EvaluateRealism:
    """Compare a simulated recording with a real one: rates, intervals, dot edges, separability by a classifier."""

    same: Path | None = parameter(
        None, "Another recording of the real sensor with the same motion, as a reference: how well two real recordings"
        " can be distinguished.",
        recipe=False,
    )  # fmt: skip


@dataclass(frozen=True)
class EvaluateLikeness:
    """Compare recordings, simulated or real, with published facts about the sensor, and list facts without figures."""


@dataclass(frozen=True)
class EvaluateLabels:
    """Compare labelled onsets with the true onset of gross slip (simulated recordings)."""


@dataclass(frozen=True)
class EvaluateTracking:
    """Measure whether tracked dots return to where they started, and their error (simulated recordings)."""

    recordings: Path | None = parameter(
        None,
        "Folder of the recordings. Default: the tracks' folder, the one above and its sub-folders.",
        recipe=False,
    )


@dataclass(frozen=True)
class EvaluateGrasp:
    """Report the outcome of grasps: lifted, balanced, and how far the object moved (simulated recordings)."""


@dataclass(frozen=True)
class EvaluateCost:
    """Measure error and run time for the numerical settings of one part, as a table, a report and a plot."""

    part: str = parameter(
        "sim",
        "Part to measure. sim: the simulator. pipeline: simulation settings, by their effect at the end of the whole"
        " pipeline. label: slip labels. track: the dot tracker. model: slip detectors. grasp: grasps with a delayed"
        " detector, a slow controller or other detectors.",
        choices=("sim", "pipeline", "label", "track", "model", "grasp"),
        flag="PART",
    )
    model: Path | None = parameter(
        None,
        "Part model: model file, folder of models, glob, or `shipped` for the pretrained one, together with their"
        " report of `evaluate slip`; without it, untrained models are measured. Part grasp: detectors to try in"
        " addition to the pretrained one.",
        recipe=False,
    )
    trials: int | None = parameter(
        None,
        "Simulated trials per setting; default: as many as fit into three minutes.",
        low=1,
        high=10000,
    )
    seed: int = parameter(
        10000,
        "Seed of the first trial. Constants of evetac were chosen on seeds below 10,000;"
        " docs/evidence/results.md lists the exceptions.",
        low=0,
        high=2**31 - 1 - 10000,
    )
    full: bool = parameter(False, "Measure more settings with finer references and more trials; takes many minutes.")


@dataclass(frozen=True)
class EvaluateStability:
    """Run stiff and extreme cases of one part: each must stay in bounds or be refused with an error."""

    part: str = parameter(
        "sim",
        "Part to test. sim: the simulator. track: the dot tracker. grasp: the loop of detector, controller, gripper.",
        choices=("sim", "track", "grasp"),
        flag="PART",
    )
    seed: int = parameter(0, "Seed of the random cases.", low=0, high=2**31 - 1)
    full: bool = parameter(False, "Test more settings, longer runs and many more random cases; takes a few minutes.")
    strict: bool = parameter(
        False,
        "Exit with 1 if a case fails. Without this flag, failed cases are only printed and counted.",
        recipe=False,
    )


@dataclass(frozen=True)
class EvaluateForce:
    """Compare forces estimated by touch maps or by the paper's models with the true ones (simulated recordings)."""

    model: str = parameter(
        "",
        "Force model trained by the paper's method, or a folder or glob of several. Each is evaluated on the tracks of"
        " its own sensor. Default: none, touch maps are evaluated.",
        recipe=False,
    )
    adapt_on: str = parameter(
        "",
        "Tracks (folder or glob) of the same sensors, on which touch maps are adapted first; adds rows per sensor.",
        recipe=False,
    )
    identified: str = parameter(
        "",
        "Folder with files of the same sensors from `evetac identify`, e.g. 7.sensor.toml for randomized:7; adds a row"
        " for each sensor with such a file.",
        recipe=False,
    )
    stiffness_error: float = parameter(
        0.1, "For touch maps: relative error of the assumed modulus (standard deviation).", low=0.0, high=2.0
    )
    samples: int = parameter(
        200, "For the paper's models: samples per trajectory, evenly spread over the contact.", low=3, high=100000
    )
    noise_n: float = parameter(
        0.05,
        "Noise of the force sensor that serves as reference or for adaptation (standard deviation).",
        unit="N",
        low=0.0,
        high=100.0,
    )
    seed: int = parameter(0, "Seed of the noise and of the modulus error.", low=0, high=2**31 - 1)


@dataclass(frozen=True)
class EvaluateBenchmark:
    """Score methods on a benchmark's folder: onset of slip, warnings, shear force, dots, and grip in closed loop.

    Without --predictions, evetac's methods process the recordings; their predictions are also written as tables next to
    the report. The five scores are defined in docs/benchmark.md.
    """

    predictions: Path | None = parameter(
        None,
        "Score the tables in this folder (onset, warning, force, dots; CSV), or a single table, instead of evetac's"
        " methods.",
        recipe=False,
    )
    model: Path | None = parameter(
        None,
        "Slip detector: a model file, `shipped` for the pretrained one (default), or `none` to leave out onset and"
        " warning.",
        recipe=False,
    )
    threshold: float | None = parameter(
        None, "Use this threshold for the onset, and in closed loop, instead of the model's own.", low=0.0, high=1.0
    )
    tracker: str = parameter(
        "stable",
        f"Preset of the dot tracker; {names.words(names.TRACKERS)}.",
        choices=tuple(names.TRACKERS),
    )
    shear_force: str = parameter(
        "touch",
        "Method of shear force. touch: touch maps. regression, network: the paper's, with --force-model. none: leave"
        " the task out.",
        choices=("touch", "regression", "network", "none"),
    )
    force_model: Path | None = parameter(
        None, "Force model trained by the paper's method (`train-force`).", recipe=False
    )
    controller: str = parameter(
        "", f"Play the lifts with this controller, for the grip score: {', '.join(names.CONTROLLERS)}, or a plug-in's."
    )


COMMANDS = (
    Command(
        "slip",
        EvaluateSlip,
        "evaluate.slip.measure",
        "Labelled features not used in training.",
        kind="features",
        unit="files",
        examples=(
            "evetac evaluate slip unseen --model hist10.model.h5",
            "evetac evaluate slip unseen --model hist10.model.h5,shipped",
            "evetac evaluate slip soft stiff --model shipped --by sensor --truth",
        ),
    ),
    Command(
        "vibration",
        EvaluateVibration,
        "evaluate.vibration.measure",
        "Recordings.",
        unit="ms",
        examples=("evetac evaluate vibration tones", "evetac evaluate vibration own.recording.h5 --true-hz 300"),
    ),
    Command(
        "data-rate",
        EvaluateDataRate,
        "evaluate.data_rate.measure",
        "Recordings.",
        unit="files",
        examples=("evetac evaluate data-rate data",),
    ),
    Command(
        "labels",
        EvaluateLabels,
        "evaluate.labels.measure",
        "Labels of simulated recordings.",
        kind="labels",
        unit="files",
        examples=("evetac evaluate labels data",),
    ),
    Command(
        "tracking",
        EvaluateTracking,
        "evaluate.tracking.measure",
        "Tracks made with one or more presets.",
        kind="tracks",
        unit="files",
        examples=("evetac evaluate tracking data", "evetac evaluate tracking stable paper --recordings data"),
    ),
    Command(
        "grasp",
        EvaluateGrasp,
        "evaluate.grasp.measure",
        "Recordings made by grasp.",
        unit="files",
        examples=("evetac evaluate grasp grasps",),
    ),
    Command(
        "force",
        EvaluateForce,
        "evaluate.force.measure",
        "Tracks of simulated shear recordings.",
        kind="tracks",
        unit="files",
        examples=("evetac evaluate force unseen", "evetac evaluate force unseen --model shear.force-model.h5"),
    ),
    Command(
        "realism",
        EvaluateRealism,
        "evaluate.realism.measure",
        "A real recording, then a simulated one.",
        unit="files",
        examples=("evetac evaluate realism real.recording.h5 simulated.recording.h5",),
    ),
    Command(
        "likeness",
        EvaluateLikeness,
        "evaluate.likeness.command",
        "Recordings at rest, of presses or of slips, as available.",
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
        "For part model: the report of `evaluate slip`, and models.",
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
    Command(
        "benchmark",
        EvaluateBenchmark,
        "evaluate.benchmark.command",
        "The folder of a benchmark.",
        kind="",
        unit="files",
        examples=(
            "evetac evaluate benchmark bench-small",
            "evetac evaluate benchmark bench-small --predictions mine",
            "evetac evaluate benchmark bench-small --tracker paper --controller load-proportional",
        ),
    ),
)
