"""The share that sticks, told slice by slice: as kernels/touch/sticking.py tells it of the same dots."""

import json
import math

import numpy as np
import pytest

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.touch import rest, sticking
from evetac_cli.kernels.touch.dot_motion import DotNoise
from evetac_cli.resources import STICKING_MODEL
from evetac_cli.stages.touch import touch_fold
from evetac_cli.stages.touch.known_gel import DRIFT_PX, MM_PER_PX, TRACKER_PX
from evetac_cli.stages.touch.touch_fold import StickingShare

X, Y = np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0)
DOTS_PX = np.stack([X, Y], axis=-1).reshape(-1, 2)
NOTHING_LOST = np.zeros(len(DOTS_PX), np.bool_)


def pressed(slice_: int) -> np.ndarray:
    """Dots that a touch moves apart from slice 20 on, and pulls along from slice 60 on."""
    apart = (DOTS_PX - DOTS_PX.mean(axis=0)) * 0.01 * min(max(slice_ - 20, 0) / 20, 1.0)
    near = np.exp(-0.5 * ((DOTS_PX - DOTS_PX.mean(axis=0)) ** 2).sum(axis=1) / 100.0**2)[:, None]
    return DOTS_PX + apart + near * np.array([0.05, 0.0]) * max(slice_ - 60, 0)


@pytest.mark.parametrize(("frame_px", "times"), [((640, 480), 1), ((1280, 960), 2), ((480, 640), 1)])
def test_as_the_kernel_tells_it(frame_px: tuple[int, int], times: int) -> None:
    """Assert no share before a touch, and then that of the kernel that is given the same dots and the same touch.

    In a frame of twice the size the gel is as large, and the frame's middle is that of the gel in every frame.
    """
    middle_px, scale = np.array(frame_px) / 2, MM_PER_PX / times

    def seen(at_px: np.ndarray) -> np.ndarray:
        return times * (at_px if frame_px[0] > frame_px[1] else at_px[:, ::-1])

    online = StickingShare(seen(DOTS_PX), frame_px)
    noise = DotNoise(TRACKER_PX * scale, DRIFT_PX * scale)
    state = sticking.start((seen(DOTS_PX) - middle_px) * scale, touch_fold.shipped_network(), noise)
    shares = []
    for slice_ in range(160):
        at_px = seen(pressed(slice_)).astype(np.float32)  # as tracks are stored
        shares.append(online.step(at_px, NOTHING_LOST))
        told = sticking.step(state, (at_px - middle_px) * scale, NOTHING_LOST, online._touches)
        assert shares[-1] == told.sticking_share or (math.isnan(shares[-1]) and math.isnan(told.sticking_share))
    assert all(map(math.isnan, shares[:20]))
    assert all(0.0 <= share <= 1.0 for share in shares[60 + rest.BLOCK_MS :])


def test_too_few_dots_tell_nothing() -> None:
    """Assert that neither few dots at rest nor few that are tracked are taken for more than they are."""
    few = np.full_like(DOTS_PX, np.nan)
    few[:3] = DOTS_PX[:3]
    assert math.isnan(StickingShare(few, FRAME_PX).step(few, NOTHING_LOST))
    online = StickingShare(DOTS_PX, FRAME_PX)
    assert all(math.isnan(online.step(pressed(100), ~NOTHING_LOST)) for _ in range(20))


def test_the_package_s_network_says_what_it_saw() -> None:
    """Assert that the package's network is one, and that its card names what it never saw, and seeds below 10,000."""
    assert touch_fold.shipped_network() is touch_fold.shipped_network()
    card = json.loads(STICKING_MODEL.with_suffix(".json").read_text())
    trained, never = card["training"], card["never_trained_on"]
    assert not set(trained["objects"]) & set(never["objects"]) and not set(trained["motions"]) & set(never["motions"])
    assert max(*trained["trial_seeds"], *card["deviations"]["trial_seeds"]) < 10_000
    network = touch_fold.shipped_network()
    weights = sum(array.size for array in network) - len(network.share_sd)
    assert card["parameters"] == weights
