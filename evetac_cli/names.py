"""Names that commands, devices and stages share, as literal tables. It imports nothing of evetac: --help stays fast.

Help texts, choices and errors are made from these tables; plug-ins (plugins.py) add their own names. A key is the text
that a user types, with placeholders in capitals; its value is a short description for help, or empty.
`tests/test_names.py` checks that the tables agree with the code.
"""

from collections.abc import Iterable, Mapping
from enum import StrEnum

__version__ = "0.2.0"

CAMERAS = {
    "sim": "",
    "virtual": "an emulated device with the real driver, faults e.g. virtual:unplug@2 (docs/hardware.md)",
    "dvxplorer[:SERIAL]": "",
    "dv[:SERIAL]": "by dv-processing",
    "replay:FILE": "",
}
GRIPPERS = {
    "sim": "",
    "virtual": "faults e.g. virtual:overload@1 (docs/hardware.md)",
    "none": "",
    "PORT[:ID][@BAUD]": "e.g. /dev/ttyUSB0:5@57600, else ID 1, 2000000 baud",
}
IMPORTS = {
    "aedat4": "AEDAT4",
    "aedat2": "AEDAT 2",
    "hdf5": "HDF5 (DSEC, MVSEC, v2e, rpg, Prophesee)",
    "numpy": "npz or npy",
    "prophesee": "Prophesee RAW or DAT",
    "rosbag": "ROS bag (for ROS 2, its folder)",
    "text": "text or CSV with `t x y p` per line",
}
EXPORTS = {
    "aedat4": "for DV and dv-processing",
    "dsec": "HDF5 in the layout of the DSEC data set",
    "text": "`t_us x y p` per line",
    "raw": "Prophesee RAW, EVT3",
    "mcap": "ROS 2 messages of events, dots, touch, labels, gripper, control and other streams",
    "calibration": "dot grid as JSON, or with -o NAME.pkl as the official software's pickle",
    "parquet": "one table per recording, or with -o FOLDER one data set of all",
    "csv": "the tables of parquet as text",
    "frames": "event-count images for networks, as npz",
    "histogram": "like frames, with counts for each time bin",
    "voxels": "like frames, with ON minus OFF shared between the two nearest time bins",
    "surface": "like frames, with the recency of each pixel's last event",
    "lerobot": "a LeRobotDataset v3.0 in the folder -o",
}
CONTROLLERS = {
    "paper": "balancing sets its reference at the first slip",
    "paper-reset": "at every slip (both need --model)",
    "load-proportional": "evetac's own",
    "none": "contact only, no detector",
    "fixed:N": "N ticks beyond light contact",
}
TRACKERS = {
    "stable": "evetac's own",
    "paper": "",
    "paper-5-events": "paper, with 5 events to move a dot instead of 11",
    "official": "the authors' published code",
    "official-5ms": "the authors' code, run as in their readouts",
    "unregularised": "paper without the grid regulariser",
}
# Architectures of slip detectors, in the order of the paper's table.
NETWORKS = (
    *("no-hist", "hist10", "events-only", "disp-only", "hist20", "down5", "fast-slow"),
    *("no-hist-img", "hist10-img", "no-hist-img-6x6", "hist10-img-6x6"),
    "load-path",
)
RECORDED_SCENES = (
    *("slip", "slip-varied", "slip-speeds", "handling", "data-rate", "grip-steps", "shear", "press", "rest", "edge"),
    *("vibration", "vibration-randomized"),
)
GRASPED_SCENES = ("lift", "sideways", "drop-20g", "drop-100g")
SENSORS = (
    *("evetac", "small-dots", "official-dots", "synthetic-dots", "second", "bare-dvxplorer"),
    *("soft-gel", "stiff-gel", "tacchi-gel", "realistic", "randomized-narrow", "randomized"),
)


def words(table: Mapping[str, str], between: str = ": ") -> str:
    """Return the names of a table with their descriptions, for help: `sim; virtual, an emulated camera; ...`."""
    return "; ".join(f"{name}{between}{about}" if about else name for name, about in table.items())


def without_placeholders(table: Iterable[str]) -> tuple[str, ...]:
    """Return the names of a table without their placeholders, such as dv for `dv[:SERIAL]`.

    Names that consist only of placeholders are left out.
    """
    plain = (name.partition("[")[0].partition(":")[0] for name in table)
    return tuple(name for name in plain if not name.isupper())


def either(table: Iterable[str]) -> str:
    """Return the names of a table on one line, for an error: `sim, virtual or dv[:SERIAL]`."""
    *others, last = table
    return f"{', '.join(others)} or {last}"


class Capability(StrEnum):
    """A capability of a run of `record` or `grasp`, which follows from its devices and flags.

    Devices declare the capabilities that they have, options those that they need (commands/parameter.py). The values
    are used in the error message that refuses an option without effect.
    """

    IMPORT = "an import (--from)"
    DOTS = "dots of another simulator (--from-dots)"
    SCENE = "a simulated scene (--camera sim or virtual)"
    STEPPED = "a scene in simulated time (--camera sim)"
    DEVICE = "a device (--camera virtual, dvxplorer, dv or replay:FILE)"
    RECORDED = "a recording from a device (--camera virtual, dvxplorer, dv or replay:FILE)"
    GRASPED = "a grasp with devices (--camera virtual, dvxplorer or dv)"
    ADJUSTABLE = "a camera with settings (--camera virtual, dvxplorer or dv)"
    MOVED = "a gripper that moves (--gripper virtual or PORT)"
    PREVIEW = "--preview"
    LISTENING = "a robot's program that starts the trials (--listen)"
    SIMULATED = "a camera in a simulated scene"
    REPLAY = "a replayed recording (--camera replay:FILE)"
    HARDWARE = "a real device, where a person places the object"
    DETECTOR = "a --controller with a slip detector"


class TouchOption(StrEnum):
    """Requirements of options of predict-touch and train-force; the values are used in error messages."""

    PAPER = "the paper's method (--method paper)"
    TOUCH = "the touch-map method (--method touch)"
    SENSOR = "a known sensor (--sensor)"
    OF_NO_MODEL = "a run without --model"
