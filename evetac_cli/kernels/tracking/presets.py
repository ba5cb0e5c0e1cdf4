"""The constants of the tracker and its presets, which the headers of tracks name.

They are in a module without kernels: a command compares them with those of an existing file, and loads no kernel if
they are equal.
"""

from dataclasses import dataclass, replace

from evetac_cli.errors import check_range, check_whole

USUAL_CONTRAST = 8.0  # log contrast of a dot over the threshold of the camera, of the sensor `evetac`
MAX_REACH_PX = 128.0  # keeps the integer sum of 1e6 pulls below 2**63


@dataclass(frozen=True)
class TrackerConstants:
    """All constants of the tracker; lengths in px, the defaults are the preset `paper`.

    The ring bounds are exclusive and apply to the distance of an event from the dot's centre (the paper prints them for
    its square). The paper gives no regulariser weight. evetac uses the effective one of the authors' published code,
    step_size * regulariser_weight = 2.25e-7 per px**2. The explicit step is stable near the rest grid if
    step_size * (4 N / 3 + 98.8 * regulariser_weight * pitch**2) < 2, with N ring events per dot and slice; otherwise
    the clips keep it bounded.

    With `fit` (fit.py), a dot's rim is the middle of its ring, and all its neighbours together weigh as much as
    8 * regulariser_weight of its events. The constants `gradient_clip` and `ascend` then have no effect, and those from
    `sweeps` on do. The steps are bounded for any values.
    """

    radius_px: float = 15.0  # of the dot's edge; also the largest motion of a dot per slice and axis
    ring_inner_px: float = 10.0  # only events farther away than this pull
    ring_outer_px: float = 20.0  # ... and nearer than this
    count_radius_px: float = 20.0  # events nearer than this are counted for the dot (`events_per_dot`)
    step_size: float = 0.003  # of the gradient step; with `fit` it sets the damping
    regulariser_weight: float = 7.5e-5  # of the elastic term, per px**2
    min_events: int = 10  # a dot moves only if more ring events than this pull it
    gradient_clip: float = 400.0  # px per axis, on the data term: 1.2 px per slice; from the authors' published code
    ascend: bool = False  # step up the gradient of the data term, as the published code does, instead of down
    slices_per_step: int = 1  # slices whose events one step uses together; with `fit` always 1
    # any pixel with more events, and far more than its neighbours, is hot (buckets.py); 0: off
    hot_pixel_events: int = 16
    rest_slices: int = 0  # slices of rest after which a lost dot is put back; 0: never
    fit: bool = False  # solve for the motion, with polarity, instead of a gradient step
    sweeps: int = 8  # of Gauss-Seidel over all dots
    trust_px: float = 3.0  # largest motion seen in a slice, and largest correction of it
    rim_lag_px: float = 0.125  # events come when the rim is this far beyond their pixel (hysteresis of the threshold)
    # Motion of a dot per threshold crossed in its ring, as far as both rims agree: 1 / (pi radius_px thresholds), for a
    # rim over which the brightness changes by 8 thresholds.
    event_px: float = 1.0 / 377.0
    unseen_per_px: float = 0.2  # share of the motion without events, per px of it in a slice (fit.py)
    most_events: float = 1000.0  # weight limit of a dot's rim, in events

    def __post_init__(self) -> None:
        """Raise ValueError for impossible values of the constants that a user can set."""
        check_range("step_size", self.step_size, above=True)
        check_range("regulariser_weight", self.regulariser_weight)
        check_whole("min_events", self.min_events, 0, 2**31 - 1)

    def for_dots(self, dot_radius_px: float, contrast_over_threshold: float | None = None) -> "TrackerConstants":
        """Return the constants for dots of this radius: with `fit` the ring changes with it; otherwise nothing does.

        The widths of ring and count stay the same. A rim has events in proportion to its length and to its contrast
        over the camera's threshold (8 if unknown), so each event on a longer or darker rim represents less motion. The
        radii of the paper's presets are part of their definition. ValueError if the radius is not above half the width
        of the ring, or the ring is too large.
        """
        if not self.fit:
            return self
        half_ring_px = self.ring_outer_px - self.radius_px
        check_range("dot_radius_px", dot_radius_px, half_ring_px, MAX_REACH_PX - half_ring_px)
        contrast = USUAL_CONTRAST if contrast_over_threshold is None else contrast_over_threshold
        return replace(
            self,
            radius_px=dot_radius_px,
            ring_inner_px=dot_radius_px - half_ring_px,
            ring_outer_px=dot_radius_px + half_ring_px,
            count_radius_px=dot_radius_px + (self.count_radius_px - self.radius_px),
            event_px=min(self.event_px * (self.radius_px / dot_radius_px) * (USUAL_CONTRAST / contrast), 1.0),
        )


# Radius of the dots in the published code. It comes from its calibration file, where it is a blob's diameter. The
# code's ring is the outer 13.75 px of it, and the edge is 1.25 times as large.
_OFFICIAL_DOT_PX = 20.62
_OFFICIAL = TrackerConstants(
    radius_px=1.25 * _OFFICIAL_DOT_PX,
    ring_inner_px=_OFFICIAL_DOT_PX - 13.75,
    ring_outer_px=_OFFICIAL_DOT_PX,
    min_events=4,  # the code requires 10 table entries, and an event makes two
    ascend=True,
)

PRESETS: dict[str, TrackerConstants] = {
    "paper": TrackerConstants(),
    # The paper's "more than 10 events" as its published code counts: 10 entries of a table in which an event has two.
    "paper-5-events": TrackerConstants(min_events=4),
    "official": _OFFICIAL,
    # Both versions of that code, of 2024 and its rewrite without ROS (evetac_noros), use slices of 5 ms by default.
    # Each slice must then make 10 + 3 * 4 entries.
    "official-5ms": replace(_OFFICIAL, slices_per_step=5, min_events=10),
    "unregularised": TrackerConstants(regulariser_weight=0.0),
    "stable": TrackerConstants(
        ring_inner_px=11.0,
        ring_outer_px=19.0,
        step_size=0.1,
        regulariser_weight=50.0,
        min_events=0,
        hot_pixel_events=8,  # without a minimum of events, every event of a hot pixel counts
        rest_slices=100,
        fit=True,
    ),
}
