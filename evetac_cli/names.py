"""Names that commands, devices and stages share, as literal tables; nothing is imported here: --help is light.

Help texts, choices and errors are made from these tables, and plug-ins (plugins.py) join them under names of their own.
A key is what is typed, with a placeholder in capitals for what varies; beside it stands what help says of it, if
anything. That the tables are those of the code, `tests/test_names.py` asserts.
"""

from collections.abc import Iterable, Mapping
from enum import StrEnum

CAMERAS = {
    "sim": "",
    "virtual": "a simulated world before the real driver, faults as in virtual:unplug@2 (docs/hardware.md)",
    "dvxplorer[:SERIAL]": "",
    "dv[:SERIAL]": "by dv-processing",
    "replay:FILE": "",
}
GRIPPERS = {
    "sim": "",
    "virtual": "faults as in virtual:overload@1 (docs/hardware.md)",
    "none": "",
    "PORT[:ID][@BAUD]": "as in /dev/ttyUSB0:5@57600, else id 1, 2000000 baud",
}
IMPORTS = {
    "aedat4": "AEDAT4",
    "aedat3": "AEDAT 3.1",
    "aedat2": "AEDAT 2",
    "hdf5": "HDF5 (DSEC, MVSEC, v2e, rpg, Prophesee)",
    "numpy": "npz or npy",
    "prophesee": "Prophesee RAW or DAT",
    "rosbag": "a ROS bag (of ROS 2 its folder)",
    "text": "text or CSV with `t x y p` a line",
}
EXPORTS = {
    "aedat4": "for DV and dv-processing",
    "dsec": "HDF5 as in the DSEC data set",
    "text": "`t_us x y p` a line",
    "raw": "Prophesee's RAW, EVT3",
    "raw-evt2": "the same, EVT2",
    "dat": "Prophesee's DAT",
    "mcap": "ROS 2 messages, with dots, touch, labels, gripper, control and other streams",
    "calibration": "the dot grid as JSON, or with -o NAME.pkl as the official software's pickle",
    "parquet": "a table a recording, or with -o FOLDER one data set of all",
    "touch-map": "a table of the touch maps, a row a cell, as Parquet",
    "csv": "the same as text",
    "frames": "images for networks, counts of events, as npz, or with -o NAME.parquet or NAME.zarr.zip as these",
    "histogram": "the same, counts of each part of the window",
    "voxels": "the same, ON less OFF shared between the two nearest parts of the window",
    "surface": "the same, how recent the last event of each pixel is",
    "lerobot": "a LeRobotDataset v3.0 in the folder -o",
}
CONTROLLERS = {
    "paper": "balance sets the reference at the first slip",
    "paper-reset": "at every slip",
    "load-proportional": "ours",
    "none": "contact alone, no detector",
    "fixed:N": "N ticks beyond light contact",
}
TRACKERS = {
    "stable": "ours",
    "paper": "",
    "official": "the authors' published code",
    "official-5ms": "the same, as its readouts run it",
    "unregularised": "paper's without grid",
}
# Architectures of slip detectors, in the order of the paper's table.
NETWORKS = (
    *("no-hist", "hist10", "events-only", "disp-only", "hist20", "down5", "fast-slow"),
    *("no-hist-img", "hist10-img", "no-hist-img-6x6", "hist10-img-6x6"),
    *("disp-xy", "disp-xy-grip"),
)
RECORDED_SCENES = (
    *("slip", "slip-varied", "slip-speeds", "handling", "data-rate", "grip-steps", "shear", "press", "rest", "edge"),
    *("vibration", "vibration-randomized"),
)
GRASPED_SCENES = ("lift", "sideways", "drop-20g", "drop-100g")
SENSORS = (
    *("evetac", "paper-dots", "official-dots", "synthetic-dots", "second", "bare-dvxplorer"),
    *("soft-gel", "stiff-gel", "tacchi-gel", "realistic", "randomized-narrow", "randomized"),
)


def words(table: Mapping[str, str], between: str = ": ") -> str:
    """The names of a table and what is said of them, as help has it: `sim; virtual, a simulated world; ...`."""
    return "; ".join(f"{name}{between}{about}" if about else name for name, about in table.items())


def without_placeholders(table: Iterable[str]) -> tuple[str, ...]:
    """The names of a table without what varies: dv of `dv[:SERIAL]`; those that are placeholders alone are left out."""
    plain = (name.partition("[")[0].partition(":")[0] for name in table)
    return tuple(name for name in plain if not name.isupper())


def either(table: Iterable[str]) -> str:
    """The names of a table on one line, for an error: `sim, virtual or dv[:SERIAL]`."""
    *others, last = table
    return f"{', '.join(others)} or {last}"


class Capability(StrEnum):
    """What a run of `record` or `grasp` has or does, by its devices and flags.

    Devices say which of these they have, options say which they need (commands/parameter.py); the values are the
    words in which an option without effect is refused.
    """

    IMPORT = "an import (--from)"
    SCENE = "a simulated scene (--camera sim or virtual)"
    STEPPED = "a simulated scene in its own time (--camera sim)"
    DEVICE = "a device (--camera virtual, dvxplorer, dv or replay:FILE)"
    RECORDED = "a recording from a device (--camera virtual, dvxplorer, dv or replay:FILE)"
    GRASPED = "a grasp with devices (--camera virtual, dvxplorer or dv)"
    ADJUSTABLE = "a camera that can be set up (--camera virtual, dvxplorer or dv)"
    MOVED = "a gripper that is moved (--gripper virtual or PORT)"
    PREVIEW = "--preview"
    SHOWN = "what is shown (--live or --preview)"
    LISTENING = "what a robot's program starts (--listen)"
    SIMULATED = "a camera that sees a simulation"
    REPLAY = "a recording that is played (--camera replay:FILE)"
    HARDWARE = "a real device, before which a person puts the object"


class TouchOption(StrEnum):
    """What options of predict-touch and train-force belong to."""

    PAPER = "a training by the paper's method (--method paper)"
    TOUCH = "an adaptation of touch maps (--method touch)"
    SENSOR = "a sensor of which something is known (--sensor)"
    OF_NO_MODEL = "a touch map without a model (no --model)"
