"""train-force: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter
from evetac_cli.names import TouchOption


@dataclass(frozen=True)
class TrainForce:
    """Train on known forces: the paper's force models for one dot grid, or the scale of your sensor's touch maps."""

    method: str = parameter(
        "paper",
        "paper: shear force by a linear regression and by the paper's network, for the dot grid of one sensor. touch:"
        " stiffness and creep of your sensor, for forces by predict-touch --model. The known forces for touch are read"
        " from NAME.force.csv next to the tracks, or from a simulation's ground truth.",
        choices=("paper", "touch"),
        needs=(TouchOption.PAPER, TouchOption.TOUCH),
    )
    sensor: str | None = parameter(
        None,
        "For method touch: your sensor's file, as written by `evetac identify`, or the name of a sensor; default:"
        " unknown sensor.",
        recipe=False,
        needs=(TouchOption.TOUCH,),
    )
    stiffness_error: float = parameter(
        0.1,
        "With --sensor: relative error of its shear modulus (one standard deviation).",
        low=0.0,
        high=2.0,
        needs=(TouchOption.SENSOR,),
    )
    height_mm: float = parameter(
        4.0, "For method touch: thickness of the gel.", unit="mm", low=0.1, high=100.0, needs=(TouchOption.TOUCH,)
    )
    print_depth_mm: float = parameter(
        0.0,
        "For method touch: depth of the dots below the surface.",
        unit="mm",
        low=0.0,
        high=99.0,
        needs=(TouchOption.TOUCH,),
    )
    lens_mm: float = parameter(
        25.0,
        "For method touch: distance from the lens to the dots.",
        unit="mm",
        low=1.0,
        high=1e6,
        needs=(TouchOption.TOUCH,),
    )
    gel_mm: str = parameter(
        "",
        "For method touch: left, top, right and bottom edge of the gel, measured from the middle of the frame, e.g."
        " -12.8,-7.5,10.5,7.5; default: those of --sensor. Without --sensor, edges are taken to be far away, except at"
        " the window of a cut gel.",
        unit="mm",
        needs=(TouchOption.TOUCH,),
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
