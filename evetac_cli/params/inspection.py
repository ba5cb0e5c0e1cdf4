"""For people to look: view, report, export, doctor."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.params.parameter import parameter


@dataclass(frozen=True)
class View:
    """Look at a recording and what was computed from it: one HTML page that needs no network; an animation too."""

    start_s: float = parameter(0.0, "Show from here on.", unit="s", low=0.0, recipe=False)
    stop_s: float | None = parameter(None, "Show up to here; default: the end.", unit="s", low=0.0, recipe=False)
    shown_ms: int = parameter(5, "Events summed into one image.", unit="ms", low=1, high=1000, recipe=False)
    images: int = parameter(
        500, "Images in the page at most, dense near slip and where it is busiest.", low=1, high=3000, recipe=False
    )
    film: Path | None = parameter(None, "Write an animation too, to this GIF.", recipe=False)
    rrd: bool = parameter(
        False, "Write a file for the viewer rerun instead, NAME.rrd, with every event as far as it fits.", recipe=False
    )


@dataclass(frozen=True)
class Report:
    """Look at a whole data set or study: one HTML page that needs no network, with trials, onsets and evaluations."""

    compare: bool = parameter(False, "Set two folders side by side.", recipe=False)


LEROBOT = "LeRobot"  # the panel of --help of what only this format takes


@dataclass(frozen=True)
class Export:
    """Write recordings, and what was computed from them, in a format that other programs read.

    Formats of events hold the events alone; mcap has dots, forces, labels, gripper and control too. Tables have a row
    a slice, with all that tracks, labels, features and forces beside the recording say of it. A data set for LeRobot
    has a frame for several slices.
    """

    format: str = parameter(
        "aedat4",
        "aedat4: for DV and dv-processing; dsec: HDF5 as in the DSEC data set; text: `t_us x y p` a line;"
        " raw: Prophesee's RAW, EVT3; raw-evt2: the same, EVT2; dat: Prophesee's DAT;"
        " mcap: ROS 2 messages, with dots, forces, labels, gripper, control and other streams;"
        " calibration: the dot grid as JSON, or with -o NAME.pkl as the official software's pickle;"
        " parquet: a table a recording, or with -o FOLDER one data set of all; csv: the same as text;"
        " lerobot: a LeRobotDataset v3.0 in the folder -o.",
        choices=(
            "aedat4",
            "dsec",
            "text",
            "raw",
            "raw-evt2",
            "dat",
            "mcap",
            "calibration",
            "parquet",
            "csv",
            "lerobot",
        ),
        recipe=False,
    )
    model: str | None = parameter(
        None,
        "Of tables and data sets: with the slip probability by this model, or by `shipped`, the package's.",
        recipe=False,
    )
    fps: int | None = parameter(
        None, "Frames a second; default: 50.", unit="1/s", low=1, high=1000, recipe=False, panel=LEROBOT
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


@dataclass(frozen=True)
class Share:
    """Lay out a model, or a folder of files, as the Hugging Face Hub wants it, with a card; nothing is uploaded.

    The card says what it is, with data, seeds and figures, and that it is simulated where it is. Reports of `evetac
    evaluate slip` on the model, named after it, add their figures.
    """

    title: str | None = parameter(None, "Title of the card; default: the name of the file or folder.", recipe=False)
    license: str | None = parameter(
        None, "License by the Hub's name, as in mit or cc-by-4.0; default: none, and the card says so.", recipe=False
    )


@dataclass(frozen=True)
class Doctor:
    """Find cameras and grippers, and say of each what is wrong and the command that mends it; changes nothing.

    Ends with 0 if all that was found is fine, or nothing was found, and with 3 if something is wrong. With --speed it
    measures this computer instead, with --compile it only has the commands' inner loops compiled. With --hardware it
    tries a camera and a gripper step by step, moves the fingers a little, and writes a report.
    """

    print_udev: bool = parameter(False, "Print udev rules and where to put them, and do nothing else.", recipe=False)
    compile: bool = parameter(
        False,
        "Compile what the commands need, so that none of them waits for it later, and do nothing else; `make setup`"
        " does it.",
        recipe=False,
    )
    speed: bool = parameter(
        False,
        "Measure for some 10 s whether this computer is fast enough to record and to grasp in real time; writes a"
        " temporary file in this folder. Nothing else is examined.",
        recipe=False,
    )
    gripper: str | None = parameter(
        None,
        "Examine this port too, with or without @BAUD. By itself it only talks to ports of FTDI adapters (U2D2).",
        recipe=False,
    )
    hardware: bool = parameter(
        False,
        "First contact: try --camera and --gripper step by step, with at most 20 mA; stops, torque off, at the first"
        " step that is not as expected.",
        recipe=False,
    )
    camera: str | None = parameter(
        None, "--hardware: camera to try: dvxplorer, dvxplorer:SERIAL, dv, dv:SERIAL, or virtual.", recipe=False
    )
    arm: bool = parameter(False, "--hardware: move a real gripper.", recipe=False, consent=True)
    yes: bool = parameter(False, "--hardware: do not ask before the fingers move.", recipe=False, consent=True)
