"""train-force: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter
from evetac_cli.names import TouchOption


@dataclass(frozen=True)
class TrainForce:
    """Learn from known forces: the paper's models of one sensor's dots, or the scale of your sensor's touch maps."""

    method: str = parameter(
        "paper",
        "paper: shear force by a linear regression and the paper's network, for the dot grid of one sensor; touch:"
        " stiffness and creep of your sensor, with which predict-touch --model tells forces. Known forces of"
        " touch lie beside the tracks as NAME.force.csv, or are the truth of a simulation.",
        choices=("paper", "touch"),
        needs=(TouchOption.PAPER, TouchOption.TOUCH),
    )
    sensor: str | None = parameter(
        None,
        "Of method touch: your sensor's file as `evetac identify` writes it, or a sensor's name; default: unknown.",
        recipe=False,
        needs=(TouchOption.TOUCH,),
    )
    stiffness_error: float = parameter(
        0.1,
        "With --sensor: relative error of its shear modulus, one standard deviation.",
        low=0.0,
        high=2.0,
        needs=(TouchOption.SENSOR,),
    )
    height_mm: float = parameter(
        4.0, "Of method touch: thickness of the gel.", unit="mm", low=0.1, high=100.0, needs=(TouchOption.TOUCH,)
    )
    print_depth_mm: float = parameter(
        0.0,
        "Of method touch: depth of the dots under the surface.",
        unit="mm",
        low=0.0,
        high=99.0,
        needs=(TouchOption.TOUCH,),
    )
    lens_mm: float = parameter(
        25.0,
        "Of method touch: from the lens to the dots.",
        unit="mm",
        low=1.0,
        high=1e6,
        needs=(TouchOption.TOUCH,),
    )
    gel_mm: str = parameter(
        "",
        "Of method touch: where the gel ends: left, top, right and bottom edge from the middle of the frame, as in"
        " -12.8,-7.5,10.5,7.5; default: a named sensor's, else far away but for the window of a cut gel.",
        unit="mm",
        needs=(TouchOption.TOUCH,),
    )
    samples: int = parameter(
        200,
        "Of method paper: samples of each trajectory, evenly spread over the contact.",
        low=3,
        high=100000,
        needs=(TouchOption.PAPER,),
    )
    noise_n: float = parameter(
        0.05,
        "Noise of the force sensor that is fitted to, sd.",
        unit="N",
        low=0.0,
        high=100.0,
    )
    epochs: int = parameter(
        50,
        "Of method paper: passes over the samples; the best on the last file is kept.",
        low=1,
        high=100000,
        needs=(TouchOption.PAPER,),
    )
    seed: int = parameter(0, "Seed of the noise, the first weights and the order of samples.", low=0, high=2**31 - 1)


COMMAND = Command(
    "train-force",
    TrainForce,
    "stages.force.train_force",
    "Tracks under known forces; by the paper's method the last file is held out.",
    kind="tracks",
    unit="steps",
    examples=(
        "evetac train-force shear/*.tracks.h5 -o shear.force-model.h5",
        "evetac train-force own/*.tracks.h5 --method touch --sensor mine.sensor.toml -o own.force-model.h5",
    ),
)
