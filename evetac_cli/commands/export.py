"""export: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli import names, plugins
from evetac_cli.commands.parameter import PAGE, Command, parameter

IMAGES, LEROBOT = "Images of events", "LeRobot"  # panels of --help for options of these formats only


@dataclass(frozen=True)
class Export:
    """Export recordings and the results computed from them to a format that other programs read.

    Event formats contain only the events. mcap also contains dots, touch, labels, gripper and control. Tables have one
    row per slice, with the values of all tracks, labels, features and touch files next to the recording. Images of
    events, for neural networks, are those of `Recording.frames` and similar methods in Python. In a LeRobot data set,
    one frame covers several slices.
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
        "For tables and data sets: add the slip probability estimated by this model, or by the pretrained `shipped`.",
        recipe=False,
    )
    fps: int | None = parameter(
        None,
        "Images or frames per second; default: 200 for images of events, 50 for LeRobot.",
        unit="1/s",
        low=1,
        high=1000,
        recipe=False,
    )
    size: str | None = parameter(
        None,
        "Width and height of the images, e.g. 160x120; the sensor's pixels are summed. Default: the sensor's, for"
        " LeRobot's event frames 160x120.",
        unit="px",
        recipe=False,
    )
    window_ms: int | None = parameter(
        None,
        "Length of the time window that an image covers; default: from the end of the image before, so that"
        " each event counts once.",
        unit="ms",
        low=1,
        high=100_000,
        recipe=False,
        panel=IMAGES,
    )
    polarity: str | None = parameter(
        None,
        "Channels of the images. split: OFF and ON separately; signed: ON minus OFF; sum: ON plus OFF; default: split.",
        choices=("split", "signed", "sum"),
        recipe=False,
        panel=IMAGES,
    )
    bins: int | None = parameter(
        None,
        "Number of time bins of a histogram or voxel grid; default: 5.",
        low=1,
        high=1000,
        recipe=False,
        panel=IMAGES,
    )
    decay_ms: float | None = parameter(
        None,
        "Time in which the values of a time surface decay to 1/e; default: 10.",
        unit="ms",
        low=0.001,
        high=100_000.0,
        recipe=False,
        panel=IMAGES,
    )
    per_frame: str | None = parameter(
        None,
        "How the tactile vector combines the slices of a frame: mean (the default), the last slice, or all slices"
        " stacked.",
        choices=("mean", "last", "stacked"),
        recipe=False,
        panel=LEROBOT,
    )
    test_objects: str | None = parameter(
        None, "Objects of the split `test`, e.g. 18-20; default: none.", recipe=False, panel=LEROBOT
    )
    task: str | None = parameter(
        None, "Description of the episodes' task; default: that of the scene.", recipe=False, panel=LEROBOT
    )
    tactile_key: str | None = parameter(
        None,
        "Name of the tactile vector; default: observation.tactile. Policies without support for touch, such as ACT,"
        " need observation.environment_state.",
        choices=("observation.tactile", "observation.environment_state"),
        recipe=False,
        panel=LEROBOT,
    )
    event_frames: str | None = parameter(
        None,
        "Add to each frame the last event frames (ON minus OFF) before its end, e.g. 16@200 for 16 of them at 200 Hz;"
        " default: none.",
        recipe=False,
        panel=LEROBOT,
    )


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
    does=PAGE,
    out="Output file or folder; default: next to the recording.",
    force="Replace an existing file.",
)
