"""view: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter


@dataclass(frozen=True)
class View:
    """Look at a recording and what was computed from it: one HTML page that needs no network; an animation too."""

    start_s: float = parameter(0.0, "Show from here on.", unit="s", low=0.0, recipe=False)
    stop_s: float | None = parameter(None, "Show up to here; default: the end.", unit="s", low=0.0, recipe=False)
    shown_ms: int = parameter(5, "Events summed into one image.", unit="ms", low=1, high=1000, recipe=False)
    images: int = parameter(
        500, "Images in the page at most, dense near slip and where it is busiest.", low=1, high=3000, recipe=False
    )
    film: Path | None = parameter(None, "Write an animation too, to this GIF.", recipe=False)
    rrd: bool = parameter(
        False, "Write a file for the viewer rerun instead, NAME.rrd, with every event as far as it fits.", recipe=False
    )


COMMAND = Command(
    "view",
    View,
    "pages.view",
    "Stage files of one trial; others of its name are found. Also a model, or `shipped` for the package's.",
    kind="",
    unit="images",
    examples=("evetac view a.recording.h5", "evetac view a.recording.h5 --start-s 1 --stop-s 1.2 --film a.gif"),
)
