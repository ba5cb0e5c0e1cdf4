"""Events in the gel's columns, and covariates of slips, read from recordings with truth and with labels alone."""

from pathlib import Path

import numpy as np
import pytest

from evetac_cli.events import Events
from evetac_cli.store.recordings.onset import covariates_of_truth, gel_counts
from evetac_cli.store.recordings.read import open_recording, ramp_start, true_onset
from tests.conftest import Made
from tests.make import event_arrays, write_recording


def columns_file(path: Path, width: int = 640) -> tuple[Path, Events]:
    """2,500 slices with up to 40 events each, at random columns of the frame, some of them empty."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.choice(2_500_000, 20_000, replace=False)).astype(np.int64)
    t = t[(t // 1000) % 7 != 3]
    x = rng.integers(0, width, len(t)).astype(np.uint16)
    events = Events(t, x, np.zeros(len(t), np.uint16), np.zeros(len(t), np.uint8))
    return write_recording(path, event_arrays(events, 2500, (width, 480))), events


@pytest.mark.parametrize(("start", "stop"), [(0, 2500), (0, 0), (999, 1001), (1700, 2500), (5, 6)])
def test_columns_are_counted_slice_by_slice(tmp_path: Path, start: int, stop: int) -> None:
    """Assert that the counts of any slices are those of events with x below the border, also over edges of blocks."""
    path, events = columns_file(tmp_path / "a.recording.h5")
    for columns in (540, 1, 640):
        expected = np.bincount(events.t[events.x < columns] // 1000, minlength=2500)[start:stop]
        with open_recording(path) as recording:
            np.testing.assert_array_equal(gel_counts(recording, start, stop, columns), expected)


def test_truth_of_a_simulated_slip(made: Made) -> None:
    """Assert that figures of a simulated slip are those that its datasets give, computed here anew."""
    with open_recording(made.recordings[0]) as recording:
        slip = covariates_of_truth(recording)
        assert slip is not None
        onset, ramp = true_onset(recording), ramp_start(recording)
        share, force = (recording.read(f"truth/{name}") for name in ("visible_slip_share", "normal_force_n"))
        moved = np.linalg.norm(
            recording.read("truth/object_xy_px") - recording.read("truth/object_xy_px")[ramp], axis=1
        )
        x, t = recording.read("events/x"), recording.read("events/t")
        slices = len(recording)
    assert slip.onset_ms == onset
    assert onset is not None and ramp > 0
    back = 0
    while share[onset - 1 - back] >= 0.8:
        back += 1
    assert slip.incipient_80_to_gross_ms == back
    back = 0
    while moved[onset - 1 - back] >= 0.5:
        back += 1
    assert slip.creep_to_gross_ms == back
    first, last = max(0, onset - 250), min(slices, onset + 250)
    inside = np.count_nonzero((x < 540) & (t >= 1000 * first) & (t < 1000 * last))
    assert slip.events_per_ms_about_slip == pytest.approx(inside / (last - first))
    begin = max(first, ramp)
    assert slip.unloading_n_per_s == pytest.approx(1000 * (force[begin] - force[onset]) / (onset - begin), rel=1e-4)


def test_a_grasp_has_none(made: Made) -> None:
    """Assert that a grasp, whose controller answers slip, has no covariates."""
    with open_recording(made.grasp) as recording:
        assert covariates_of_truth(recording) is None
