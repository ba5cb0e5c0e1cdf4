"""Covariates of a slip: what decides how early and how surely it can be told, before any detector is chosen.

Timing and F1 on two data sets compare detectors only where these agree. Of one slip, about the onset of gross slip:

- incipient_80_to_gross_ms: for how long before it at least 80 % of the visible contact slipped without a break.
- creep_to_gross_ms: for how long before it the object was at least 0.5 px from where it was as the current began to
  fall.
- events_per_ms_about_slip: mean over 250 ms before and 250 ms from it on, as far as they are recorded.
- held_over_25_events: of the slices in contact that end 500 ms before it, the share with more than 25 events, the
  paper's line between quiet and busy.
- non_slip_tenth_slipping: of the slices in contact before it without gross slip, the share in which more than a
  tenth of the visible contact slips: what labels call no slip though part of it slips.
- unloading_n_per_s: by how much the normal force of one finger falls in the 250 ms before it, or since the current
  began to fall.

Events are those in the columns that the paper counts, without the window. Nothing is looked at that lies more than
10.5 s before the onset: a recording may take hours.

Why 80 % and the creep, and not 20 or 50 %: the share that slips is a plateau for most of incipient slip, and where it
crosses a line then hangs on a row of nodes. Between grids of 0.83 and 0.5 mm the times from 20 and 50 % change by 86
and 46 ms rms, while events and onset stay (n 8, simulated).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.slip.labels import BUSY_EVENTS

INCIPIENT_SHARE = 0.8  # of the visible contact
CREEP_PX = 0.5
ABOUT_MS = 250  # before the onset, and from it on
HELD_APART_MS = 500  # slices nearer to the onset than this are not held
HELD_MS = 10_000  # of held slices at most
SLIPPING_SHARE = 0.1
TOUCH_N = 0.03  # normal force that is contact

# What each is called beside its figures, which have to fit into a terminal of 80 signs.
WORDS = {
    "incipient_80_to_gross_ms": "80 % incipient slip to gross slip [ms]",
    "creep_to_gross_ms": "0.5 px of creep to gross slip [ms]",
    "events_per_ms_about_slip": "gel events per ms within 250 ms of slip",
    "held_over_25_events": "share of held slices above 25 events",
    "non_slip_tenth_slipping": "share of non-slip slices >10 % slipping",
    "unloading_n_per_s": "unloading speed before slip [N/s]",
}
PERCENTILES = (10, 90)  # of the range over trials

Counts = Callable[[int, int], NDArray[np.int64]]  # events of each of the slices [start, stop)


@dataclass(frozen=True)
class SlipCovariates:
    """Of one slip, see above; None for what cannot be told."""

    onset_ms: int
    incipient_80_to_gross_ms: float | None = None
    creep_to_gross_ms: float | None = None
    events_per_ms_about_slip: float | None = None
    held_over_25_events: float | None = None
    non_slip_tenth_slipping: float | None = None
    unloading_n_per_s: float | None = None

    def figures(self) -> dict[str, float]:
        """Those that are told, by their names."""
        values = {name: getattr(self, name) for name in WORDS}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class SlipTruth:
    """What a simulation knows of the slices [first, onset), and of the onset's own where it says so."""

    gross: NDArray[np.bool_]  # (slices,) gross slip
    visible_share: NDArray[np.float32]  # (slices,) of the visible contact that slips
    normal_n: NDArray[np.float32]  # (slices + 1,) normal force of one finger
    object_xy_px: NDArray[np.float32]  # (slices, 2)
    ramp: int  # slice of the recording in which the current begins to fall; 0 where it does not
    held_xy_px: NDArray[np.float32] | None  # (2,) where the object was then; None where the current does not fall


def first_looked_at(onset: int) -> int:
    """The first slice of a recording that the covariates of a slip look at."""
    return max(0, onset - HELD_APART_MS - HELD_MS)


def of_truth(onset: int, slices: int, truth: SlipTruth, counts: Counts) -> SlipCovariates:
    """The covariates of a slip in a simulated recording of so many slices; truth from `first_looked_at(onset)` on."""
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
    """What labels (slices,) and events alone tell of a slip; held are slices that were examined and do not slip."""
    first = first_looked_at(onset)
    return SlipCovariates(
        onset,
        events_per_ms_about_slip=_mean(counts(*_about(onset, len(label)))),
        held_over_25_events=_held_over(label[first:onset] == 0, onset, counts),
    )


def summary(slips: Sequence[SlipCovariates]) -> list[dict[str, Any]]:
    """A row for each covariate that any slip tells: median, 10-90 % range, and over how many slips."""
    rows = []
    for name, words in WORDS.items():
        known = [value for slip in slips if (value := getattr(slip, name)) is not None]
        if known:
            low, high = np.percentile(known, PERCENTILES).tolist()
            figures = {"median": float(np.median(known)), "p10": low, "p90": high}
            rows.append({"covariate": words, **figures, "n": len(known)})
    return rows


def not_told(slips: Sequence[SlipCovariates]) -> list[str]:
    """The covariates that no slip tells, by their names."""
    return [name for name in WORDS if all(getattr(slip, name) is None for slip in slips)]


def _about(onset: int, slices: int) -> tuple[int, int]:
    return max(onset - ABOUT_MS, 0), min(onset + ABOUT_MS, slices)


def _held_over(candidates: NDArray[np.bool_], onset: int, counts: Counts) -> float | None:
    """Share above BUSY_EVENTS of those slices before the onset, from the first that is looked at, that are held."""
    first = first_looked_at(onset)
    held = candidates[: max(onset - HELD_APART_MS - first, 0)]
    return _mean(counts(first, first + len(held))[held] > BUSY_EVENTS) if held.any() else None


def _lasting(is_so: NDArray[np.bool_]) -> int:
    """How many slices at the end are so, without a break."""
    otherwise = np.flatnonzero(~is_so)
    return len(is_so) - 1 - int(otherwise[-1]) if len(otherwise) else len(is_so)


def _mean(values: NDArray[Any]) -> float | None:
    return float(np.mean(values)) if len(values) else None
