"""The authors' published tracker on dots before a simulated camera: it follows small dots, and not the paper's."""

import numpy as np
import pytest

from evetac_cli.events import concatenate
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.presets import PRESETS
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.scanning import camera

SLICES, FAR_PX, STILL = 400, 6.0, (0.0, 0.0)
DOTS_PX = np.stack(np.meshgrid(60.0 + 63.0 * np.arange(4), 60.0 + 62.0 * np.arange(4)), axis=-1).reshape(-1, 2)


def rms_px(preset: str, dot_radius_px: float) -> float:
    """How far the tracker is from dots that go 6 px to the right and back, as a share of how far they go."""
    model = camera.CameraModel(noise_rate_hz=0.03, hot_pixels=0, dot_radius_px=dot_radius_px)
    state = camera.start(model, DOTS_PX, None, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    moved_px = FAR_PX * np.sin(np.pi * np.arange(SLICES + 1) / SLICES)
    true_px = DOTS_PX + np.stack([moved_px, np.zeros_like(moved_px)], axis=1)[:, None]
    motions = (SliceMotion(*ends, STILL, STILL, 0.0) for ends in zip(true_px, true_px[1:], strict=False))
    slices = [camera.step(state, motion, 1000 * k, rng) for k, motion in enumerate(motions)]
    events, starts = concatenate(slices), np.cumsum([0, *(part.size for part in slices)])
    tracks = tracker.fold(tracker.start(DOTS_PX, PRESETS[preset]), events.x, events.y, events.p, starts)
    error_px = np.linalg.norm(tracks.dot_xy_px - true_px[1:], axis=2)
    return float(np.sqrt((error_px**2).mean() / (moved_px[1:] ** 2).mean()))


@pytest.mark.parametrize("preset", ["official", "official-5ms"])
def test_the_published_tracker_follows_small_dots(preset: str) -> None:
    """Assert that it is at least twice as near to dots of 9 px as standing still, and farther from dots of 15 px."""
    assert rms_px(preset, 9.0) < 0.5
    assert rms_px(preset, 15.0) > 1.0


def test_the_papers_tracker_follows_the_papers_dots() -> None:
    """Assert that the paper's equations follow dots of 15 px, and hardly move for those of 9 px."""
    assert rms_px("paper", 15.0) < 0.5
    assert rms_px("paper", 9.0) > 0.8
