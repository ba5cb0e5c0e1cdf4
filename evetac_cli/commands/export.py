"""export: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli import names, plugins
from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter

IMAGES, LEROBOT = "Images of events", "LeRobot"  # panels of --help of what only these formats take


@dataclass(frozen=True)
class Export:
    """Write recordings, and what was computed from them, in a format that other programs read.

    Formats of events hold the events alone; mcap has dots, touch, labels, gripper and control too. Tables have a row
    a slice, with all that tracks, labels, features and touch beside the recording say of it. Images of events, for
    networks, are those of `Recording.frames` and its like in Python. A data set for LeRobot has a frame for several
    slices.
    """

    format: str = parameter(
        "aedat4",
        f"{names.words(names.EXPORTS)}; or the format of a plug-in.",
        choices=tuple(names.EXPORTS),
        plugins=plugins.EXPORTERS,
        recipe=False,
    )
    model: str | None = parameter(
        None,
        "Of tables and data sets: with the slip probability by this model, or by `shipped`, the package's.",
        recipe=False,
    )
    fps: int | None = parameter(
        None,
        "Images or frames per second; default: 200 of images of events, 50 for LeRobot.",
        unit="1/s",
        low=1,
        high=1000,
        recipe=False,
    )
    size: str | None = parameter(
        None,
        "Width and height of the images, as in 160x120: pixels of the sensor are added up; default: the sensor's, of"
        " LeRobot's event frames 160x120.",
        unit="px",
        recipe=False,
    )
    window_ms: int | None = parameter(
        None,
        "What an image looks back on; default: from one image to the next.",
        unit="ms",
        low=1,
        high=100_000,
        recipe=False,
        panel=IMAGES,
    )
    polarity: str | None = parameter(
        None,
        "Channels: split: OFF and ON; signed: ON less OFF; sum: both together; default: split.",
        choices=("split", "signed", "sum"),
        recipe=False,
        panel=IMAGES,
    )
    bins: int | None = parameter(
        None,
        "Parts of the window of a histogram or voxel grid; default: 5.",
        low=1,
        high=1000,
        recipe=False,
        panel=IMAGES,
    )
    decay_ms: float | None = parameter(
        None,
        "Time in which a surface decays to 1/e; default: 10.",
        unit="ms",
        low=0.001,
        high=100_000.0,
        recipe=False,
        panel=IMAGES,
    )
    per_frame: str | None = parameter(
        None,
        "What stands for the slices of a frame in the tactile vector: their mean (the default), the last, or all of"
        " them stacked.",
        choices=("mean", "last", "stacked"),
        recipe=False,
        panel=LEROBOT,
    )
    test_objects: str | None = parameter(
        None, "Objects that make the split `test`, as in 18-20; default: none.", recipe=False, panel=LEROBOT
    )
    task: str | None = parameter(
        None, "What the episodes do, in words; default: what the scene is about.", recipe=False, panel=LEROBOT
    )
    tactile_key: str | None = parameter(
        None,
        "Name of the tactile vector; default: observation.tactile. Policies that know nothing of touch, such as ACT,"
        " read it as observation.environment_state.",
        choices=("observation.tactile", "observation.environment_state"),
        recipe=False,
        panel=LEROBOT,
    )
    tactile_layout: str | None = parameter(
        None,
        "Touch as a vector (the default), or as points: of each dot its displacement and, with touch maps, its force;"
        " and beside them the wrench.",
        choices=("vector", "points"),
        recipe=False,
        panel=LEROBOT,
    )
    event_frames: str | None = parameter(
        None,
        "Per frame also the last event frames before its end, as in 16@200: 16 of them at 200 Hz, ON less OFF; default:"
        " none.",
        recipe=False,
        panel=LEROBOT,
    )
    truth: bool = parameter(False, "Add what only a simulation knows, as simulated_truth.", recipe=False, panel=LEROBOT)


COMMAND = Command(
    "export",
    Export,
    "inspect.export",
    "Recordings.",
    unit="events",
    examples=(
        "evetac export a.recording.h5 --format aedat4",
        "evetac export data --format parquet -o tables",
        "evetac export data --format frames --fps 200 --size 160x120 -o images",
        "evetac export grasps --format lerobot --fps 50 --event-frames 16@200 -o touch",
    ),
)
