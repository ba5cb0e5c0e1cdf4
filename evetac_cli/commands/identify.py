"""identify: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import Command, parameter


@dataclass(frozen=True)
class Identify:
    """Estimate a sensor's parameters from recordings (at rest, pressed, gripping), and write them as TOML for --sensor.

    Each estimate comes with its confidence interval.
    """

    like: str = parameter("evetac", "Sensor whose values are used for parameters that the recordings do not determine.")
    name: str = parameter("own-sensor", "Name of the sensor, as stored in recordings made with it.")
    seed: int = parameter(0, "Seed of the bootstrap intervals.", low=0, high=2**31 - 1)
    object_mass_g: float | None = parameter(
        None,
        "Mass of the object held by the gripper; it sets the scale of the gel's stiffness.",
        unit="g",
        low=1.0,
        high=1e5,
    )
    object_friction: float = parameter(
        0.9,
        "Static friction coefficient of that object on an average sensor's gel; 0.9 is that of glass.",
        low=0.01,
        high=10.0,
    )
    force_per_current: float | None = parameter(
        None,
        "Force of a finger per mA of gripper current, measured with a scale between the fingers; it converts currents"
        " in the recordings to forces.",
        unit="N/mA",
        low=0.001,
        high=100.0,
    )
    pixel_mm: float | None = parameter(
        None,
        "Size of a pixel on the gel, measured with a ruler on it; default: that of --like, taken as known within 12 %.",
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
