"""train-force: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import Command, parameter
from evetac_cli.commands.predict_touch import GelFlags
from evetac_cli.names import TouchOption


@dataclass(frozen=True)
class TrainForce(GelFlags):
    """Train on known forces: the paper's force models for one dot grid, or the scale of your sensor's touch maps.

    The flags of the gel and its sensor are for the method touch.
    """

    method: str = parameter(
        "paper",
        "paper: shear force by a linear regression and by the paper's network, for the dot grid of one sensor. touch:"
        " stiffness and creep of your sensor, for forces by predict-touch --model. The known forces for touch are read"
        " from NAME.force.csv next to the tracks, or from a simulation's ground truth.",
        choices=("paper", "touch"),
        needs=(TouchOption.PAPER, TouchOption.TOUCH),
    )
    samples: int = parameter(
        200,
        "For method paper: samples per trajectory, evenly spread over the contact.",
        low=3,
        high=100000,
        needs=(TouchOption.PAPER,),
    )
    noise_n: float = parameter(
        0.05,
        "Noise of the force sensor that measured the known forces (standard deviation).",
        unit="N",
        low=0.0,
        high=100.0,
    )
    epochs: int = parameter(
        50,
        "For method paper: passes over the samples; the epoch with the best result on the last file is kept.",
        low=1,
        high=100000,
        needs=(TouchOption.PAPER,),
    )
    seed: int = parameter(0, "Seed of the noise, the first weights and the order of samples.", low=0, high=2**31 - 1)


COMMAND = Command(
    "train-force",
    TrainForce,
    "stages.force.train_force",
    "Tracks under known forces; with method paper the last file is held out.",
    kind="tracks",
    unit="steps",
    examples=(
        "evetac train-force shear/*.tracks.h5 -o shear.force-model.h5",
        "evetac train-force own/*.tracks.h5 --method touch --sensor mine.sensor.toml -o own.force-model.h5",
    ),
)
