"""The true onset of slip, on recordings whose answer is known."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evetac_cli.evaluate.labels import EvaluateLabels
from evetac_cli.evaluate.labels.measure import for_people, is_near, judged, slid_so_far, summary, true_onsets
from evetac_cli.pages.view.time_series import slip_onsets
from evetac_cli.store.recordings import slip_grid
from evetac_cli.store.recordings.onset import LabelledOnset, onset_of_values
from evetac_cli.store.recordings.read import true_onset

RAMP_MS = 40


def slipping(slips: tuple[int, ...], ramp: bool = True) -> Any:
    """100 slices of which some slip, every node of the pad with the last of them; the current falls from RAMP_MS on."""
    slip, slid_px = np.zeros(100, np.uint8), np.zeros(100, np.float32)
    slip[list(slips)] = 1
    for at in slips:
        slid_px[at - 2 : at + 1] = (0.2, 0.4, 0.6)
    t_us = np.arange(0, 100_000, 2000)
    target_ma = 50.0 - np.maximum(t_us / 1000 - RAMP_MS + 2, 0)
    every_node_px = np.zeros(100, np.float32)
    every_node_px[list(slips)[-1:]] = 1.0
    held = {
        "truth/slip": slip,
        "truth/slid_px": slid_px,
        "truth/every_node_slid_px": every_node_px,
        "gripper/t_us": t_us,
        "gripper/current_target_ma": target_ma,
    }

    def read(path: str, start: int = 0, stop: int | None = None) -> Any:
        return held[path][start:stop]

    return SimpleNamespace(read=read, has=lambda path: ramp if path.startswith("gripper") else path in held)


@pytest.mark.parametrize(("slips", "ramp", "onset"), [
    ((10, 70), True, 70), ((10, 70), False, 10), ((10,), True, None), ((40,), True, 40), ((39,), True, None),
])  # fmt: skip
def test_a_trial_begins_where_the_current_falls(slips: tuple[int, ...], ramp: bool, onset: int | None) -> None:
    """Assert that slip before the current falls is no onset where there is a gripper, for evaluate and for view."""
    made = slipping(slips, ramp)
    assert true_onset(made) == true_onsets(made)["t_s_ms"] == onset
    trial: Any = SimpleNamespace(recording=made, labels=None, features=None, model=None)
    assert slip_onsets(trial, (0, 100), None) == {"truth": onset}


def test_within_a_span() -> None:
    """Assert that only slip within the span counts, and that its slices are those of the recording."""
    made = slipping((50, 70, 90))
    assert [true_onset(made, *span) for span in ((0, 100), (51, 100), (71, 90), (71, 91))] == [50, 70, None, 90]


def test_beginning_of_the_slip_and_last_stuck_node() -> None:
    """Assert where the sliding that leads to the onset began, and the onset by the last stuck node."""
    assert true_onsets(slipping((60, 80))) == {
        "t_s_ms": 60,
        "gross_slip_start_ms": 58,
        "t_every_node_ms": 80,
    }


def told(onset: int, earliest: int = -1, latest: int = -1, doubt: str = "") -> LabelledOnset:
    return onset_of_values(onset, earliest, latest, 1.0, doubt)


def slid(*steps: tuple[int, float], slices: int = 100) -> np.ndarray:
    """The truth's distance of a slide that begins after slice `at`, at so many px/ms, one after the other."""
    speed = np.zeros(slices, np.float32)
    for at, px_ms in steps:
        speed[at + 1 :] = px_ms
    return np.cumsum(speed, dtype=np.float32)


TRUE = {"t_s_ms": 60, "gross_slip_start_ms": 50, "t_every_node_ms": 62}


def test_errors_are_in_px_truly_slid_and_in_ms() -> None:
    """Assert both errors, signed, and what the interval covers, of slides at 0.05 px/ms that get faster."""
    distance = slid((49, 0.05), (60, 0.3))
    row = judged(told(55, 50, 62), TRUE, distance)
    assert (row["onset_error_ms"], row["onset_before_gross_slip_ms"]) == (-5, -5)
    assert row["onset_error_px"] == pytest.approx(-0.25, abs=1e-5)
    assert (row["interval_covers"], row["interval_width_ms"]) == (True, 12)
    assert row["interval_width_px"] == pytest.approx(0.5 + 2 * 0.3, abs=1e-5)
    late = judged(told(62, 61, 63), TRUE, distance)
    assert late["onset_error_px"] == pytest.approx(0.6, abs=1e-5)
    assert late["interval_covers"] is False
    others = [judged(told(onset), TRUE, distance) for onset in (45, -1)]  # 15 ms early, and none
    assert [is_near(one) for one in (row, late, *others)] == [True, False, False, False]


def test_a_slide_that_came_to_rest_counts_in_the_error() -> None:
    """Assert that how far it slid is summed over every slide, as the truth begins anew after each."""
    distance = np.array([0.0, 0.2, 0.4, 0.0, 0.0, 0.3, 0.6], np.float32)
    np.testing.assert_allclose(slid_so_far(distance), [0.0, 0.2, 0.4, 0.4, 0.4, 0.7, 1.0], atol=1e-6)


def test_labels_that_abstain_are_counted_and_not_judged() -> None:
    """Assert the shares of two that are judged, one wrong, and one that abstains, and what people are told."""
    distance = slid((49, 0.05), (60, 0.3))
    names = {"file": "a", "method": "event-flow", slip_grid.COLUMN: None}
    onsets = told(58, 55, 61), told(64, 62, 66), told(90, 40, 95, "slow")
    rows = [names | judged(onset, TRUE, distance) for onset in onsets]
    figures = summary(rows)
    assert (figures["abstained"], figures["abstained_share"]) == (1, pytest.approx(1 / 3))
    assert (figures["rest_within_half_px"], figures["within_half_px"]) == (0.5, pytest.approx(1 / 3))
    assert (figures["rest_within_minus4_plus3_ms"], figures["rest_over_10_ms_early"]) == (0.5, 0)
    assert (figures["interval_coverage"], figures["interval_width_ms_median"]) == (0.5, 5.0)
    of_two = {key: value for key, value in summary(rows[:2]).items() if key.startswith(("onset", "earlier"))}
    assert {key: figures[key] for key in of_two} == of_two  # the guess of an abstention is in no median
    assert (figures["onsets_found"], figures["onset_error_ms_worst"], figures["every_node_counted"]) == (2, 4, 3)
    early = names | judged(told(30, 20, 40, "slow"), TRUE, distance)
    assert summary([*rows, early])["earlier_than_4_ms_before_gross_slip"] == 0
    still = names | judged(told(-1), dict.fromkeys(TRUE), distance)
    assert for_people([*rows, still], EvaluateLabels())[1][-1] == "1 of 4 trials do not slip and are not evaluated."
    _, sentences = for_people(rows, EvaluateLabels())
    assert any("abstain in 1 of 3" in one for one in sentences)
    assert "in 1 of 2" in sentences[0] and "late in 1" in sentences[0]
    assert summary([])["rest_within_half_px"] is None
