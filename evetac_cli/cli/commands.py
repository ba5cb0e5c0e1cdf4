"""The table of commands that make files: of each its parameters, module, input files, progress, and examples.

Modules are names, which are imported when the command is chosen.
"""

from dataclasses import dataclass

from evetac_cli.params import evaluation, grasp, inspection, learning, recording


@dataclass(frozen=True)
class Command:
    """A command that makes files: its parameters, its module, its input files, and what its progress counts."""

    name: str
    params: type
    module: str
    files: str  # what the file arguments are; empty if the command takes none
    kind: str = "recording"  # of the files that are taken from a folder; empty: the command sees to folders itself
    suffix: str = ".h5"  # of a file that -o names
    unit: str = "slices"
    files_needed: bool = True
    examples: tuple[str, ...] = ()  # of command lines, as --help shows them


PIPELINE = (
    Command(
        "record",
        recording.Record,
        "stages.record",
        "",
        examples=(
            "evetac record --scene slip --object 1-3 --count 2 -o data",
            "evetac record --from events.aedat4",
            "evetac record --camera dvxplorer --gripper /dev/ttyUSB0 --arm --object 8",
        ),
    ),
    Command(
        "trim",
        recording.Trim,
        "stages.trim",
        "Recordings.",
        examples=("evetac trim long.recording.h5 --from-ms 500 --to-ms 1500 -o piece.recording.h5",),
    ),
    Command(
        "attach",
        recording.Attach,
        "stages.attach",
        "Recordings.",
        examples=(
            "evetac attach a.recording.h5 --stream arm=pose.csv --stream force=ft.parquet --offset arm=0.012",
            "evetac attach a.recording.h5 --stream wrist=trial.mcap:/wrist/image_raw -o b.recording.h5",
        ),
    ),
    Command(
        "calibrate",
        recording.Calibrate,
        "stages.calibrate",
        "Press recordings; none with --import.",
        suffix=".json",
        files_needed=False,
        examples=(
            "evetac calibrate press.recording.h5 --gel cut -o gel.json",
            "evetac calibrate press.recording.h5 --rows 6 --columns 10 -o gel.json",
            "evetac calibrate --import official.pkl",
        ),
    ),
    Command(
        "identify",
        recording.Identify,
        "stages.identify",
        "Recordings of one sensor.",
        suffix=".toml",
        unit="files",
        examples=("evetac identify rest.recording.h5 press.recording.h5 grip.recording.h5 -o own.sensor.toml",),
    ),
    Command(
        "label",
        learning.Label,
        "stages.label",
        "Recordings.",
        examples=("evetac label data --jobs 2", "evetac label a.recording.h5 --method farneback -o other"),
    ),
    Command(
        "track",
        learning.Track,
        "stages.track",
        "Recordings.",
        examples=("evetac track data --jobs 2", "evetac track a.recording.h5 --preset paper -o paper"),
    ),
    Command(
        "featurize",
        learning.Featurize,
        "stages.featurize",
        "Recordings (tracks and labels lie beside them).",
        examples=("evetac featurize data --jobs 2", "evetac featurize data --tracks paper -o paper"),
    ),
    Command(
        "train",
        learning.Train,
        "stages.train",
        "Labelled features, one file a trajectory.",
        kind="features",
        unit="steps",
        examples=(
            "evetac train data --validate validation -o models",
            "evetac train own --adapt shipped --validate own-validation -o own.model.h5",
        ),
    ),
    Command(
        "track-rgb",
        learning.TrackRgb,
        "stages.track_rgb",
        "Simulated recordings.",
        unit="frames",
        examples=("evetac track-rgb data -o rgb",),
    ),
    Command(
        "train-force",
        learning.TrainForce,
        "stages.force.train_force",
        "Tracks of shear recordings; the last file is held out.",
        kind="tracks",
        unit="steps",
        examples=(
            "evetac train-force shear/*.tracks.h5 -o shear.force-model.h5",
            "evetac train-force own --adapt shipped -o own.force-model.h5",
        ),
    ),
    Command(
        "predict-force",
        learning.PredictForce,
        "stages.force.predict_force",
        "Tracks.",
        kind="tracks",
        examples=("evetac predict-force data", "evetac predict-force data --sensor own.sensor.toml"),
    ),
    Command(
        "grasp",
        grasp.Grasp,
        "stages.grasp",
        "",
        examples=(
            "evetac grasp --object 11-13 --count 2 -o grasps",
            "evetac grasp --object 11 --controller load-proportional -o grasps",
            "evetac grasp --camera dvxplorer --gripper /dev/ttyUSB0 --arm",
        ),
    ),
)
EVALUATE = (
    Command(
        "slip",
        evaluation.EvaluateSlip,
        "stages.evaluate.slip",
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
        evaluation.EvaluateVibration,
        "stages.evaluate.vibration",
        "Recordings.",
        unit="ms",
        examples=("evetac evaluate vibration tones", "evetac evaluate vibration own.recording.h5 --true-hz 300"),
    ),
    Command(
        "data-rate",
        evaluation.EvaluateDataRate,
        "stages.evaluate.data_rate",
        "Recordings.",
        unit="files",
        examples=("evetac evaluate data-rate data",),
    ),
    Command(
        "labels",
        evaluation.EvaluateLabels,
        "stages.evaluate.labels",
        "Labels of simulated recordings.",
        kind="labels",
        unit="files",
        examples=("evetac evaluate labels data",),
    ),
    Command(
        "tracking",
        evaluation.EvaluateTracking,
        "stages.evaluate.tracking",
        "Tracks by one preset or more.",
        kind="tracks",
        unit="files",
        examples=("evetac evaluate tracking data", "evetac evaluate tracking stable paper --recordings data"),
    ),
    Command(
        "grasp",
        evaluation.EvaluateGrasp,
        "stages.evaluate.grasp",
        "Recordings made by grasp.",
        unit="files",
        examples=("evetac evaluate grasp grasps",),
    ),
    Command(
        "force",
        evaluation.EvaluateForce,
        "stages.evaluate.force",
        "Tracks of simulated shear recordings.",
        kind="tracks",
        unit="files",
        examples=("evetac evaluate force unseen --model shear.force-model.h5",),
    ),
    Command(
        "realism",
        evaluation.EvaluateRealism,
        "stages.evaluate.realism",
        "A real recording, then a simulated one.",
        unit="files",
        examples=("evetac evaluate realism real.recording.h5 simulated.recording.h5",),
    ),
    Command(
        "cost",
        evaluation.EvaluateCost,
        "numerics.cost",
        "Part model: the report of `evaluate slip`, and models.",
        kind="report",
        unit="rows",
        files_needed=False,
        examples=("evetac evaluate cost sim", "evetac evaluate cost model unseen.slip.report.h5 --model models"),
    ),
    Command(
        "stability",
        evaluation.EvaluateStability,
        "numerics.stability",
        "",
        unit="rows",
        examples=("evetac evaluate stability sim", "evetac evaluate stability grasp --strict"),
    ),
)
# Of inspect/: for people, made again whenever asked for.
VIEW = Command(
    "view",
    inspection.View,
    "inspect.view",
    "Stage files of one trial; others of its name are found. Also a model, or `shipped` for the package's.",
    kind="",
    unit="images",
    examples=("evetac view a.recording.h5", "evetac view a.recording.h5 --start-s 1 --stop-s 1.2 --film a.gif"),
)
EXPORT = Command(
    "export",
    inspection.Export,
    "inspect.export",
    "Recordings.",
    unit="events",
    examples=(
        "evetac export a.recording.h5 --format aedat4",
        "evetac export data --format parquet -o tables",
        "evetac export grasps --format lerobot --fps 50 -o touch",
    ),
)
DOCTOR = Command(
    "doctor",
    inspection.Doctor,
    "inspect.doctor",
    "",
    examples=("evetac doctor", "evetac doctor --speed", "evetac doctor --hardware --camera virtual --gripper virtual"),
)
SHARE = Command(
    "share",
    inspection.Share,
    "inspect.share",
    "A model and reports on it; or a folder.",
    kind="",
    unit="files",
    examples=(
        "evetac share own.model.h5 unseen.slip.report.h5 --license mit -o own-hub",
        'evetac share data --title "Slips of 20 objects" -o data-hub',
    ),
)
REPORT = Command(
    "report",
    inspection.Report,
    "inspect.report",
    "A folder of stage files; two with --compare.",
    kind="",
    unit="files",
    examples=("evetac report data", "evetac report before after --compare -o compared.html"),
)
