"""identify: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter


@dataclass(frozen=True)
class Identify:
    """Estimate a sensor from recordings (at rest, pressed, gripping); write it as TOML for --sensor, with intervals."""

    like: str = parameter("evetac", "The sensor from which all is taken that the recordings do not tell.")
    name: str = parameter("own-sensor", "What recordings made with it call the sensor.")
    seed: int = parameter(0, "Seed of the bootstrap intervals.", low=0, high=2**31 - 1)
    object_mass_g: float | None = parameter(
        None, "Mass of the object that a gripper held: the scale of the gel's stiffness.", unit="g", low=1.0, high=1e5
    )
    object_friction: float = parameter(
        0.9, "Static friction of that object on the gel of an average sensor; 0.9 is glass.", low=0.01, high=10.0
    )
    force_per_current: float | None = parameter(
        None,
        "Force of a finger for each mA of the gripper's current, by a scale between the fingers; it makes forces out of"
        " what recordings tell in current.",
        unit="N/mA",
        low=0.001,
        high=100.0,
    )
    pixel_mm: float | None = parameter(
        None,
        "Size of a pixel on the gel, by a ruler laid on it; default: that of --like, taken as known within 12 %.",
        unit="mm",
        low=0.001,
        high=1.0,
    )


COMMAND = Command(
    "identify",
    Identify,
    "stages.identify",
    "Recordings of one sensor.",
    suffix=".toml",
    unit="files",
    examples=("evetac identify rest.recording.h5 press.recording.h5 grip.recording.h5 -o own.sensor.toml",),
)
