"""The workloads of the camera's cost: the reference of the window, and what noise and uneven thresholds do to a row."""

import numpy as np
import pytest

from evetac_cli.evaluate.cost import camera as cost
from evetac_cli.evaluate.cost.camera import (
    Workload,
    camera_rows,
    play_ideal,
    play_scans,
    row_count,
    true_events,
)
from evetac_cli.evaluate.cost.camera_reference import match
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel

QUIET = CameraModel(frame_px=(96, 48), noise_rate_hz=0.0, hot_pixels=0)
DOT = np.array([[20.3, 22.6]])


def small(name: str, model: CameraModel, *, window: bool = False) -> Workload:
    """One dot, and a window beside it where that is wanted."""
    seen = (optics.texture(np.random.default_rng(1), (128, 128), 6.0, 0.2), (50, 0, 96, 48)) if window else (None, None)
    return Workload(name, model, DOT, cost._slip, 5, (1, 16), "small", *seen)


@pytest.mark.slow
def test_the_window_is_that_of_the_ideal_camera() -> None:
    """Assert that reference and ideal camera see a sliding texture alike: the same events, to a fraction of 1 us."""
    load = small("window", QUIET, window=True)
    state = camera.start(QUIET, load.path_px(1)[0], None, (load.window_px, load.texture), np.random.default_rng(2))
    truth = true_events(state, load)
    seen = truth.x >= 50
    assert seen.sum() > 200
    ideal, _ = play_ideal(state, load, 16)
    agreement = match(ideal, truth, tolerance_us=2.0)
    assert agreement.f1 > 0.99
    assert abs(agreement.count_share) < 0.005
    scanned = match(play_scans(state, load)[0], truth)
    assert np.median(scanned.error_us) > 20 * np.median(agreement.error_us)


@pytest.mark.slow
def test_noise_counts_as_an_error_and_thresholds_do_not() -> None:
    """Assert that noise adds events that the reference lacks, and that uneven thresholds are the reference's too."""
    rows = {}
    for name, changes in {"quiet": {}, "noisy": {"noise_rate_hz": 50.0}, "uneven": {"mismatch": 0.3}}.items():
        load = small(name, CameraModel(frame_px=(96, 48), **{"noise_rate_hz": 0.0, "hot_pixels": 0, **changes}))
        rows[name] = {row["setting"]: row for row in camera_rows(4, [load])}
        assert len(rows[name]) == row_count([load]) == 3
        assert {row["part"] for row in rows[name].values()} == {"small"}
    errors = {name: rows[name][f"ideal, {name}, 16 sub-steps"]["error_share_count"] for name in rows}
    assert errors["noisy"] > 0.05
    assert errors["quiet"] < 0.01
    assert errors["uneven"] < 0.01


def test_workloads_are_told_apart() -> None:
    """Assert that the workloads have names of their own, and that noise, uneven thresholds and a window are there."""
    loads = cost.workloads()
    assert len({load.name for load in loads}) == len(loads)
    harder = [load for load in loads if load.part != "camera"]
    assert [load.texture is not None for load in harder] == [False, False, True]
    assert [load.model.noise_rate_hz > 0 for load in harder] == [True, False, False]
    assert [load.model.mismatch for load in harder] == pytest.approx([0.03, 0.3, 0.03])
