"""view: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import PAGE, Command, parameter


@dataclass(frozen=True)
class View:
    """Show a recording and the results computed from it on one HTML page, which works offline."""

    start_s: float = parameter(0.0, "Start of the part to show.", unit="s", low=0.0, recipe=False)
    stop_s: float | None = parameter(
        None, "End of the part to show; default: the end.", unit="s", low=0.0, recipe=False
    )
    shown_ms: int = parameter(
        5, "Time over which events are summed into one image.", unit="ms", low=1, high=1000, recipe=False
    )
    images: int = parameter(
        500,
        "Largest number of images on the page; they are densest near slip and at high event rates.",
        low=1,
        high=3000,
        recipe=False,
    )


COMMAND = Command(
    "view",
    View,
    "pages.view",
    "Any stage file of one trial; the others of the same name are found. Also a model, or the pretrained `shipped`.",
    kind="",
    unit="images",
    examples=("evetac view a.recording.h5", "evetac view a.recording.h5 --start-s 1 --stop-s 1.2"),
    does=PAGE,
    out="Output file or folder; default: next to the input.",
    force="Replace an existing page.",
)
