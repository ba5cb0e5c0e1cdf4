"""Covariates of a slip: conditions that decide how early and how surely any detector can detect it.

Timing and F1 on two data sets only compare detectors if these conditions agree. For one slip, relative to the onset of
gross slip:

- incipient_80_to_gross_ms: how long before the onset at least 80 % of the visible contact slipped without a break.
- creep_to_gross_ms: how long before the onset the object was at least 0.5 px from its position at the start of the fall
  of the current.
- events_per_ms_about_slip: mean over 250 ms before and 250 ms after the onset, as far as recorded.
- held_over_25_events: share of slices with more than 25 events, the paper's limit between quiet and busy, among the
  slices in contact that end 500 ms before the onset.
- non_slip_tenth_slipping: share of slices in which more than a tenth of the visible contact slips, among the slices in
  contact before the onset without gross slip. Labels call these slices no slip although part of the contact slips.
- unloading_n_per_s: rate at which the normal force of one finger falls in the 250 ms before the onset, or since the
  current began to fall.

Events are counted in the paper's columns, without the window. Nothing more than 10.5 s before the onset is used,
because a recording may take hours.

Reason for 80 % and the creep instead of 20 or 50 %: for most of incipient slip the slipping share is a plateau. The
time at which it crosses a limit there depends on a single row of nodes. Between grids of 0.83 and 0.5 mm the times from
20 and 50 % change by 86 and 46 ms rms, while events and onset stay the same (n 8, simulated).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.slip.metrics import BUSY_EVENTS

INCIPIENT_SHARE = 0.8  # of the visible contact
CREEP_PX = 0.5
ABOUT_MS = 250  # before and after the onset
HELD_APART_MS = 500  # slices closer to the onset than this do not count as held
HELD_MS = 10_000  # most time of held slices that is used
SLIPPING_SHARE = 0.1  # of the visible contact
TOUCH_N = 0.03  # smallest normal force that counts as contact

# Displayed name of each covariate; with the numbers it must fit into a terminal of 80 characters.
WORDS = {
    "incipient_80_to_gross_ms": "80 % incipient slip to gross slip [ms]",
    "creep_to_gross_ms": "0.5 px of creep to gross slip [ms]",
    "events_per_ms_about_slip": "gel events per ms within 250 ms of slip",
    "held_over_25_events": "share of held slices above 25 events",
    "non_slip_tenth_slipping": "share of non-slip slices >10 % slipping",
    "unloading_n_per_s": "unloading speed before slip [N/s]",
}
PERCENTILES = (10, 90)  # range over trials that is reported

Counts = Callable[[int, int], NDArray[np.int64]]  # returns the events of each of the slices [start, stop)


@dataclass(frozen=True)
class SlipCovariates:
    """Covariates of one slip, see the module's docstring; None for those that are unknown."""

    onset_ms: int
    incipient_80_to_gross_ms: float | None = None
    creep_to_gross_ms: float | None = None
    events_per_ms_about_slip: float | None = None
    held_over_25_events: float | None = None
    non_slip_tenth_slipping: float | None = None
    unloading_n_per_s: float | None = None

    def figures(self) -> dict[str, float]:
        """Return the known covariates by name."""
        values = {name: getattr(self, name) for name in WORDS}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class SlipTruth:
    """Ground truth of a simulation for the slices [first, onset), and for the onset's own slice if noted."""

    gross: NDArray[np.bool_]  # (slices,) gross slip
    visible_share: NDArray[np.float32]  # (slices,) of the visible contact that slips
    normal_n: NDArray[np.float32]  # (slices + 1,) normal force of one finger
    object_xy_px: NDArray[np.float32]  # (slices, 2)
    ramp: int  # slice of the recording in which the current begins to fall; 0 if it does not
    held_xy_px: NDArray[np.float32] | None  # (2,) position of the object then; None if the current does not fall


def first_looked_at(onset: int) -> int:
    """Return the first slice of a recording that the covariates of a slip use."""
    return max(0, onset - HELD_APART_MS - HELD_MS)


def of_truth(onset: int, slices: int, truth: SlipTruth, counts: Counts) -> SlipCovariates:
    """Return the covariates of a slip in a simulated recording; truth starts at slice `first_looked_at(onset)`."""
    first = first_looked_at(onset)
    contact = truth.normal_n[:-1] >= TOUCH_N
    non_slip = contact & ~truth.gross
    about = _about(onset, slices)
    begin = max(about[0], truth.ramp)
    fallen_n, fallen_ms = float(truth.normal_n[begin - first] - truth.normal_n[-1]), onset - begin
    creep = None
    if truth.held_xy_px is not None:
        creep = _lasting(np.linalg.norm(truth.object_xy_px - truth.held_xy_px, axis=1) >= CREEP_PX)
    return SlipCovariates(
        onset,
        _lasting(truth.visible_share >= INCIPIENT_SHARE),
        creep,
        _mean(counts(*about)),
        _held_over(contact, onset, counts),
        _mean(truth.visible_share[non_slip] > SLIPPING_SHARE),
        1000 * fallen_n / fallen_ms if fallen_ms else None,
    )


def of_labels(onset: int, label: NDArray[np.int8], counts: Counts) -> SlipCovariates:
    """Return the covariates that labels (slices,) and events alone determine; held slices are labelled no slip."""
    first = first_looked_at(onset)
    return SlipCovariates(
        onset,
        events_per_ms_about_slip=_mean(counts(*_about(onset, len(label)))),
        held_over_25_events=_held_over(label[first:onset] == 0, onset, counts),
    )


def summary(slips: Sequence[SlipCovariates]) -> list[dict[str, Any]]:
    """Return a row for each known covariate: median, 10-90 % range, and number of slips."""
    rows = []
    for name, words in WORDS.items():
        values = [value for slip in slips if (value := getattr(slip, name)) is not None]
        if values:
            low, high = np.percentile(values, PERCENTILES).tolist()
            figures = {"median": float(np.median(values)), "p10": low, "p90": high}
            rows.append({"covariate": words, **figures, "n": len(values)})
    return rows


def unknown_covariates(slips: Sequence[SlipCovariates]) -> list[str]:
    """Return the names of the covariates that are unknown for every slip."""
    return [name for name in WORDS if all(getattr(slip, name) is None for slip in slips)]


def _about(onset: int, slices: int) -> tuple[int, int]:
    return max(onset - ABOUT_MS, 0), min(onset + ABOUT_MS, slices)


def _held_over(candidates: NDArray[np.bool_], onset: int, counts: Counts) -> float | None:
    """Return the share above BUSY_EVENTS among the candidate slices that count as held; None without any."""
    first = first_looked_at(onset)
    is_held = candidates[: max(onset - HELD_APART_MS - first, 0)]
    return _mean(counts(first, first + len(is_held))[is_held] > BUSY_EVENTS) if is_held.any() else None


def _lasting(is_so: NDArray[np.bool_]) -> int:
    """Return the length of the run of true values at the end."""
    otherwise = np.flatnonzero(~is_so)
    return len(is_so) - 1 - int(otherwise[-1]) if len(otherwise) else len(is_so)


def _mean(values: NDArray[Any]) -> float | None:
    return float(np.mean(values)) if len(values) else None
