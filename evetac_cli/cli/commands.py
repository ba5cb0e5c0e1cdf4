"""The table of commands that make files: of each its parameters, its module, its input files, its progress.

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
    unit: str = "slices"
    files_needed: bool = True


PIPELINE = (
    Command("record", recording.Record, "stages.record", ""),
    Command("trim", recording.Trim, "stages.trim", "Recordings."),
    Command(
        "calibrate",
        recording.Calibrate,
        "stages.calibrate",
        "Press recordings; none with --import.",
        files_needed=False,
    ),
    Command("identify", recording.Identify, "stages.identify", "Recordings of one sensor.", "files"),
    Command("label", learning.Label, "stages.label", "Recordings."),
    Command("track", learning.Track, "stages.track", "Recordings."),
    Command("featurize", learning.Featurize, "stages.featurize", "Recordings (tracks and labels lie beside them)."),
    Command("train", learning.Train, "stages.train", "Labelled features, one file a trajectory.", "steps"),
    Command("track-rgb", learning.TrackRgb, "stages.track_rgb", "Simulated recordings.", "frames"),
    Command(
        "train-force",
        learning.TrainForce,
        "stages.force.train_force",
        "Tracks of shear recordings; the last file is held out.",
        "steps",
    ),
    Command("predict-force", learning.PredictForce, "stages.force.predict_force", "Tracks."),
    Command("grasp", grasp.Grasp, "stages.grasp", ""),
)
EVALUATE = (
    Command(
        "slip", evaluation.EvaluateSlip, "stages.evaluate.slip", "Labelled features that the model never saw.", "files"
    ),
    Command("vibration", evaluation.EvaluateVibration, "stages.evaluate.vibration", "Recordings.", "ms"),
    Command("data-rate", evaluation.EvaluateDataRate, "stages.evaluate.data_rate", "Recordings.", "files"),
    Command("labels", evaluation.EvaluateLabels, "stages.evaluate.labels", "Labels of simulated recordings.", "files"),
    Command(
        "tracking", evaluation.EvaluateTracking, "stages.evaluate.tracking", "Tracks by one preset or more.", "files"
    ),
    Command("grasp", evaluation.EvaluateGrasp, "stages.evaluate.grasp", "Recordings made by grasp.", "files"),
    Command(
        "force", evaluation.EvaluateForce, "stages.evaluate.force", "Tracks of simulated shear recordings.", "files"
    ),
    Command(
        "realism",
        evaluation.EvaluateRealism,
        "stages.evaluate.realism",
        "A real recording, then a simulated one.",
        "files",
    ),
    Command(
        "cost", evaluation.EvaluateCost, "numerics.cost", "Part model: features, models.", "rows", files_needed=False
    ),
    Command("stability", evaluation.EvaluateStability, "numerics.stability", "", "rows"),
)
# Of inspect/: for people, made again whenever asked for.
VIEW = Command(
    "view", inspection.View, "inspect.view", "Stage files of one trial; others of its name are found.", "images"
)
REPORT = Command("report", inspection.Report, "inspect.report", "A folder of stage files; two with --compare.", "files")
EXPORT = Command("export", inspection.Export, "inspect.export", "Recordings.", "events")
DOCTOR = Command("doctor", inspection.Doctor, "inspect.doctor", "")
