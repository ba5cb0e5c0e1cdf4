"""The data of a trial that view draws: series, intervals of slip, event images, dots."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.store.recordings.onset import LabelledOnset


@dataclass(frozen=True)
class Series:
    """One series over time with at most two values per bin, and the standard deviation of each, if a file has it."""

    name: str
    colour: str
    t_s: NDArray[np.float64]
    value: NDArray[np.float64]
    sd: NDArray[np.float64] | None = None

    @property
    def band(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """One standard deviation below and above, if it is known; not below 0 if no value is."""
        assert self.sd is not None
        low = self.value - self.sd
        return low if np.nanmin(self.value) < 0 else np.maximum(low, 0.0), self.value + self.sd


@dataclass(frozen=True)
class Panel:
    """Series on one axis, and levels drawn across it."""

    title: str
    unit: str
    lines: list[Series]
    levels: dict[str, float] = field(default_factory=dict)
    simulated: bool = False
    logarithmic: bool = False
    ends: tuple[float, float] | None = None  # of the axis, if values beyond have no meaning; else fitted to the values
    caption: str = ""  # explanation, if title and unit are not enough
    marks: bool = False  # separate points, if a line between them would have no meaning


@dataclass(frozen=True)
class Lane:
    """Intervals in s in which one source (truth, label, model) reports slip, and those that it did not examine."""

    name: str
    colour: str
    slip: list[tuple[float, float]]
    unknown: list[tuple[float, float]]


@dataclass(frozen=True)
class CameraImages:
    """Images of another camera of the trial: JPEG, and the index for each event image; -1: none yet."""

    name: str
    images: list[bytes]
    shown: list[int]


@dataclass
class ViewData:
    """All data that a page draws; frames are the times of the event images."""

    slices: int
    span: tuple[int, int]  # slices shown, end excluded
    shown_ms: int
    simulated: bool
    frame_px: tuple[int, int]
    window_px: tuple[int, int, int, int] | None
    labelled: LabelledOnset | None  # onset in the labels
    notes: list[str]
    onsets: dict[str, int | None] = field(default_factory=dict)  # truth, label, model or detector -> first slip
    panels: list[Panel] = field(default_factory=list)
    lanes: list[Lane] = field(default_factory=list)
    phases: list[Lane] = field(default_factory=list)  # of a grasp
    frame_times: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))  # first slice of each image
    dense: dict[str, int] = field(default_factory=dict)  # slices around which images are dense, and why
    contact_times: dict[str, int] = field(default_factory=dict)  # gripped, first touch -> slice
    pictures: list[bytes] = field(default_factory=list)  # PNG of each frame; none without a recording
    events: list[int] = field(default_factory=list)  # number in each picture
    rest_xy_px: NDArray[np.float64] | None = None  # (dots, 2)
    dot_xy_px: NDArray[np.float32] | None = None  # (frames, dots, 2), at the end of each picture
    lost: NDArray[np.uint8] | None = None  # (frames, dots)
    true_xy_px: NDArray[np.float32] | None = None  # (frames, dots, 2), simulated
    side: dict[str, Any] | None = None  # see gripper.side_view
    opens_at: int = 0  # most informative frame
    cameras: list[CameraImages] = field(default_factory=list)
    touch: dict[str, Any] | None = None  # see touch.place_touch

    @property
    def ends(self) -> NDArray[np.int64]:
        """The last slice of each event image."""
        return np.minimum(self.frame_times + self.shown_ms, self.span[1]) - 1
