"""featurize: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter


@dataclass(frozen=True)
class Featurize:
    """Turn a recording and its tracks (and labels) into features for slip detection."""

    tracks: Path | None = parameter(
        None, "Tracks of the recording, or their folder; default: beside it, under the same name.", recipe=False
    )
    labels: Path | None = parameter(
        None,
        "Labels of the recording, or their folder; default: beside it, under the same name, where there are any.",
        recipe=False,
    )
    events: bool = parameter(
        False,
        "Add the events outside the window, for plug-in networks that see images of them.",
        recipe=False,  # it is, where it is asked for: features that were made before there was such a choice stay
    )
    images: bool = parameter(False, "Add event images, for the image baselines no-hist-img and hist10-img.")
    sticking_share: bool = parameter(
        False,
        "Add which share of the contact sticks, by the network of touch maps, for the detector's network disp-xy-grip.",
        recipe=False,  # it is, where it is given: features that were made before there was such a choice stay
    )
    true_slip_share: bool = parameter(
        False,
        "Copy from the truth of simulated recordings which share of the visible contact slips, for train"
        " --learn-true-slip-share. Without it features hold nothing of the truth but labels that are copied from it.",
    )


COMMAND = Command(
    "featurize",
    Featurize,
    "stages.featurize",
    "Recordings (tracks and labels lie beside them).",
    examples=("evetac featurize data --jobs 2", "evetac featurize data --tracks paper -o paper"),
)
