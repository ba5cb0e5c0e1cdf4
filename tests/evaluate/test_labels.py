"""The true onset of slip, on recordings whose answer is known."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evetac_cli.evaluate.labels import true_onsets
from evetac_cli.pages.view.time_series import slip_onsets
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

    return SimpleNamespace(read=read, has=lambda path: ramp if path.startswith("gripper") else path == "truth")


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
