"""label: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter

REVIEW = "A person's labels"  # a panel of --help
OTHERS, TRAINING = "Other methods than event-flow", "Training"  # panels of --help


@dataclass(frozen=True)
class Label:
    """Label when the object slips, from what the window shows against the gel."""

    method: str = parameter(
        "event-flow",
        "How; event-flow: motion counted from events; farneback: the paper's optical flow; dis: another flow;"
        " event-count: many events in the window; truth: gross slip as the simulation knows it, for comparison.",
        choices=("event-flow", "farneback", "dis", "event-count", "truth"),
    )
    slip_distance_px: float = parameter(
        0.3, "Slide of the object on the gel, as counted, that is the onset of slip; event-flow.", unit="px", low=0.01
    )
    threshold_px: float = parameter(
        0.3,
        "Flow methods: relative flow of window against gel over the look-ahead that is slip.",
        unit="px",
        low=0.01,
        panel=OTHERS,
    )
    threshold_events: int = parameter(
        200, "Events of the window over the look-ahead that are slip; event-count.", unit="events", low=1, panel=OTHERS
    )
    look_ahead_ms: int = parameter(
        4,
        "Flow methods: flow is taken from a slice to the one this much later.",
        unit="ms",
        low=1,
        high=100,
        panel=OTHERS,
    )
    accumulate_ms: int = parameter(
        3, "Flow methods: slices summed into one event image.", unit="ms", low=1, high=100, panel=OTHERS
    )
    min_events: int = parameter(
        20,
        "Flow methods: window images with fewer events have no flow; their pair is left out.",
        unit="events",
        low=1,
        panel=OTHERS,
    )
    confirm_ms: int = parameter(
        5, "Slip must hold for this long to be an onset.", unit="ms", low=1, high=1000, panel=OTHERS
    )
    coarse_ms: int = parameter(
        5,
        "Step of the coarse search for the onset; up to --confirm-ms it misses none.",
        unit="ms",
        low=1,
        high=1000,
        panel=OTHERS,
    )
    after_ms: int = parameter(60, "Slices labelled after the onset; later ones are not examined.", unit="ms", low=0)
    from_start: bool = parameter(
        False, "Label closing, loading and light contact too, before the current falls; truth, to train on."
    )
    review: bool = parameter(
        False,
        "Look at the onsets on a page in the browser, move them, and keep them as a person's labels.",
        recipe=False,
        panel=REVIEW,
    )
    by: str = parameter("", "Who labels, with --review; by default the name of the login.", recipe=False, panel=REVIEW)


COMMAND = Command(
    "label",
    Label,
    "stages.label",
    "Recordings.",
    examples=(
        "evetac label data --jobs 2",
        "evetac label a.recording.h5 --method farneback -o other",
        "evetac label data --review",
    ),
)
