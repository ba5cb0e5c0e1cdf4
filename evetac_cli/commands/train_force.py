"""train-force: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter
from evetac_cli.names import TrainingOption


@dataclass(frozen=True)
class TrainForce:
    """Train a force model: the paper's on dots of one sensor, or one for any sensor; adapt the latter to your own."""

    method: str = parameter(
        "paper",
        "paper: shear force by a linear regression and the paper's network, for the dot grid of one sensor; gel: shear"
        " and normal force and contact for any dot grid and gel, from simulated contacts, its errors measured on the"
        " files.",
        choices=("paper", "gel"),
        needs=(TrainingOption.PAPER, TrainingOption.GEL),
    )
    adapt: str = parameter(
        "",
        "Go on from this model of method gel, or `shipped`, the package's: recordings of your sensor under known forces"
        " adapt it. Readings lie beside the tracks as NAME.force.csv, or are the truth of a simulation.",
        recipe=False,
    )
    sensor: str | None = parameter(
        None,
        "With --adapt: your sensor's file as `evetac identify` writes it, or a sensor's name; default: unknown.",
        recipe=False,
        needs=(TrainingOption.ADAPTATION,),
    )
    stiffness_error: float = parameter(
        0.1,
        "With --sensor: relative error of its moduli, one standard deviation.",
        low=0.0,
        high=2.0,
        needs=(TrainingOption.SENSOR,),
    )
    contacts: int = parameter(
        4000, "Of method gel: contacts that are simulated.", low=10, high=1000000, needs=(TrainingOption.GEL,)
    )
    samples: int = parameter(
        200,
        "Of method paper: samples of each trajectory, evenly spread over the contact.",
        low=3,
        high=100000,
        needs=(TrainingOption.PAPER,),
    )
    noise_n: float = parameter(
        0.05,
        "Noise of the force sensor that is fitted to, sd; not of method gel.",
        unit="N",
        low=0.0,
        high=100.0,
        needs=(TrainingOption.PAPER, TrainingOption.ADAPTATION),
    )
    epochs: int = parameter(
        50,
        "Passes over the samples; of the paper's network the best on the last file is kept. Not with --adapt.",
        low=1,
        high=100000,
        needs=(TrainingOption.PAPER, TrainingOption.GEL),
    )
    seed: int = parameter(0, "Seed of the noise, the first weights and the order of samples.", low=0, high=2**31 - 1)


COMMAND = Command(
    "train-force",
    TrainForce,
    "stages.force.train_force",
    "Tracks of shear recordings; the last file is held out.",
    kind="tracks",
    unit="steps",
    examples=(
        "evetac train-force shear/*.tracks.h5 -o shear.force-model.h5",
        "evetac train-force own --adapt shipped -o own.force-model.h5",
    ),
)
