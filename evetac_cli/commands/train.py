"""train: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli import names, plugins
from evetac_cli.commands.parameter import EXPERTS, Command, parameter

LEAST_MINUTES = 5.0  # without slip, to choose a threshold: with fewer, 1 alarm per minute is less than five alarms
# Default rate. A false alarm costs a controller little, since it checks the load first; a late warning costs more.
# The rate was chosen on one detector by the share of its validation slips with a warning 10 ms ahead. The share is
# 0.22 with 1 per minute, 0.62 with 2, 0.74 with 4, 0.78 with 6 (simulated, seeds 5600 to 5623).
FALSE_ALARMS_PER_MIN = 4.0


@dataclass(frozen=True)
class Train:
    """Train a slip detector on labelled features."""

    model: str | None = parameter(
        None,
        "Architecture, named as in the paper's table. -6x6: event images summed over 6 x 6 px, fast enough for a CPU."
        " load-path: evetac's own, with memory of the contact; it needs featurize --sticking-share."
        " Default: hist10, or that of --adapt.",
        choices=names.NETWORKS,
        plugins=plugins.NETWORKS,
    )
    horizon_ms: int | None = parameter(
        None,
        "How far ahead slip is predicted: labels are shifted by this time; default: 0, or that of --adapt.",
        unit="ms",
        low=0,
        high=1000,
    )
    preset: str | None = parameter(
        None,
        "Training recipe. paper: SGD at 0.001 on plain features. adam: Adam at 0.001 on normalised features. adamw:"
        " AdamW from 0.002 down to 0 on normalised features, with samples scaled up and down and weights averaged over"
        " training. With adam and adamw, probabilities are calibrated on the validation files, to match how often slip"
        " occurs. Default: paper; with --adapt, always adamw with small steps. load-path has its own recipe.",
        choices=("paper", "adam", "adamw"),
    )
    learn_true_slip_share: bool = parameter(
        False,
        "Learn, in addition to the labels, the slipping share of the visible contact from simulated ground truth"
        " (featurize --true-slip-share). No real sensor can measure this share; `info` and tables mark such a model.",
        panel=EXPERTS,
    )
    epochs: int = parameter(
        70,
        "Passes over the training data; one covers all non-slip slices with more than 25 events.",
        low=1,
        high=100000,
        panel=EXPERTS,
    )
    max_steps: int | None = parameter(
        None,
        "Stop after this many steps, with a note; default: 40000, 2000 for load-path, or 1000 with --adapt.",
        unit="steps",
        low=1,
        panel=EXPERTS,
    )
    seed: int = parameter(0, "Seed of the first weights, sampling and augmentation.", low=0, high=2**31 - 1)
    seeds: int = parameter(
        1, "Number of models to train, each with the next seed and in a separate file.", low=1, high=1000, recipe=False
    )
    device: str = parameter(
        "cpu", "Device that computes the training; the numbers depend on it.", choices=("cpu", "cuda"), panel=EXPERTS
    )
    objects: str = parameter(
        "", "Train only on features of these objects, e.g. `1-9` or `1-3,8`.", recipe=False, flag="--object"
    )
    validate: str = parameter(
        "",
        "Folder or glob of validation files, at least 4 features files, on which checkpoint and threshold are chosen;"
        " default: every 8th input.",
        recipe=False,
    )
    false_alarms_per_min: float | None = parameter(
        None,
        "Choose the lowest threshold with, at 95 % confidence, at most this many false alarms per minute, counted in"
        f" the validation files where nothing slips. Default: {FALSE_ALARMS_PER_MIN:g}; with preset paper, or less than"
        f" {LEAST_MINUTES:g} minutes to count in, the paper's rule: the best mean of timing and F1.",
        unit="1/min",
        low=0.0,
        high=300.0,
        recipe=False,  # added to the recipe only if given
        panel=EXPERTS,
    )
    folds: int = parameter(
        0,
        "Choose checkpoint and threshold by cross-validation over objects: this many more networks are trained, each"
        " with one share of the objects held out and evaluated on that share. Use it for a detector that must work on"
        " unseen objects.",
        low=0,
        high=100,
        panel=EXPERTS,
    )
    adapt: str = parameter(
        "",
        "Adapt this trained model, or the pretrained `shipped`, to your own sensor with a few of your recordings."
        " Architecture and horizon are the model's.",
        recipe=False,
    )


COMMAND = Command(
    "train",
    Train,
    "stages.train",
    "Labelled features, one file per trajectory.",
    kind="features",
    unit="steps",
    examples=(
        "evetac train data --validate validation -o models",
        "evetac train own --adapt shipped --validate own-validation -o own.model.h5",
    ),
)
