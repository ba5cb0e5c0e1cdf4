"""scripts/speed/baselines.py: what kernels are compared with does the same."""

import numpy as np

from evetac_cli.evaluate.cost.tracker import DOTS_PX, rim_events
from evetac_cli.events import Events
from evetac_cli.kernels.tracking import presets, tracker
from scripts.speed.baselines import DenseFrames, NumpyTracker, gel_camera, seen


def test_dense_frames_make_the_same_events() -> None:
    """Assert that the obvious simulator and our camera make the same events, slice for slice."""
    state = gel_camera()
    frames = DenseFrames(state)
    for slice_ in range(3):
        ours, theirs = seen(state, slice_), frames.slice(slice_)
        assert ours.size > 100
        order = [np.lexsort((events.x, events.y, events.t)) for events in (ours, theirs)]
        for mine, other in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(mine[order[0]], other[order[1]])


def test_the_numpy_tracker_is_the_paper_preset() -> None:
    """Assert that plain numpy moves the dots as the preset `paper` does; ours sums pulls in small units."""
    rng = np.random.default_rng(3)
    state, plain = tracker.start(DOTS_PX, presets.PRESETS["paper"]), NumpyTracker(DOTS_PX)
    for _ in range(20):
        x, y, p = rim_events(rng, 2000)
        tracker.step(state, x, y, p)
        plain.step(Events(np.zeros(len(x), np.int64), x, y, p))
    assert np.abs(plain.dot_xy_px - DOTS_PX).max() > 0.01
    np.testing.assert_allclose(plain.dot_xy_px, state.dot_xy_px, atol=1e-4)
