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


@dataclass(frozen=True)
class Report:
    """Look at a whole data set or study: one HTML page that needs no network, with trials, onsets and evaluations."""

    compare: bool = parameter(False, "Set two folders side by side.", recipe=False)


@dataclass(frozen=True)
class Export:
    """Write the events, or the dot grid, of recordings in a format that other programs read."""

    format: str = parameter(
        "aedat4",
        "aedat4: for DV and dv-processing; dsec: HDF5 as in the DSEC data set; text: `t_us x y p` a line;"
        " calibration: the dot grid as JSON, or with -o NAME.pkl as the official software's pickle.",
        choices=("aedat4", "dsec", "text", "calibration"),
        recipe=False,
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
    arm: bool = parameter(False, "--hardware: move a real gripper.", recipe=False)
    yes: bool = parameter(False, "--hardware: do not ask before the fingers move.", recipe=False)
