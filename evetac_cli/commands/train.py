"""train: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli import names, plugins
from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter

OTHERS, TRAINING = "Other methods than event-flow", "Training"  # panels of --help


@dataclass(frozen=True)
class Train:
    """Train a slip detector on labelled features."""

    model: str | None = parameter(
        None,
        "Architecture, named as in the paper's table; -6x6: event images summed over 6 x 6 px, for a CPU;"
        " disp-xy: ours, which sees directions and changes of displacements; disp-xy-grip: the same with,"
        " where they are known, the gripper's position and command and which share of the contact sticks; default:"
        " hist10, or that of --adapt.",
        choices=names.NETWORKS,
        plugins=plugins.NETWORKS,
    )
    horizon_ms: int | None = parameter(
        None,
        "Predict slip so far ahead: labels are shifted by as much; default: 0, or that of --adapt.",
        unit="ms",
        low=0,
        high=1000,
    )
    preset: str | None = parameter(
        None,
        "paper: SGD 0.001 on plain features; adam: Adam 0.001 on normalised features; adamw: AdamW 0.002 falling to 0"
        " on normalised features, samples made stronger and weaker, and the average of the weights over training."
        " With adam and adamw, probabilities are calibrated on the files that validate, to say how often slip happens."
        " Default: paper, or with --adapt, which takes no other, adamw with small steps.",
        choices=("paper", "adam", "adamw"),
    )
    learn_true_slip_share: bool = parameter(
        False,
        "Learn beside the labels, from the truth of simulated features (featurize --true-slip-share), which share of"
        " the visible contact slips: no real sensor knows it. `info` and tables name a model that did.",
        panel=TRAINING,
    )
    epochs: int = parameter(70, "Passes over the non-slip slices with more than 25 events.", low=1, high=100000)
    max_steps: int | None = parameter(
        None,
        "Stop after this many steps, and say so; default: 40000, or 1000 with --adapt.",
        unit="steps",
        low=1,
    )
    patience: int | None = parameter(
        None,
        "Stop when the loss on the files that validate has not fallen for so many of 100 looks at it, evenly spread"
        " over the steps; its best network is then among the checkpoints. Default: take all steps.",
        low=1,
        high=100,
        panel=TRAINING,
        recipe=False,  # it is, where it is given: models that were made before there was such a choice stay up to date
    )
    seed: int = parameter(0, "Seed of weights, sampling and augmentation.", low=0, high=2**31 - 1)
    seeds: int = parameter(
        1, "Models to train, each with the next seed and in a file of its own.", low=1, high=1000, recipe=False
    )
    log: str | None = parameter(
        None,
        "tensorboard: write the losses while they fall to NAME.model.log. A CSV of them lies beside every model.",
        choices=("tensorboard",),
        panel=TRAINING,
        recipe=False,
    )
    device: str = parameter(
        "cpu", "Where it is computed; numbers depend on it.", choices=("cpu", "cuda"), panel=TRAINING
    )
    networks: int | None = parameter(
        None,
        "Train so many networks apart, from other first weights, and let the mean of their logits decide: steadier on"
        " objects and sensors unlike those learned from, at so many times the cost; default: 1, or as many as the model"
        " of --adapt.",
        low=1,
        high=32,
        panel=TRAINING,
    )
    objects: str = parameter(
        "", "Use the features of these objects only, as in `1-9` or `1-3,8`.", recipe=False, flag="--object"
    )
    validate: str = parameter(
        "",
        "Folder or glob of features to choose checkpoint and threshold on, at least 4; default: every 8th input.",
        recipe=False,
    )
    false_alarms_per_min: float | None = parameter(
        None,
        "Choose the lowest threshold with at most so many false alarms per minute, counted in the files that validate,"
        " where nothing slips within 200 ms. Default: 4; with preset paper, or with less than 5 minutes to count in,"
        " the paper's rule: the best mean of timing and F1.",
        unit="1/min",
        low=0.0,
        high=300.0,
        recipe=False,  # it is, where it is given
    )
    folds: int = parameter(
        0,
        "Choose checkpoint and threshold on objects that a network has not seen: this many more networks are trained,"
        " each without one share of the objects, and judged on that share. For detectors that will meet new objects.",
        low=0,
        high=100,
        panel=TRAINING,
    )
    adapt: str = parameter(
        "",
        "Go on from this trained model, or `shipped`, the package's: a few recordings of one's own sensor adapt it."
        " Architecture and horizon are the model's.",
        recipe=False,
    )


COMMAND = Command(
    "train",
    Train,
    "stages.train",
    "Labelled features, one file a trajectory.",
    kind="features",
    unit="steps",
    examples=(
        "evetac train data --validate validation -o models",
        "evetac train own --adapt shipped --validate own-validation -o own.model.h5",
    ),
)
