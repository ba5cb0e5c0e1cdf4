"""featurize: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.parameter import Command, parameter


@dataclass(frozen=True)
class Featurize:
    """Compute features for slip detection from a recording, its tracks and, if present, its labels."""

    tracks: Path | None = parameter(
        None, "Tracks of the recording, or their folder; default: the file of the same name next to it.", recipe=False
    )
    labels: Path | None = parameter(
        None,
        "Labels of the recording, or their folder; default: the file of the same name next to it, if there is one.",
        recipe=False,
    )
    events: bool = parameter(
        False,
        "Add the events outside the window, for plug-in networks that use event images.",
        recipe=False,  # added to the recipe only if given: features made before this option existed stay up to date
    )
    images: bool = parameter(False, "Add event images, for the image baselines no-hist-img and hist10-img.")
    sticking_share: bool = parameter(
        False,
        "Add the sticking share of the contact, as estimated by the touch-map network, for the detector load-path.",
        recipe=False,  # added to the recipe only if given: features made before this option existed stay up to date
    )
    true_slip_share: bool = parameter(
        False,
        "Copy the slipping share of the visible contact from the ground truth of simulated recordings, for train"
        " --learn-true-slip-share. Without this flag, only labels made from ground truth bring it into the features.",
    )


COMMAND = Command(
    "featurize",
    Featurize,
    "stages.featurize",
    "Recordings, with tracks and labels next to them.",
    examples=("evetac featurize data --jobs 2", "evetac featurize data --tracks paper -o paper"),
)
