"""Covariates of a slip: each in closed form, what is not told, medians and ranges over slips."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.kernels.slip import covariates
from evetac_cli.kernels.slip.covariates import SlipCovariates, SlipTruth, of_labels, of_truth

ONSET, SLICES, RAMP = 2000, 2200, 1000


def counted(per_slice: NDArray[np.int64]) -> Callable[[int, int], NDArray[np.int64]]:
    return lambda start, stop: per_slice[start:stop]


def truth(onset: int = ONSET) -> SlipTruth:
    """A slip in contact from slice 100 on.

    The ramp takes 2 N/s. A fifth of the contact slips from 200 ms before the onset on, nine tenths from 12 ms before.
    The object creeps by 1 px per 100 ms in the last 80 ms.
    """
    at = np.arange(onset)
    xy = np.zeros((onset, 2), np.float32)
    xy[:, 1] = np.maximum(0, at - (onset - 80)) / 100
    normal = np.where(np.arange(onset + 1) >= 100, 5 - 0.002 * np.maximum(0, np.arange(onset + 1) - RAMP), 0)
    share = np.select([at >= onset - 12, at >= onset - 200], [0.9, 0.2], 0.05)
    return SlipTruth(
        np.zeros(onset, bool), share.astype(np.float32), normal.astype(np.float32), xy, RAMP, np.zeros(2, np.float32)
    )


def events() -> NDArray[np.int64]:
    """10 events a slice, 30 in every fourth until 1500, 100 from the onset on."""
    at = np.arange(SLICES)
    return np.select([at >= ONSET, (at % 4 == 0) & (at < 1500)], [100, 30], 10)


def test_each_in_closed_form() -> None:
    """Assert leads, rate about slip, held and non-slip shares, and unloading speed of a slip that is known exactly."""
    slip = of_truth(ONSET, SLICES, truth(), counted(events()))
    assert slip.onset_ms == ONSET
    assert slip.incipient_80_to_gross_ms == 12
    assert slip.creep_to_gross_ms == 30  # 0.5 px after 50 of 80 ms
    assert slip.events_per_ms_about_slip == pytest.approx((250 * 10 + 200 * 100) / 450)  # as far as it is recorded
    assert slip.held_over_25_events == pytest.approx(350 / 1400)  # contact from 100 to 1500
    assert slip.non_slip_tenth_slipping == pytest.approx(200 / 1900)
    assert slip.unloading_n_per_s == pytest.approx(2.0, rel=1e-4)
    assert set(slip.figures()) == set(covariates.WORDS)


def test_unloading_begins_with_the_ramp() -> None:
    """Assert that force is compared with that at the start of the ramp where the ramp is shorter than 250 ms."""
    known = replace(truth(), ramp=ONSET - 100)
    normal = known.normal_n.copy()
    normal[-101:] = np.linspace(3, 2, 101)
    slip = of_truth(ONSET, SLICES, replace(known, normal_n=normal), counted(events()))
    assert slip.unloading_n_per_s == pytest.approx(10.0)


def test_without_ramp_contact_or_past() -> None:
    """Assert that without a ramp there is no creep, and at the first slice of a recording next to nothing is told."""
    slip = of_truth(ONSET, SLICES, replace(truth(), ramp=0, held_xy_px=None), counted(events()))
    assert slip.creep_to_gross_ms is None
    assert covariates.unknown_covariates([slip]) == ["creep_to_gross_ms"]
    none = SlipTruth(
        np.zeros(0, bool), np.zeros(0, np.float32), np.ones(1, np.float32), np.zeros((0, 2), np.float32), 0, None
    )
    assert set(of_truth(0, SLICES, none, counted(events())).figures()) == {
        "incipient_80_to_gross_ms",
        "events_per_ms_about_slip",
    }


def test_the_past_is_bounded() -> None:
    """Assert that of a slip after hours only the last 10.5 s before it are asked for."""
    onset = 3_600_000
    first = covariates.first_looked_at(onset)
    assert first == onset - 10_500
    asked: list[tuple[int, int]] = []

    def counts(start: int, stop: int) -> NDArray[np.int64]:
        asked.append((start, stop))
        return np.zeros(stop - start, np.int64)

    slip = of_truth(onset, onset + 250, replace(truth(onset - first), ramp=0), counts)
    assert slip.held_over_25_events == 0
    assert min(start for start, _ in asked) == first
    assert max(stop for _, stop in asked) == onset + 250


def test_labels_tell_less() -> None:
    """Assert that labels and events tell the rate about slip and the share of examined held slices, and no more."""
    label = np.where(np.arange(SLICES) >= ONSET, 1, 0).astype(np.int8)
    label[:1000] = -1  # not examined
    slip = of_labels(ONSET, label, counted(events()))
    assert slip.figures() == pytest.approx(
        {"events_per_ms_about_slip": (250 * 10 + 200 * 100) / 450, "held_over_25_events": 125 / 500}
    )
    label[:] = -1
    assert of_labels(ONSET, label, counted(events())).held_over_25_events is None


def test_summary_over_slips() -> None:
    """Assert median, 10-90 % range and number of the slips that tell a covariate; one that none tells has no row."""
    slips = [SlipCovariates(number, creep_to_gross_ms=float(number)) for number in range(11)]
    slips.append(SlipCovariates(7, unloading_n_per_s=3.0))
    rows = covariates.summary(slips)
    assert rows == [
        {
            "covariate": covariates.WORDS["creep_to_gross_ms"],
            "median": 5.0,
            "p10": 1.0,
            "p90": 9.0,
            "n": 11,
        },
        {
            "covariate": covariates.WORDS["unloading_n_per_s"],
            "median": 3.0,
            "p10": 3.0,
            "p90": 3.0,
            "n": 1,
        },
    ]
    assert "creep_to_gross_ms" not in covariates.unknown_covariates(slips)
    assert covariates.summary([]) == []
