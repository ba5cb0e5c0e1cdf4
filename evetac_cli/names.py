"""Names that commands, devices and stages share, as literal tables; nothing is imported here: --help is light."""

from enum import StrEnum


class Capability(StrEnum):
    """What a run of `record` or `grasp` has or does, by its devices and flags.

    Devices say which of these they have, options say which they need (commands.parameter); the values are the words in
    which an option without effect is refused.
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
    SIMULATED = "a camera that sees a simulation"
    REPLAY = "a recording that is played (--camera replay:FILE)"
    HARDWARE = "a real device, before which a person puts the object"


class Training(StrEnum):
    """Ways to a force model that options of train-force belong to."""

    PAPER = "a training by the paper's method (--method paper)"
    GEL = "a training for any sensor (--method gel)"
    ADAPTATION = "an adaptation (--adapt)"
    SENSOR = "an adaptation to a sensor of which something is known (--adapt with --sensor)"


class Prediction(StrEnum):
    """What options of predict-force belong to."""

    SENSOR = "a sensor of which something is known (--sensor)"
