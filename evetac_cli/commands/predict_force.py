"""predict-force: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter
from evetac_cli.names import PredictionOption


@dataclass(frozen=True)
class PredictForce:
    """Predict force from tracked dots, slice by slice: shear, normal force and contact, with their uncertainty."""

    model: Path | None = parameter(
        None,
        "Force model, made by train-force, or `shipped`; default: the package's, which is for any sensor.",
        recipe=False,
    )
    sensor: str | None = parameter(
        None,
        "Your sensor's file as `evetac identify` writes it, or a sensor's name: its scale and stiffness; default:"
        " unknown, and forces are as unsure.",
        recipe=False,
    )
    stiffness_error: float = parameter(
        0.1,
        "With --sensor: relative error of its moduli, one standard deviation.",
        low=0.0,
        high=2.0,
        needs=(PredictionOption.SENSOR,),
    )


COMMAND = Command(
    "predict-force",
    PredictForce,
    "stages.force.predict_force",
    "Tracks.",
    kind="tracks",
    examples=("evetac predict-force data", "evetac predict-force data --sensor own.sensor.toml"),
)
