"""What `record` and `grasp` in real time share: how a trial ends, and what is said of it."""

import os
import signal
from array import array

import numpy as np
import pytest

from evetac_cli.errors import DeviceError, attached_outcome
from evetac_cli.jobs import Outcome
from evetac_cli.stages import session

RESULT = Outcome([{"slices": 3}], simulated=False)


def test_an_error_says_what_was_saved() -> None:
    """Assert that an error goes on with what was saved and the rows of its files, and any other as a DeviceError."""
    with pytest.raises(DeviceError, match="unplugged(.|\n)*kept: .*3 slices in a.h5") as failed:
        session.raise_end(DeviceError("unplugged"), "unplugged", "3 slices in a.h5", RESULT)
    assert attached_outcome(failed.value) is RESULT
    with pytest.raises(DeviceError, match="out of range"):
        session.raise_end(ValueError("out of range"), session.INTERRUPTED, "nothing", None)


def test_an_interrupt_goes_on() -> None:
    """Assert that Ctrl-C goes on as such, and that a trial which simply ended raises nothing."""
    with pytest.raises(KeyboardInterrupt, match="interrupted, torque is off: 3 slices") as stopped:
        session.raise_end(None, session.INTERRUPTED, "3 slices", RESULT, "interrupted, torque is off")
    assert attached_outcome(stopped.value) is RESULT
    session.raise_end(None, "the camera's stream ended", "3 slices", RESULT)


def test_losses_are_datasets_and_words() -> None:
    """Assert that every loss is a dataset, also one that did not happen, and that only what was lost is in the row."""
    datasets = session.lost_datasets({"camera.late_events": 3, "gripper.answers_lost": 0})
    assert datasets == {"capture/lost/camera.late_events": 3, "capture/lost/gripper.answers_lost": 0}
    why = "camera.late_events 3"
    assert session.lost_columns({**datasets, "capture/ended": "the end"}) == {"lost": 3, "lost_why": why}
    assert session.lost_columns({}) == {"lost": 0, "lost_why": None}


def test_spread() -> None:
    """Assert that median, 99th percentile and most are those of numpy."""
    values = array("d", range(1001))
    np.testing.assert_allclose(session.spread(values), [500.0, 990.0, 1000.0])


def test_the_second_signal_breaks_off() -> None:
    """Assert that a first Ctrl-C is counted, a second one raised, and that handlers are then what they were."""
    before = signal.getsignal(signal.SIGINT)
    with session.signals_counted() as signals:
        os.kill(os.getpid(), signal.SIGINT)
        assert signals == [signal.SIGINT]
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
    assert signal.getsignal(signal.SIGINT) == before


def test_json_has_no_nan() -> None:
    """Assert that missing dots, wherever they are nested, become null."""
    assert session.without_nan({"a": [1.0, float("nan"), [float("nan")]], "b": "c"}) == {
        "a": [1.0, None, [None]],
        "b": "c",
    }
