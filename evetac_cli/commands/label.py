"""label: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import Command, parameter

REVIEW = "Manual labels"  # a panel of --help
OTHERS = "Methods other than event-flow"  # a panel of --help


@dataclass(frozen=True)
class Label:
    """Label the slices in which the object slips, from its motion in the window relative to the gel."""

    method: str = parameter(
        "event-flow",
        "Labelling method. event-flow: motion counted from events. farneback: the paper's optical flow. dis: another"
        " optical flow. event-count: many events in the window. truth: the simulation's gross slip, for comparison.",
        choices=("event-flow", "farneback", "dis", "event-count", "truth"),
    )
    slip_distance_px: float = parameter(
        0.3,
        "For event-flow: counted displacement of the object on the gel at which slip begins.",
        unit="px",
        low=0.01,
    )
    threshold_px: float = parameter(
        0.3,
        "For flow methods: flow of the window relative to the gel, over the look-ahead, that counts as slip.",
        unit="px",
        low=0.01,
        panel=OTHERS,
    )
    threshold_events: int = parameter(
        200,
        "For event-count: number of events in the window, over the look-ahead, that counts as slip.",
        unit="events",
        low=1,
        panel=OTHERS,
    )
    look_ahead_ms: int = parameter(
        4,
        "For flow methods and event-count: flow is computed, and events are counted, over this time ahead of a slice.",
        unit="ms",
        low=1,
        high=100,
        panel=OTHERS,
    )
    accumulate_ms: int = parameter(
        3, "For flow methods: slices summed into one event image.", unit="ms", low=1, high=100, panel=OTHERS
    )
    min_events: int = parameter(
        20,
        "For flow methods: skip pairs of images if one has fewer events in the window.",
        unit="events",
        low=1,
        panel=OTHERS,
    )
    confirm_ms: int = parameter(
        5, "Slip must last this long to count as an onset.", unit="ms", low=1, high=1000, panel=OTHERS
    )
    coarse_ms: int = parameter(
        5,
        "Step of the coarse search for the onset; with a step up to --confirm-ms no onset is missed.",
        unit="ms",
        low=1,
        high=1000,
        panel=OTHERS,
    )
    after_ms: int = parameter(
        60, "Time after the onset that is labelled; later slices are not examined.", unit="ms", low=0
    )
    from_start: bool = parameter(
        False,
        "For truth: also label closing, loading and light contact, before the current falls. Use it for training data.",
    )
    review: bool = parameter(
        False,
        "Show the onsets on a page in the browser, where you can move them, and save them as manual labels.",
        recipe=False,
        panel=REVIEW,
    )
    by: str = parameter(
        "", "With --review: name of the person who labels; by default the login name.", recipe=False, panel=REVIEW
    )


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
